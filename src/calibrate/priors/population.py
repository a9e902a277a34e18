r"""A population as a prior: medians, spreads and correlations of log parameters.

.. math:: \log\theta \sim N(\log \text{median},\ D R D), \qquad D = \text{diag(log\_sd)}

each parameter cut to its scene's range, the correlations of the normal scores kept
(:class:`~calibrate.priors.JointPrior`). A population is a few numbers in a JSON file, so that the
numbers of another cohort are one argument, ``--prior FILE``:

.. code-block:: json

    {"median": {"a": 0.32, "a_f": 5.6}, "log_sd": {"a": 0.24, "a_f": 0.31},
     "correlation": {"a,a_f": -0.57}, "source": "who measured it, and on whom"}

Parameters it does not name have the scene's range as their prior.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from calibrate.priors.priors import Dependence, JointPrior, Prior, log_normal, truncated
from emulator.core import schema
from emulator.core.errors import InputError
from emulator.scenes.forward_problem import ForwardProblem

BOX = "box"
"""The name of the prior that is uniform over a scene's range, on its scales."""


@dataclass(frozen=True)
class Population:
    """Correlated log-normals.

    median : median by parameter, in its unit.
    log_sd : sd of the logarithm by parameter, about its relative sd.
    correlation : of the logarithms, by two names joined by a comma; 0 where none is given.
    source : where the numbers are from, of all parameters or by parameter.

    Raises
    ------
    InputError
        Numbers that do not fit each other.
    """

    median: dict[str, float]
    log_sd: dict[str, float]
    correlation: dict[str, float] = field(default_factory=dict)
    source: str | dict[str, str] = ""

    def __post_init__(self) -> None:
        if not self.median or set(self.median) != set(self.log_sd):
            raise InputError("median and log_sd: give both of each parameter, one or more")
        for name in self.median:
            log_normal(self.median[name], self.log_sd[name])  # refuses what is not above 0
        self.dependence  # noqa: B018 - refused here, not where it is used

    @property
    def dependence(self) -> Dependence | None:
        """The correlations of those that are correlated, as a matrix; None without any."""
        if not self.correlation:
            return None
        correlated = {word.strip() for pair in self.correlation for word in pair.split(",")}
        names = tuple(name for name in self.median if name in correlated)
        matrix = np.eye(len(names))
        for pair, value in self.correlation.items():
            ends = tuple(word.strip() for word in pair.split(","))
            if len(ends) != 2 or ends[0] == ends[1] or not set(ends) <= set(names):
                raise InputError(
                    f"correlation '{pair}': give two of {', '.join(self.median)}, joined by a comma"
                )
            i, j = map(names.index, ends)
            matrix[i, j] = matrix[j, i] = value
        return Dependence(names, matrix)

    @property
    def by_parameter(self) -> dict[str, dict[str, Any]]:
        """Median, log_sd and source of each parameter, by its name."""
        sources = self.source
        if isinstance(sources, str):
            sources = dict.fromkeys(self.median, sources)
        return {
            name: {
                "median": median,
                "log_sd": self.log_sd[name],
                "source": sources.get(name, ""),
            }
            for name, median in self.median.items()
        }

    def prior(self, scene: ForwardProblem) -> Prior:
        """Return the population as the prior of ``scene``, cut to its range.

        :class:`InputError` for a parameter that the scene does not have, or that lies outside its
        range.
        """
        for name in self.median:
            if name not in scene.parameter_names:
                raise InputError(
                    f"the population is of '{name}'; scene '{scene.name}' has "
                    f"{', '.join(scene.parameter_names)}"
                )
        priors = {name: log_normal(self.median[name], self.log_sd[name]) for name in self.median}
        cut = truncated(priors, scene)
        return JointPrior(cut, self.dependence) if self.dependence else cut


