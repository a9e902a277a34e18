"""What a verdict rests on: figures, each with its Monte Carlo error, and their limits."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from calibrate.posterior.fit import Misfit

# At a shift of 0.25 sd a 90 % interval still covers 88.9 %.
LARGEST_SHIFT = 0.25
LARGEST_LOG_SD = float(np.log(1.2))
LARGEST_CORRELATION_CHANGE = 0.2
# Of FEM's mass below a quantile of the draws: about what the largest shift and change of sd do
# together to a Gaussian (0.073 and 0.118). Two points may have the right mean and sd.
LARGEST_MASS = {0.05: 0.06, 0.5: 0.12, 0.95: 0.06}
# Of the mesh: beyond, the posterior is about the mesh and not about the tissue.
LARGEST_MESH_SHIFT = 0.5
LARGEST_MESH_LOG_SD = float(np.log(1.25))
# Of a posterior that is widened for the mesh: the finer mesh's mean inside its 90 % interval.
LARGEST_WIDENED_SHIFT = 1.5
# Weights of FEM runs of which none exceeds this multiple of their mean have no tail that matters:
# proposals cover the prior, so that the ratios are bounded (docs/experiments.md, "When k-hat cries
# wolf").
NO_TAIL = 6.0
_ERRORS = 2.0  # of Monte Carlo that a figure must keep from its limit


@dataclass(frozen=True)
class Figure:
    """A number and its Monte Carlo error."""

    value: float
    error: float

    def within(self, limit: float) -> bool | None:
        """Whether its size is below ``limit``; ``None`` where its error leaves that open."""
        if not np.isfinite([self.value, self.error]).all():
            return None
        if abs(self.value) + _ERRORS * self.error <= limit:
            return True
        return False if abs(self.value) - _ERRORS * self.error > limit else None

    def more(self, limit: float) -> float:
        """How many times as many runs would decide, if its value stays: errors fall as a root."""
        gap = abs(limit - abs(self.value))
        return (_ERRORS * self.error / gap) ** 2 if gap > 0.0 else np.inf


@dataclass(frozen=True)
class Changes:
    """What FEM changes of a posterior, by parameter.

    shift : of the mean, in sd of the draws. log_sd : of the sd. correlation : of each pair.
    mass : below the quantiles of the draws, by their level.
    """

    shift: dict[str, Figure]
    log_sd: dict[str, Figure]
    correlation: dict[str, Figure]
    mass: dict[float, dict[str, Figure]] = field(default_factory=dict)

    def judged(self) -> list[tuple[str, Figure, float]]:
        """Every figure in words, with its limit."""
        return [
            *((f"mean of {n} moves by {f.value:+.2f} sd", f, LARGEST_SHIFT)
              for n, f in self.shift.items()),
            *((f"sd of {n} changes by a factor of {np.exp(f.value):.2f}", f, LARGEST_LOG_SD)
              for n, f in self.log_sd.items()),
            *((f"correlation of {n} changes by {f.value:+.2f}", f, LARGEST_CORRELATION_CHANGE)
              for n, f in self.correlation.items()),
            *((f"below the {100 * level:.0f} % quantile of {n} FEM has "
               f"{100 * (level + f.value):.0f} %", f, LARGEST_MASS[level])
              for level, figures in self.mass.items() for n, f in figures.items()),
        ]  # fmt: skip

    def within(self) -> bool | None:
        """Whether all are within their limits; ``None`` where that is open."""
        return _all(figure.within(limit) for _, figure, limit in self.judged())


@dataclass(frozen=True)
class Sampling:
    """The draws as draws: largest R-hat, smallest ESS, divergent transitions, their number."""

    r_hat: float
    ess_bulk: float
    ess_tail: float
    divergences: int
    transitions: int
    vary: bool = True


@dataclass(frozen=True)
class Physics:
    """FEM at the checked points.

    runs, failed : solved, and not converged anywhere; failed_mass : of FEM's posterior.
    smallest_J : smallest det F in the body at a draw. unstable : draws at saddles, of ``asked``.
    """

    runs: int
    failed: int
    failed_mass: float
    smallest_J: float
    unstable: int
    asked: int


@dataclass(frozen=True)
class Tail:
    """How far FEM can be trusted to weigh the corrected map.

    k_hat, k_threshold : Pareto shape of the weights of FEM runs, and the largest one allowed.
    ess : their effective number. largest : largest weight over the mean one.
    spread : sd of the log ratio of FEM's likelihood over the corrected map's.
    pool : effective points under the corrected map.
    missed : FEM runs of all kinds that FEM finds likely and the corrected map does not, where tests
        are too few to meet what it may hide.
    ends : places that FEM finds likely and draws or map do not know, where its descents ended.
    """

    k_hat: float
    k_threshold: float
    ess: float
    largest: float
    spread: float
    pool: float
    missed: int
    ends: int = 0

    @property
    def heavy(self) -> bool:
        """Whether errors cannot be trusted."""
        return not (self.k_hat < self.k_threshold or self.largest < NO_TAIL)


@dataclass(frozen=True)
class MeshChange:
    """What a finer mesh changes of a posterior, by parameter.

    shift : of the mean, in posterior sd. log_sd : of the sd. Both are empty where nothing is known.
    nodes : of the finer mesh. runs, failed : solves on it, and those that did not converge.
    linear : whether the mesh has linear elements. widened : whether the likelihood allows for the
    error of the mesh. why : the reason that it was not asked.
    """

    shift: dict[str, Figure] = field(default_factory=dict)
    log_sd: dict[str, Figure] = field(default_factory=dict)
    nodes: int = 0
    runs: int = 0
    failed: int = 0
    linear: bool = False
    widened: bool = False
    why: str = ""

    def judged(self) -> list[tuple[str, Figure, float]]:
        """Every figure in words, with its limit."""
        largest = LARGEST_WIDENED_SHIFT if self.widened else LARGEST_MESH_SHIFT
        return [
            *((f"mean of {n} would move by {f.value:+.2f} sd", f, largest)
              for n, f in self.shift.items()),
            *((f"sd of {n} would change by a factor of {np.exp(f.value):.2f}", f,
               LARGEST_MESH_LOG_SD) for n, f in self.log_sd.items()),
        ]  # fmt: skip

    def within(self) -> bool | None:
        """Whether all are within their limits; ``None`` where that is open."""
        return (
            _all(figure.within(limit) for _, figure, limit in self.judged()) if self.shift else None
        )


@dataclass(frozen=True)
class Evidence:
    """All a verdict rests on.

    draws, corrected : what FEM changes of the draws, and of the corrected map's posterior.
    mean, sd : of each parameter, by FEM. mesh : what a finer mesh changes.
    """

    draws: Changes
    corrected: Changes
    mean: dict[str, Figure]
    sd: dict[str, Figure]
    sampling: Sampling
    physics: Physics
    tail: Tail
    misfit: dict[str, Misfit]
    mesh: MeshChange = MeshChange(why="not asked")


def _all(answers: Iterable[bool | None]) -> bool | None:
    answers = list(answers)
    if False in answers:
        return False
    return None if None in answers else True
