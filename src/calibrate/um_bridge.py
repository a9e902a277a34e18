r"""A forward map for other programs: the UM-Bridge protocol (Seelinger et al. 2023), over HTTP.

QUEENS, tinyDA, PyMC, MUQ and others ask a model of this protocol for :math:`f(\theta)`,
:math:`v^T J` and :math:`J w`, with :math:`f` the observations without noise and :math:`J` their
derivatives in :math:`\theta`. There is one input, theta in its parameters' order and units, and one
output an observation. Derivatives are exact: of an emulator by JAX, of FEM from its factors.

The protocol's own package serves every machine that reaches this one. This server answers this
machine alone unless another host is named.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np

from calibrate.local_server import LOOPBACK, Handler, Server, listen
from calibrate.measurements import Observation, Observations, observations
from calibrate.measurements.outputs import Outputs
from emulator.core.errors import InputError, SolverError
from emulator.core.store import parse_text
from emulator.surrogates.protocol import ForwardMap

NAME = "forward"
_VERSION = 1.0
_EVALUATIONS = ("Evaluate", "Gradient", "ApplyJacobian")


class ForwardModel:
    """A model of the UM-Bridge protocol: a forward map and its observations in one load state.

    Requests are answered one at a time.
    """

    def __init__(self, forward: ForwardMap, observe: Observation | Observations) -> None:
        several = observations(observe)
        if several.states != ("",):
            raise InputError("serve: observations of several load states; take one at a time")
        self.scene, self.label = forward.scene, forward.label
        self._outputs = Outputs(forward, several, what="serve")
        self._alone = threading.Lock()
        self.units = {name: part.unit for name, part in several.parts.items()}
        self.output_sizes = [place.stop - place.start for place in self._outputs.places.values()]

    def answer(self, what: str, request: Mapping[str, Any]) -> dict[str, Any]:
        """Return the answer to one request of the protocol."""
        if request.get("name") != NAME:
            raise _Fault(
                "ModelNotFound", f"there is no model '{request.get('name')}', but '{NAME}'"
            )
        count, places = len(self.scene.parameters), list(self._outputs.places.values())
        descriptions: dict[str, dict[str, Any]] = {
            "InputSizes": {"inputSizes": [count]},
            "OutputSizes": {"outputSizes": self.output_sizes},
            "ModelInfo": {"support": {**dict.fromkeys(_EVALUATIONS, True), "ApplyHessian": False}},
            "TestShMem": {},  # memory that a client on this machine might share
        }
        if what in descriptions:
            return descriptions[what]
        if what not in _EVALUATIONS:
            raise _Fault("UnsupportedFeature", f"{what}: not offered")
        value = request["input"]
        if not isinstance(value, list) or len(value) != 1:
            raise _Fault("InvalidInput", "give one input: theta, as a list in a list")
        theta = jnp.asarray(_vector(value[0], count, "theta"))[None]
        if what == "Evaluate":
            with self._alone:
                values = _finite(self._outputs.values(theta)[0])
            return {"output": [values[place].tolist() for place in places]}
        output = _index(request, "outWrt", len(places))
        _index(request, "inWrt", 1)
        back = what == "Gradient"
        name, size = ("sens", self.output_sizes[output]) if back else ("vec", count)
        direction = _vector(request[name], size, name)
        with self._alone:
            slopes = _finite(self._outputs.slopes(theta)[0][places[output]])
        return {"output": (direction @ slopes if back else slopes @ direction).tolist()}


def serve(
    forward: ForwardMap, observe: Observation | Observations, port: int = 4242, host: str = LOOPBACK
) -> Server:
    """Return a UM-Bridge server of the model ``forward``, ready for ``serve_forever``.

    Parameters
    ----------
    observe : the observations that the server returns, of one load state.
    port : the port to listen on, which no other program has; 0 takes a free one.
    host : the loopback address, or one that other machines reach, without a password.
    """
    return listen(_BridgeHandler, ForwardModel(forward, observe), port, host)


class _Fault(Exception):
    """An error that the protocol has a type for."""

    def __init__(self, kind: str, message: str) -> None:
        super().__init__(message)
        self.kind = kind


class _BridgeHandler(Handler):
    def do_GET(self) -> None:
        """Answer with the protocol's version and the model's name."""
        if self.is_foreign():
            self._refuse_foreign()
        elif self.path != "/Info":
            self.send(404, {})
        else:
            self.send(200, {"protocolVersion": _VERSION, "models": [NAME]})

    def do_POST(self) -> None:
        """Answer a request, or refuse it with the type of its error."""
        try:
            text = self.body()
            if self.is_foreign():
                self._refuse_foreign()
                return
            request = parse_text(json.loads, text)
            if not isinstance(request, dict):
                raise ValueError("not a request of this protocol")
            self.send(200, self.server.subject.answer(self.path.removeprefix("/"), request))
        except _Fault as fault:
            self._refuse(fault.kind, str(fault))
        except (InputError, SolverError) as error:
            self._refuse("InvalidInput", str(error))
        except (ValueError, TypeError, KeyError) as error:
            self._refuse("InvalidInput", f"cannot read the request: {error}")

    def _refuse_foreign(self) -> None:
        self._refuse("InvalidInput", "a page of another site asks; this model answers none", 403)

    def _refuse(self, kind: str, message: str, code: int = 400) -> None:
        self.send(code, {"error": {"type": kind, "message": message}})


def _vector(value: Any, size: int, name: str) -> np.ndarray:
    """Read a list of ``size`` finite numbers."""
    numbers = np.asarray(value, dtype=float)
    if numbers.shape != (size,) or not np.isfinite(numbers).all():
        raise _Fault(
            "InvalidInput", f"{name} has shape {numbers.shape}; give {size} finite numbers"
        )
    return numbers


def _index(request: Mapping[str, Any], name: str, count: int) -> int:
    value = request[name]
    if not isinstance(value, int) or not 0 <= value < count:
        raise _Fault("InvalidInput", f"{name} is {value}; give 0 to {count - 1}")
    return value


def _finite(numbers: np.ndarray) -> np.ndarray:
    """Refuse values that are not finite: JSON has no NaN, and no client expects one."""
    if not np.isfinite(numbers).all():
        raise _Fault("InvalidOutput", "not finite at this theta")
    return numbers
