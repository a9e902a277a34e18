"""Maps that rounds of FEM runs have taught where one posterior is.

The runs are chosen for one run's data, so the map is made and kept with that run
(:mod:`calibrate.project.rounds`). It has two parts. The data of that run come from a Gaussian
process of FEM's data, which FEM has tested where the posterior is; the displacement of the whole
body, and every other quantity, from an emulator of the same runs.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol, cast

import numpy as np

from emulator.core.errors import InputError
from emulator.core.rooms import offered
from emulator.core.store import inside
from emulator.scenes.forward_problem import ForwardProblem
from emulator.scenes.scene import Scene, all_nodes
from emulator.surrogates.correction import Correction, no_correction
from emulator.surrogates.emulator import PARTS, CachedEmulator, Emulator
from emulator.surrogates.part import arrays_of, together
from emulator.surrogates.protocol import (
    Arrays,
    ForwardKind,
    ForwardMap,
    Ingredients,
    Option,
    Options,
    fingerprint_of,
)

_PROCESS = "data"  # prefix of the arrays of a process of data
_OF_OUTPUTS = "emulator.external.maps"  # the room of other programs' outputs
_SCALARS = ("length", "nugget", "scale", "local")


@dataclass(frozen=True)
class DataProcess:
    """FEM's data, as a function of the unknowns on their scales, (q,).

    question : the hash of what is observed, and of which unknowns it is a function.
    constant : the data (m,) of the body at rest.
    correction : what FEM adds to them.
    """

    question: str
    constant: np.ndarray
    correction: Correction

    def arrays(self) -> dict[str, np.ndarray]:
        """Return all that gives a value, by name; the variance's matrix is not kept."""
        words = np.frombuffer(self.question.encode(), np.uint8)
        process = self.correction._replace(inverse=np.zeros((0, 0)))._asdict()
        return {"question": words, "constant": self.constant} | {
            name: np.asarray(values, float if name in _SCALARS else None)
            for name, values in process.items()
        }

    @classmethod
    def restore(cls, arrays: Arrays) -> DataProcess:
        """Return the process of :meth:`arrays`; ``KeyError`` where one is missing."""
        process: dict[str, Any] = {name: arrays[name] for name in Correction._fields}
        process |= {name: float(arrays[name]) for name in _SCALARS}
        correction = Correction(**process)._replace(local=bool(process["local"]))
        return cls(bytes(arrays["question"]).decode(), arrays["constant"], correction)


def no_process(question: str, constant: np.ndarray, unknowns: int) -> DataProcess:
    """Return the process before the first run: the body at rest, whatever the unknowns are."""
    return DataProcess(question, constant, no_correction(1, unknowns, len(constant)))


class Taught(ForwardMap, Protocol):
    """A forward map that rounds of runs have taught.

    data : the process of the data of the posterior for which the runs were made.
    record : what is told of the rounds.
    """

    @property
    def data(self) -> DataProcess: ...  # noqa: D102

    @property
    def record(self) -> Mapping[str, Any]: ...  # noqa: D102

    def arrays(self) -> Arrays:
        """Return all that gives a value, by name."""
        ...


@dataclass(frozen=True, eq=False)
class TaughtEmulator(CachedEmulator):
    """An emulator over some nodes, of FEM runs that were made for one posterior.

    data : the process of that posterior's data.
    """

    data: DataProcess = field(kw_only=True)

    kind = "rounds"
    label = "emulator by rounds of FEM"

    @property
    def fingerprint(self) -> str:
        """Short hash of scene, emulator, nodes and process."""
        return fingerprint_of(super().fingerprint, *self.data.arrays().values())

    @property
    def record(self) -> Mapping[str, Any]:
        """Return what is told of the rounds."""
        return self.emulator.record

    def data_of(self, question: str) -> DataProcess | None:
        """Return the process of the data that ``question`` asks for; None where it is another."""
        return self.data if self.data.question == question else None

    def arrays(self) -> Arrays:
        """Return the arrays of the emulator's parts and of the process, by name."""
        parts = {name: np.asarray(array) for name, array in arrays_of(self.emulator.parts).items()}
        return parts | {f"{_PROCESS}/{name}": a for name, a in self.data.arrays().items()}


def taught(emulator: Emulator, data: DataProcess) -> TaughtEmulator:
    """Return the forward map of ``emulator`` over all nodes."""
    nodes = all_nodes(emulator.scene)
    cached = [part.cache(nodes) for part in emulator.parts.values()]
    return TaughtEmulator(emulator, together(cached, len(nodes)), nodes, data=data)


def _refuse(_: Ingredients, __: Options) -> ForwardMap:
    raise InputError(
        "forward map 'rounds' is taught by the data of one run: calibrate infer makes it; for a "
        "map without data, train an emulator"
    )


def _to_arrays(forward: ForwardMap) -> Arrays:
    return cast(Taught, forward).arrays()


def _from_arrays(scene: ForwardProblem, arrays: Arrays) -> ForwardMap:
    if not isinstance(scene, Scene):
        (of_outputs,) = offered(_OF_OUTPUTS, "TaughtOutputs")
        restored: ForwardMap = of_outputs.restored(scene, arrays)
        return restored
    present = {name: inside(arrays, name) for name in PARTS}
    parts = {n: PARTS[n].restore(scene, {}, part) for n, part in present.items() if part}
    process = DataProcess.restore(inside(arrays, _PROCESS))
    return taught(Emulator(scene, **parts), process)  # type: ignore[arg-type]


ROUNDS = ForwardKind(
    "rounds",
    "an emulator of FEM runs that infer makes where the posterior is; what a mesh without an "
    "emulator gets",
    _refuse,
    (Option("most_runs", 64, "FEM runs, each in every load state, at most", least=8),),
    _to_arrays,
    _from_arrays,
    closer="more runs (--most-runs N)",
)
