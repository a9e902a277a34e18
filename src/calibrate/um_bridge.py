r"""A forward map for others: the UM-Bridge protocol (Seelinger et al. 2023), over HTTP.

QUEENS, tinyDA, PyMC, MUQ and others ask a model of this protocol for :math:`f(\theta)`,
:math:`v^T J` and :math:`J w`, with :math:`f` the observations without noise and :math:`J` their
derivatives in :math:`\theta`. There is one input, theta in its parameters' order and units, and one
output an observation. Derivatives are exact: of an emulator by JAX, of FEM from its factors.

The protocol's own package serves to every machine that reaches this one; here it is this machine
alone, unless asked otherwise.
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
    """What UM-Bridge asks of a forward map and its observations; one request at a time.

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
        """Number of parameters."""
        return [len(self.scene.parameters)]

    @property
    def output_sizes(self) -> list[int]:
        """Numbers of each observation."""
        return [place.stop - place.start for place in self._outputs.places.values()]

    def evaluate(self, theta: np.ndarray) -> list[list[float]]:
        """Observations at ``theta`` (p,)."""
        with self._alone:
            found = self._outputs.values(jnp.asarray(theta)[None])[0]
        return [_finite(found[place]).tolist() for place in self._outputs.places.values()]

    def gradient(self, output: int, theta: np.ndarray, weights: np.ndarray) -> list[float]:
        """``weights`` (m,) times the derivatives (m, p) of one observation."""
        return (weights @ self._slopes(output, theta)).tolist()

    def apply_jacobian(self, output: int, theta: np.ndarray, along: np.ndarray) -> list[float]:
        """Derivative (m,) of one observation along a direction (p,) of theta."""
        return (self._slopes(output, theta) @ along).tolist()

    def _slopes(self, output: int, theta: np.ndarray) -> np.ndarray:
        with self._alone:
            found = self._outputs.slopes(jnp.asarray(theta)[None])[0]
        return _finite(found[list(self._outputs.places.values())[output]])


def serve(
    forward: ForwardMap,
    observe: Observation | Observations,
    port: int = 4242,
    host: str = LOOPBACK,
) -> Server:
    """A UM-Bridge server of the model ``forward``, ready for ``serve_forever``.

    Parameters
    ----------
    port : 0 takes a free one. host : the loopback address, or one that other machines reach;
        whoever reaches it may ask.

    Raises
    ------
    InputError
        A port that is taken; observations of several load states.
    """
    return listen(_Handler, ForwardModel(forward, observe), port, host)


class _Fault(Exception):
    """An error of the protocol, by its type there."""

    def __init__(self, kind: str, message: str) -> None:
        super().__init__(message)
        self.kind = kind


class _Handler(Handler):
    def do_GET(self) -> None:
        """The protocol's version and the model's name."""
        if self.is_foreign() or self.path != "/Info":
            self.send(404, b"{}", _JSON)
        else:
            self._answer(200, {"protocolVersion": _VERSION, "models": [NAME]})

    def do_POST(self) -> None:
        """An answer, or an error with its type."""
        try:
            asked = json.loads(self.rfile.read(int(self.headers.get("Content-Length", 0))))
            if self.is_foreign() or not isinstance(asked, dict):
                raise ValueError("not a request of this protocol")
            self._answer(200, answer(self.server.subject, self.path.removeprefix("/"), asked))
        except _Fault as fault:
            self._refuse(fault.kind, str(fault))
        except (InputError, SolverError) as error:
            self._refuse("InvalidInput", str(error))
        except (ValueError, TypeError, KeyError) as error:
            self._refuse("InvalidInput", f"cannot read the request: {error}")

    def _refuse(self, kind: str, message: str) -> None:
        self._answer(400, {"error": {"type": kind, "message": message}})

    def _answer(self, code: int, found: Mapping[str, Any]) -> None:
        self.send(code, json.dumps(found).encode(), _JSON)


def answer(model: ForwardModel, what: str, asked: Mapping[str, Any]) -> dict[str, Any]:
    """The answer to one request of the protocol."""
    if asked.get("name") != NAME:
        raise _Fault("ModelNotFound", f"there is no model '{asked.get('name')}', but '{NAME}'")
    if what == "InputSizes":
        return {"inputSizes": model.input_sizes}
    if what == "OutputSizes":
        return {"outputSizes": model.output_sizes}
    if what == "ModelInfo":
        does = {"Evaluate": True, "Gradient": True, "ApplyJacobian": True, "ApplyHessian": False}
        return {"support": does}
    if what == "TestShMem":  # memory that a client on this machine might share
        return {}
    if what == "Evaluate":
        return {"output": model.evaluate(_theta(model, asked))}
    if what in ("Gradient", "ApplyJacobian"):
        theta, sizes = _theta(model, asked), model.output_sizes
        output = _index(asked, "outWrt", len(sizes))
        _index(asked, "inWrt", 1)
        if what == "Gradient":
            weights = _vector(asked["sens"], sizes[output], "sens")
            return {"output": model.gradient(output, theta, weights)}
        along = _vector(asked["vec"], len(theta), "vec")
        return {"output": model.apply_jacobian(output, theta, along)}
    raise _Fault("UnsupportedFeature", f"{what}: not offered")


def _theta(model: ForwardModel, asked: Mapping[str, Any]) -> np.ndarray:
    given = asked["input"]
    if not isinstance(given, list) or len(given) != 1:
        raise _Fault("InvalidInput", "give one input: theta, as a list in a list")
    return _vector(given[0], model.input_sizes[0], "theta")


def _vector(given: Any, size: int, name: str) -> np.ndarray:
    """Numbers (size,)."""
    found = np.asarray(given, dtype=float)
    if found.shape != (size,) or not np.isfinite(found).all():
        raise _Fault("InvalidInput", f"{name} has shape {found.shape}; give {size} finite numbers")
    return found


def _index(asked: Mapping[str, Any], name: str, count: int) -> int:
    given = asked[name]
    if not isinstance(given, int) or not 0 <= given < count:
        raise _Fault("InvalidInput", f"{name} is {given}; give 0 to {count - 1}")
    return given


def _finite(found: np.ndarray) -> np.ndarray:
    """As it is; JSON has no NaN, and no client expects one."""
    if not np.isfinite(found).all():
        raise _Fault("InvalidOutput", "not finite at this theta")
    return found
