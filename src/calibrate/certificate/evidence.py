"""The evidence of a certificate: figures with their errors, and the limit of each.

Every figure has a Monte Carlo error. A figure is within its limit if it is below by more than 2.4
times that error, beyond its limit if it is above by more than that, and undecided in between. A
check adds FEM runs only while its verdict is undecided. A check that begins with more runs may also
refuse what one with fewer accepted, or accept what it refused: a figure near its limit is misjudged
with the small probability given at ``_ERRORS``, and FEM may fail, or find the data likely, where
fewer runs did not look.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from calibrate.posterior.box import BoxEnd
from calibrate.posterior.diagnosis import Misfit, Sampling
from calibrate.posterior.taken_up import TakenUp

# At a shift of 0.25 sd a 90 % interval still covers 88.9 %.
LARGEST_SHIFT = 0.25
LARGEST_LOG_SD = float(np.log(1.2))
LARGEST_CORRELATION_CHANGE = 0.2
# Change of the mass below a quantile, by the quantile's level: about what the largest shift and the
# largest change of sd do together to a Gaussian (0.073 and 0.118). Mean and sd alone are not
# enough: a posterior of two points may have the right ones.
LARGEST_MASS = {0.05: 0.06, 0.5: 0.12, 0.95: 0.06}
# Beyond these changes by a finer mesh the posterior is about the mesh and not about the tissue.
LARGEST_MESH_SHIFT = 0.5
LARGEST_MESH_LOG_SD = float(np.log(1.25))
# Monte Carlo errors between a figure and its limit. Runs are doubled while they do not decide, and
# fresh points test at each look, so errors are independent: at 2.4 a figure that is at its limit is
# called within it at one of three looks with a probability of 1 - 0.9918^3 = 2.4 %, of five 4 %.
_ERRORS = 2.4


@dataclass(frozen=True)
class Figure:
    """A number and its Monte Carlo error."""

    value: float
    error: float

    def within(self, limit: float) -> bool | None:
        """Return whether the size is below ``limit``; ``None`` if the error leaves that open."""
        size, error = abs(self.value), _ERRORS * self.error
        if not np.isfinite([size, error]).all() or size - error <= limit < size + error:
            return None
        return bool(size <= limit)

    def factor_to_decide(self, limit: float) -> float:
        """Return the factor in the number of runs that decides, if the value stays as it is.

        The error falls with the square root of the number of runs.
        """
        gap = abs(limit - abs(self.value))
        return (_ERRORS * self.error / gap) ** 2 if gap > 0.0 else np.inf


Comparison = tuple[str, Figure, float]
"""A figure in words, the figure, and its limit."""


def all_within(comparisons: list[Comparison]) -> bool | None:
    """Return whether all figures are within their limits; ``None`` if that is undecided."""
    answers = [figure.within(limit) for _, figure, limit in comparisons]
    if False in answers:
        return False
    return None if None in answers else True


@dataclass(frozen=True)
class Changes:
    """The changes of a posterior by FEM, of logarithms where a parameter's scale is logarithmic.

    shift : the change of each mean, in posterior sd, by parameter.
    log_sd : the change of the logarithm of each sd, by parameter.
    correlation : the change of the correlation of each pair.
    mass : the change of the mass below each quantile, by the quantile's level and by parameter.
    """

    shift: dict[str, Figure] = field(default_factory=dict)
    log_sd: dict[str, Figure] = field(default_factory=dict)
    correlation: dict[str, Figure] = field(default_factory=dict)
    mass: dict[float, dict[str, Figure]] = field(default_factory=dict)

    def comparisons(self) -> list[Comparison]:
        """Return every figure with its limit."""
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


SAID_HOMOGENEOUS = 'as grips = "none" says'
NOBODY_SAID = "and nobody said how it was held"


@dataclass(frozen=True)
class MeshChange(Changes):
    """The changes of means and sds by a finer mesh, or by the grips of a specimen.

    There are no figures where nothing is known.

    nodes : the number of nodes of the finer mesh.
    runs, failed : the numbers of solves on the finer mesh, and of those that did not converge.
    linear : whether the coarser mesh has linear elements.
    of, where : what was finer, ``mesh``, ``grips`` of a specimen, ``steps`` in time or ``mesh and
        steps``, and the place of the solves in words.
    why : the reason for which no finer mesh was solved; empty if one was.
    homogeneous : of a specimen without grips, in words, who says that it deforms evenly.
    """

    nodes: int = 0
    runs: int = 0
    failed: int = 0
    linear: bool = False
    of: str = "mesh"
    where: str = "on a finer mesh"
    why: str = ""
    homogeneous: str = ""

    @property
    def place(self) -> str:
        """The place of the solves in words."""
        return f"{self.where} ({self.nodes} nodes)"

    def comparisons(self) -> list[Comparison]:
        """Return every figure with its limit."""
        return [
            *((f"mean of {n} would move by {f.value:+.2f} sd", f, LARGEST_MESH_SHIFT)
              for n, f in self.shift.items()),
            *((f"sd of {n} would change by a factor of {np.exp(f.value):.2f}", f,
               LARGEST_MESH_LOG_SD) for n, f in self.log_sd.items()),
        ]  # fmt: skip


@dataclass(frozen=True)
class Physics:
    """The outcome of the FEM runs.

    runs, failed : the numbers of runs, and of those that did not converge.
    failed_mass : the posterior mass on which FEM does not converge.
    smallest_J : the smallest det F in the body at any draw.
    unstable, asked : the numbers of draws at which FEM is at a saddle, and of those examined.
    """

    runs: int
    failed: int
    failed_mass: float
    smallest_J: float
    unstable: int
    asked: int


@dataclass(frozen=True)
class Tail:
    """The importance weights of the FEM runs that test the corrected map.

    k_hat : the Pareto shape of the tail of their weights; NaN where runs are too few.
    k_threshold : the largest Pareto shape at which their errors are trusted.
    ess : the effective number of runs.
    largest : the largest weight over the mean weight.
    spread : the sd of the log ratio of FEM's likelihood over the corrected map's.
    pool : the effective number of points under the corrected map.
    missed : the number of runs that FEM finds likely and the corrected map does not, where tests
        are too few to meet the mode that may be there.
    ends : the number of modes of FEM, found by descents, that neither draws nor map know.
    """

    k_hat: float
    k_threshold: float
    ess: float
    largest: float
    spread: float
    pool: float
    missed: int
    ends: int = 0


@dataclass(frozen=True)
class Evidence:
    """Everything that the verdict depends on.

    draws : the changes from the draws to FEM's posterior.
    corrected : the changes from the corrected map's posterior to FEM's.
    mean, sd : the mean and sd of each parameter under FEM, in its unit.
    misfit : the posterior predictive check of each observation.
    map_errors : the distance of the map's data from FEM's at the draws, in noise sd.
    mesh : the changes by a finer mesh.
    box : the ends of ranges that end the posterior in place of the data.
    noise : the noises that are inferred. forward : the kind of the forward map.
    """

    draws: Changes
    corrected: Changes
    mean: dict[str, Figure]
    sd: dict[str, Figure]
    sampling: Sampling
    physics: Physics
    tail: Tail
    misfit: dict[str, Misfit]
    map_errors: dict[str, float] = field(default_factory=dict)
    mesh: MeshChange = MeshChange(why="not asked")
    box: tuple[BoxEnd, ...] = ()
    noise: tuple[TakenUp, ...] = ()
    forward: str = ""