def population_of_fits(fits: Mapping[str, Sequence[float]], source: str = "") -> Population:
    """Return the population of subjects with these fitted parameters, by name, each (n,).

    Its numbers are medians, sds and correlations of the logarithms. The scatter of fits contains
    the errors of the fits: where those are large, it is wider than the subjects' own.

    Raises
    ------
    InputError
        Fewer than p + 2 subjects for p parameters, or values that are not above 0.
    """
    table = np.array(list(fits.values()), dtype=float)
    if table.ndim != 2 or table.shape[1] < len(table) + 2:
        raise InputError(
            f"population of {len(fits)} parameters: give {len(fits) + 2} subjects or more, each "
            "with all of them"
        )
    if not (np.isfinite(table).all() and (table > 0.0).all()):
        raise InputError("population: fitted parameters must be above 0 and finite")
    logs, names = np.log(table), list(fits)
    matrix = np.atleast_2d(np.corrcoef(logs))
    pairs = [(i, j) for i in range(len(names)) for j in range(i)]
    return Population(
        median=dict(zip(names, map(float, np.exp(logs.mean(axis=1))), strict=True)),
        log_sd=dict(zip(names, map(float, logs.std(axis=1, ddof=1)), strict=True)),
        correlation={f"{names[j]},{names[i]}": float(matrix[i, j]) for i, j in pairs},
        source=source,
    )


def in_words(priors: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return a line for each source of the priors of :attr:`Population.by_parameter`."""
    by_source = dict[str, list[str]]()
    for name, entry in priors.items():
        numbers = f"{name} {entry['median']:.4g} (log sd {entry['log_sd']:.2g})"
        by_source.setdefault(entry["source"] or "no source given", []).append(numbers)
    return [f"prior median of {', '.join(words)}: {source}" for source, words in by_source.items()]


VENTRICLES = Population(
    median={"a": 0.322, "b": 2.05, "a_f": 5.57, "b_f": 2.11},
    log_sd={"a": 0.239, "b": 0.359, "a_f": 0.310, "b_f": 0.374},
    correlation={"a,a_f": -0.574, "a,b_f": 0.472, "a_f,b_f": -0.911},
    source="medians and sds: range of Dalton, Husmeier & Gao (2023), Section 3.4, as +- 2 sd; "
    "correlations: covariance of one volunteer's estimate, released with Davies et al. (2019)",
)
"""Holzapfel-Ogden parameters of human left ventricles (textbook form, kPa), a weak default.

No table of a cohort's fits was at hand. Medians and sds make the range that Dalton et al. (2023)
train over for healthy hearts, with ``a`` and ``a_f`` in textbook form, the central 95 %. The
correlations are those of the *estimate* for one healthy volunteer (V. Davies et al., Fast parameter
inference in a biomechanical model of the left ventricle by using statistical emulation, JRSS C 68,
2019; ``hv_data_cov_matrix_patient_1.txt`` of its repository: 0.149, 0.0761 and 0.314 on the
diagonal, -0.0612, 0.102 and -0.141 beside it, of the factors of a, a_f and b_f at 1.00, 0.99 and
1.01). They say along which ridge fits scatter, not how people differ. ``b``, scaled together with
``a`` there, is left uncorrelated.
"""

POPULATIONS = {"ventricles": VENTRICLES}


def prior_of(description: str | Mapping[str, Any], scene: ForwardProblem) -> Prior | None:
    """Return the prior of a run: that of a population by name or numbers; ``None`` for ``box``.

    :class:`InputError` for an unknown name, or a population that does not fit the scene.
    """
    population = population_called(description)
    return None if population is None else population.prior(scene)


def population_called(description: str | Mapping[str, Any]) -> Population | None:
    """Return the population of a run's prior, by name or numbers; ``None`` for ``box``."""
    if description == BOX:
        return None
    if not isinstance(description, str):
        return schema.read_as(Population, description, "prior")
    if description not in POPULATIONS:
        known = ", ".join((BOX, *POPULATIONS))
        raise InputError(f"prior '{description}' is unknown; known: {known}, or a file")
    return POPULATIONS[description]
