r"""The terms of a law that a test supports: all sets of terms, compared by their evidence.

The evidence is that of :mod:`calibrate.analysis.term_sets`. It says which set is likeliest, not
that any is right. So each test is left out in turn, and predicted by all sets with the
probabilities and moduli that the other tests give them (:class:`HeldOut`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from scipy.special import bdtr

from calibrate.analysis.term_sets import PRESENT, posterior_of_sets, seen_columns
from calibrate.measurements.specimens import SpecimenCurves
from calibrate.model_error.algebra import check_algebra
from calibrate.noise import information_about_means
from calibrate.statistical_model.model import Model
from emulator.core.display import TableRepr
from emulator.core.errors import InputError

_MINOR = 1e-3  # share of the likeliest set's probability below which a set predicts nothing
_TAIL = 0.05  # outside either end of a band
_MISSED = 0.7  # share of points inside the 90 % band below which a test is not predicted, and
_CHANCE = 1e-3  # probability of no more points inside, were their errors independent
_BETTER = 0.05  # log density of a point by which another set predicts better
_LISTED = 5  # sets that are told
_LINEAR = 1e-6  # share of the data by which a linear map may miss the forward map


@dataclass(frozen=True)
class HeldOut:
    """The prediction of one test from the others; a point is one number of its data.

    test : its name.
    points : the number of its points.
    error : the root mean square error of the mean prediction, as a share of that of zero. Points
        are in sds of their noise.
    in_noise : the same error, in sds of the noise as the other tests have it.
    inside : the share of points inside the 90 % predictive band, noise included.
    of_sets : the log predictive density of a point, on average, by each set of ``Terms.sets``.
    alone : terms that no other test shows, without which it is predicted.
    """

    test: str
    points: int
    error: float
    in_noise: float
    inside: float
    of_sets: Sequence[float]
    alone: tuple[str, ...]

    head: ClassVar = ("left out", "points", "error", "error / noise sd", "inside 90 % band")

    @property
    def missed(self) -> bool:
        """True if too few points of the test are inside the band that the other tests predict."""
        chance = bdtr(round(self.inside * self.points), self.points, 1.0 - 2.0 * _TAIL)
        return self.inside < _MISSED and bool(chance < _CHANCE)

    @property
    def cells(self) -> tuple[str, ...]:
        """The test as a row of a table under ``head``."""
        error, inside = f"{100.0 * self.error:.2g} %", f"{100.0 * self.inside:.0f} %"
        return self.test, str(self.points), error, f"{self.in_noise:.2f}", inside


@dataclass(frozen=True, repr=False)
class Terms(TableRepr):
    """The probabilities of a law's terms given data.

    probabilities : the posterior probability of each term, by its modulus.
    sets : the likeliest sets, and the probability of each.
    moduli : mean and sd of each modulus in kPa, where its term is present.
    noise : the posterior mean of the noise's size, as a factor of the model's.
    held_out : of each test, how the others predict it; empty where there is one test.
    """

    probabilities: Mapping[str, float]
    sets: Sequence[tuple[tuple[str, ...], float]]
    moduli: Mapping[str, tuple[float, float]]
    noise: float
    held_out: Sequence[HeldOut] = ()

    @property
    def undecided(self) -> tuple[str, ...]:
        """Terms whose presence the data leave open."""
        return tuple(name for name, p in self.probabilities.items() if 0.05 < p < 0.95)

    @property
    def log_densities(self) -> Sequence[float]:
        """The log predictive density of a held-out point, on average, by each of ``sets``.

        Tests that alone show a term do not count; it is empty without others.
        """
        rows = [(report.points, report.of_sets) for report in self.held_out if not report.alone]
        if not rows:
            return []
        points, by_test = zip(*rows, strict=True)
        return [float(x) for x in np.average(by_test, axis=0, weights=points)]

    def held_out_in_words(self) -> str:
        """Describe which tests the others do not predict, and which set predicts best."""
        words = []
        for report in self.held_out:
            if report.missed:
                alone = f", which alone shows {', '.join(report.alone)}" if report.alone else ""
                words.append(f"the others do not predict '{report.test}'{alone}")
        words = words or ["each test is predicted by the others"]
        if scores := self.log_densities:
            best = int(np.argmax(scores)) if max(scores) > scores[0] + _BETTER else 0
            names = ", ".join(self.sets[best][0]) or "no term" if best else "no other set"
            words.append(f"{names} predicts better than the likeliest set")
        return "; ".join(words)

    def summary_rows(self) -> tuple[str, list[tuple[str, str]]]:
        """Return the title and a row for each term, the likeliest first."""
        ranked = sorted(self.probabilities.items(), key=lambda item: -item[1])
        rows = []
        for name, probability in ranked:
            known = self.moduli.get(name)
            size = "" if known is None else f", {known[0]:.3g} +- {known[1]:.2g} kPa"
            rows.append((name, f"{probability:.3f}{size if probability > 0.05 else ''}"))
        if self.undecided:
            rows.append(("undecided", ", ".join(self.undecided)))
        if self.held_out:
            rows.append(("held out", self.held_out_in_words()))
        return "Probability of each term", rows


def find_terms(
    model: Model, data: Mapping[str, Any] | np.ndarray, *, held_out: bool = True
) -> Terms:
    """Return which of the moduli of ``model``'s scene are not zero.

    Every unknown of the scene is such a modulus. The noise is the model's, its inferred sds in the
    ratio of their priors' scales, times a factor with a log-uniform prior between a thousandth and
    a third of the size of the data.

    held_out : whether each test is predicted by the others, too.

    Raises
    ------
    InputError
        Data that the map does not predict linearly in the unknowns, as where a free stretch depends
        on them; an unknown that is no modulus; noise that is not Gaussian; no data.
    """
    white = _whitening(model)
    y = white @ np.asarray(ravel_pytree(dict(model.check_data(data)))[0])
    G = white @ _design(model)
    if not y.size or not np.any(y):
        raise InputError("terms: all data are zero, or there are none")
    names = model.forward.scene.parameter_names
    terms = _compared(G, y, names)
    if not held_out:
        return terms
    return replace(terms, held_out=_held_out(_of_tests(model), white, G, y, terms))


def _of_tests(model: Model) -> dict[str, np.ndarray]:
    """Return the entries (k,) of each test in the data as ``ravel_pytree`` orders them."""
    entries, begin = dict[str, list[np.ndarray]](), 0
    for name, part in sorted(model.observe.parts.items()):
        if isinstance(part, SpecimenCurves):
            for test, rows in part.tests(model.observe.entries.get(name)).items():
                entries.setdefault(test, []).append(begin + rows)
        begin += int(np.prod(model.observe.shapes[name]))
    return {test: np.concatenate(rows) for test, rows in entries.items()}


def _whitening(model: Model) -> np.ndarray:
    """Return the matrix (n, n) that makes the noise independent, of sd 1."""
    check_algebra("terms", model.noise, known=False)
    # A half-normal prior's scale: its mean over that of a standard one.
    scales = {
        name: {key: prior.mean * np.sqrt(np.pi / 2.0) for key, prior in noise.priors.items()}
        for name, noise in model.noise.items()
    }
    means = {name: jnp.zeros(shape) for name, shape in model.observe.shapes.items()}
    information = np.asarray(information_about_means(model.noise, means, scales))
    return np.linalg.cholesky(np.diag(information) if information.ndim == 1 else information).T


def _design(model: Model) -> np.ndarray:
    """Return the data (n, p) that one unit of each modulus makes."""
    scene, observe, forward = model.forward.scene, model.observe, model.forward
    for parameter in scene.parameters:
        if parameter.unit != "kPa" or parameter.scale != "uniform":
            raise InputError(
                f"terms: '{parameter.name}' is no modulus on a uniform scale; make every unknown "
                "one in kPa, or a constant"
            )

    @jax.jit
    def predicted(theta: jax.Array) -> jax.Array:
        return ravel_pytree(observe(forward(theta)[None], theta[None]))[0]

    theta = scene.centre
    G = np.asarray(jax.jacfwd(predicted)(theta))
    for golden in (0.618, 0.382):  # uneven: equal factors of all moduli change no stretch
        other = scene.from_unit(golden * jnp.arange(1, len(theta) + 1) % 1.0)
        exact = np.asarray(predicted(other))
        if not np.abs(G @ np.asarray(other) - exact).max() <= _LINEAR * np.abs(exact).max():
            raise InputError(
                "terms: the data are not linear in the moduli; take an incompressible map and "
                "tests whose in-plane stretches are all measured"
            )
    return G


def _compared(G: np.ndarray, y: np.ndarray, names: Sequence[str]) -> Terms:
    """Compare all sets of terms by evidence; terms with a zero column of G keep their prior."""
    posterior = posterior_of_sets(G, y, names)
    best = np.argsort(-posterior.of_sets)[:_LISTED]
    return Terms(
        dict.fromkeys(names, PRESENT) | posterior.of_terms,
        [(posterior.terms(i), float(posterior.of_sets[i])) for i in best],
        posterior.moments,
        posterior.noise,
    )


def _held_out(
    tests: Mapping[str, np.ndarray], white: np.ndarray, G: np.ndarray, y: np.ndarray, terms: Terms
) -> list[HeldOut]:
    """Predict each of ``tests`` whose data are not zero from the others.

    white : the matrix (n, n) that made the errors of y (n,) independent.
    """
    tests = {test: rows for test, rows in tests.items() if np.any(y[rows])}
    names, reports = list(terms.probabilities), list[HeldOut]()
    for test, rows in tests.items() if len(tests) > 1 else ():
        rest = np.setdiff1d(np.arange(len(y)), rows)
        posterior, known = posterior_of_sets(G[rest], y[rest], names), seen_columns(G[rest])
        # Errors correlate within a test, not between two, so its rows are whitened by themselves.
        to_data = np.linalg.inv(white[np.ix_(rows, rows)])
        to_data /= np.linalg.norm(to_data, axis=1)[:, None]  # each point in sds of its noise
        data, columns = to_data @ y[rows], to_data @ G[rows]
        number = {posterior.terms(i): i for i in range(len(posterior.sets))}
        listed = [number[tuple(n for n in S if n in posterior.names)] for S, _ in terms.sets]
        likely = np.flatnonzero(posterior.of_sets > _MINOR * posterior.of_sets.max())
        by_set = {i: posterior.predicted(i, data, columns[:, known]) for i in {*likely, *listed}}
        shares = posterior.of_sets[likely] / posterior.of_sets[likely].sum()
        mean, below = (shares @ np.stack([by_set[i][k] for i in likely]) for k in (0, 1))
        error = float(np.sqrt(np.mean((data - mean) ** 2)))
        size = float(np.sqrt(np.mean(data**2)))
        inside = float(np.mean(np.abs(below - 0.5) < 0.5 - _TAIL))
        densities = [float(by_set[i][2].mean()) for i in listed]
        alone = tuple(names[k] for k in seen_columns(columns) if k not in known)
        errors = error / size, error / posterior.noise
        reports.append(HeldOut(test, len(rows), *errors, inside, densities, alone))
    return reports
