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
from emulator.surrogates.protocol import ForwardMap

NAME = "forward"
_VERSION = 1.0
_JSON = "application/json"


class ForwardModel:
    """A model of the UM-Bridge protocol: a forward map and its observations.

    Requests are answered one at a time.

    Raises
    ------
    InputError
        Observations of several load states.
    """

    def __init__(self, forward: ForwardMap, observe: Observation | Observations) -> None:
        parts = dict(observations(observe).parts)
        if observations(observe).states != ("",):
            raise InputError("serve: observations of several load states; take one at a time")
        self.scene, self.label = forward.scene, forward.label
        self._outputs = Outputs(forward, parts, what="serve")
        self._alone = threading.Lock()
        self.units = {name: part.unit for name, part in parts.items()}

    @property
    def input_sizes(self) -> list[int]:
        """The number of parameters, of the one input."""
        return [len(self.scene.parameters)]

    @property
    def output_sizes(self) -> list[int]:
        """The number of values of each observation."""
        return [place.stop - place.start for place in self._outputs.places.values()]

    def evaluate(self, theta: np.ndarray) -> list[list[float]]:
        """Return the observations at ``theta`` (p,)."""
        with self._alone:
            values = self._outputs.values(jnp.asarray(theta)[None])[0]
        return [_finite(values[place]).tolist() for place in self._outputs.places.values()]

    def gradient(self, output: int, theta: np.ndarray, weights: np.ndarray) -> list[float]:
        """Return ``weights`` (m,) times the derivatives (m, p) of one observation."""
        return (weights @ self._slopes(output, theta)).tolist()

    def apply_jacobian(self, output: int, theta: np.ndarray, along: np.ndarray) -> list[float]:
        """Return the derivative (m,) of one observation along a direction (p,) of theta."""
        return (self._slopes(output, theta) @ along).tolist()

    def _slopes(self, output: int, theta: np.ndarray) -> np.ndarray:
        with self._alone:
            values = self._outputs.slopes(jnp.asarray(theta)[None])[0]
        return _finite(values[list(self._outputs.places.values())[output]])


def serve(
    forward: ForwardMap,
    observe: Observation | Observations,
    port: int = 4242,
    host: str = LOOPBACK,
) -> Server:
    """Return a UM-Bridge server of the model ``forward``, ready for ``serve_forever``.

    Parameters
    ----------
    forward : the forward map.
    observe : the observations that the server returns.
    port : the port to listen on; 0 takes a free one.
    host : the loopback address, or one that other machines reach, without a password.

    Raises
    ------
    InputError
        A port that is taken; observations of several load states.
    """
    return listen(_Handler, ForwardModel(forward, observe), port, host)


class _Fault(Exception):
    """An error that the protocol has a type for."""

    def __init__(self, kind: str, message: str) -> None:
        super().__init__(message)
        self.kind = kind


class _Handler(Handler):
    def do_GET(self) -> None:
        """Answer with the protocol's version and the model's name."""
        if self.is_foreign() or self.path != "/Info":
            self.send(404, b"{}", _JSON)
        else:
            self._answer(200, {"protocolVersion": _VERSION, "models": [NAME]})

    def do_POST(self) -> None:
        """Answer a request, or refuse it with the type of its error."""
        try:
            request = json.loads(self.rfile.read(int(self.headers.get("Content-Length", 0))))
            if self.is_foreign() or not isinstance(request, dict):
                raise ValueError("not a request of this protocol")
            self._answer(200, answer(self.server.subject, self.path.removeprefix("/"), request))
        except _Fault as fault:
            self._refuse(fault.kind, str(fault))
        except (InputError, SolverError) as error:
            self._refuse("InvalidInput", str(error))
        except (ValueError, TypeError, KeyError) as error:
            self._refuse("InvalidInput", f"cannot read the request: {error}")

    def _refuse(self, kind: str, message: str) -> None:
        self._answer(400, {"error": {"type": kind, "message": message}})

    def _answer(self, code: int, content: Mapping[str, Any]) -> None:
        self.send(code, json.dumps(content).encode(), _JSON)


def answer(model: ForwardModel, what: str, request: Mapping[str, Any]) -> dict[str, Any]:
    """Return the answer to one request of the protocol."""
    if request.get("name") != NAME:
        raise _Fault("ModelNotFound", f"there is no model '{request.get('name')}', but '{NAME}'")
    if what == "InputSizes":
        return {"inputSizes": model.input_sizes}
    if what == "OutputSizes":
        return {"outputSizes": model.output_sizes}
    if what == "ModelInfo":
        support = {"Evaluate": True, "Gradient": True, "ApplyJacobian": True, "ApplyHessian": False}
        return {"support": support}
    if what == "TestShMem":  # memory that a client on this machine might share
        return {}
    if what == "Evaluate":
        return {"output": model.evaluate(_theta(model, request))}
    if what in ("Gradient", "ApplyJacobian"):
        theta, sizes = _theta(model, request), model.output_sizes
        output = _index(request, "outWrt", len(sizes))
        _index(request, "inWrt", 1)
        if what == "Gradient":
            weights = _vector(request["sens"], sizes[output], "sens")
            return {"output": model.gradient(output, theta, weights)}
        direction = _vector(request["vec"], len(theta), "vec")
        return {"output": model.apply_jacobian(output, theta, direction)}
    raise _Fault("UnsupportedFeature", f"{what}: not offered")


def _theta(model: ForwardModel, request: Mapping[str, Any]) -> np.ndarray:
    value = request["input"]
    if not isinstance(value, list) or len(value) != 1:
        raise _Fault("InvalidInput", "give one input: theta, as a list in a list")
    return _vector(value[0], model.input_sizes[0], "theta")


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
