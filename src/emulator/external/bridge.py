"""A solver behind the UM-Bridge protocol (Seelinger et al. 2023): a model that a server has."""

from __future__ import annotations

import json
import urllib.error
import urllib.request
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from emulator.core.errors import InputError, SolverError
from emulator.external.problem import ExternalProblem, RunAnswer


@dataclass(frozen=True)
class Bridge:
    """A model of a UM-Bridge server.

    Its inputs, one after the other, are the parameters and then the constants, in the order of the
    problem's file; its outputs, one after the other, are the problem's.

    Parameters
    ----------
    url : of the server, such as ``http://localhost:4242``.
    model : the name of its model.
    config : the options that the model takes.
    time_limit : seconds for one answer.
    at_once : the number of requests at the same time.
    """

    url: str
    model: str = "forward"
    config: dict[str, str | float | bool] = field(default_factory=dict)
    time_limit: float = 3600.0
    at_once: int = 1

    kind = "umbridge"

    def _ask(self, what: str, **request: Any) -> dict[str, Any]:
        """Return the answer to one request; :class:`SolverError` where the model refuses it."""
        content = {"name": self.model, "config": self.config, **request}
        url = f"{self.url.rstrip('/')}/{what}"
        if not url.startswith(("http://", "https://")):
            raise InputError(f"url = '{self.url}'; give one like http://localhost:4242")
        post = urllib.request.Request(
            url, json.dumps(content).encode(), {"Content-Type": "application/json"}
        )
        try:
            with urllib.request.urlopen(post, timeout=self.time_limit) as answer:
                content = json.loads(answer.read())
        except urllib.error.HTTPError as error:
            fault = _error_in(error.read())
            kind, message = fault.get("type", f"HTTP {error.code}"), fault.get("message", "")
            mistake = kind in ("ModelNotFound", "UnsupportedFeature")
            raise (InputError if mistake else SolverError)(f"{kind} {message}".strip()) from None
        except TimeoutError:
            raise SolverError(f"no answer within {self.time_limit:g} s") from None
        except (OSError, ValueError) as error:
            reason = getattr(error, "reason", error)
            raise InputError(f"no UM-Bridge server answers at {self.url}: {reason}") from None
        if "error" in content:
            raise SolverError(str(content["error"].get("message", content["error"])))
        return dict(content)

    @cached_property
    def _sizes(self) -> tuple[list[int], list[int], frozenset[str]]:
        """Sizes of the model's inputs and outputs, and which requests it supports."""
        inputs = self._ask("InputSizes")["inputSizes"]
        outputs = self._ask("OutputSizes")["outputSizes"]
        support = self._ask("ModelInfo").get("support", {})
        return inputs, outputs, frozenset(name for name, yes in support.items() if yes)

    def run(self, problem: ExternalProblem, theta: np.ndarray) -> RunAnswer:
        """Return the model's answer at ``theta`` (p,), with derivatives where it has them."""
        inputs, outputs, supported = self._sizes
        values = [*map(float, theta), *problem.constants.values()]
        for what, there, here in (
            ("inputs", sum(inputs), len(values)),
            ("outputs", sum(outputs), problem.node_count),
        ):
            if there != here:
                raise InputError(
                    f"model '{self.model}' at {self.url} has {there} {what}; problem "
                    f"'{problem.name}' has {here}"
                )
        ends = np.cumsum([0, *inputs])
        parts = [values[a:b] for a, b in pairwise(ends)]
        flat = np.concatenate(
            [np.ravel(part) for part in self._ask("Evaluate", input=parts)["output"]]
        )
        answer = problem.answer({name: flat[rows] for name, rows in problem.places.items()})
        if "Gradient" not in supported and "ApplyJacobian" not in supported:
            return answer
        few = "ApplyJacobian" in supported and len(theta) <= problem.node_count
        slopes = self._slopes(parts, len(theta), backwards="Gradient" in supported and not few)
        return answer._replace(gradients=slopes)

    def _slopes(self, parts: list[list[float]], parameters: int, *, backwards: bool) -> np.ndarray:
        """Return derivatives (n, p), by a request for each output's number or each parameter.

        backwards : whether the model gives gradients of an output; else derivatives along inputs.
        """
        inputs, outputs, _ = self._sizes
        rows = np.zeros((sum(outputs), sum(inputs)))
        ends, starts = np.cumsum([0, *outputs]), np.cumsum([0, *inputs])
        for i, width in enumerate(inputs):
            if starts[i] >= parameters:
                break  # constants
            columns = slice(starts[i], starts[i] + width)
            for o, size in enumerate(outputs):
                place = slice(ends[o], ends[o] + size)
                at = {"outWrt": o, "inWrt": i, "input": parts}
                if backwards:
                    sens = [self._ask("Gradient", sens=e, **at)["output"] for e in _units(size)]
                    rows[place, columns] = np.array(sens)
                else:
                    along = [
                        self._ask("ApplyJacobian", vec=e, **at)["output"] for e in _units(width)
                    ]
                    rows[place, columns] = np.array(along).T
        return rows[:, :parameters]

    def identity(self, folder: Path) -> Any:  # noqa: ARG002
        """Return where the model is, and its options."""
        return [self.url, self.model, self.config]


def _units(size: int) -> list[list[float]]:
    return np.eye(size).tolist()


def _error_in(content: bytes) -> dict[str, Any]:
    """Return the protocol's error in the body of a refusal; empty where there is none."""
    try:
        error = json.loads(content)["error"]
    except (ValueError, KeyError, TypeError):
        return {}
    return error if isinstance(error, dict) else {"message": str(error)}
