r"""The expected information of data before there are any, and the choice of the next measurement.

**Information.** With :math:`g(x)` the data without noise as a function of the unknowns
x, :math:`\log\theta` or :math:`\theta` as the parameter's scale is, and S the covariance of the
data about it, the data hold the Fisher information

.. math:: F = J^T S^{-1} J, \qquad J = \partial g / \partial x, \qquad S = C + \alpha^2 V V^T

about x, with the noise's covariance C and, where many numbers share errors, their modes V and
size :math:`\alpha` (:mod:`calibrate.model_error.marginal`, which has :math:`S^{-1}` by
Woodbury's identity). With a normal prior of covariance P the posterior's covariance is about
:math:`(F + P^{-1})^{-1}`. S is in the data's units squared, F in one over those of x squared: none
for :math:`\log\theta`. How S changes with x is left out of F. For noise that is not Gaussian
:math:`C^{-1}` is the curvature :math:`-\partial^2_\mu \log p(y \mid \mu)` at :math:`y = \mu`: for
Student's t somewhat more than its information.

**Before data.** For each of some draws of the prior data is made,
:math:`y_r \sim p(y \mid x_r)`, and the covariance of its posterior :math:`p(x \mid y_r)` is found
by importance sampling (:mod:`calibrate.importance.proposals`), from draws of the prior and of a
Student's t about a Newton step from :math:`x_r`,

.. math:: w_i \propto \frac{p(x_i)\, p(y_r \mid x_i)}
                           {\beta\, p(x_i) + (1 - \beta)\, t_5(x_i;\, \hat x, Q)},
          \qquad Q = (F + P^{-1})^{-1},

with the prior's covariance P and the share :math:`\beta` of draws from the prior; :math:`\hat x`
and Q are then those of the weighted draws, and draws of that Student's t are added as those of a
third component (Cappe et al. 2008; Owen and Zhou 2000). If too few draws carry the weight, the
covariance is the first Q. Posteriors are averaged, not informations: by Jensen's inequality the
inverse of a mean information is less than the mean posterior covariance, and a box of a prior ends
where a Gaussian does not.

Data sets that are not measured yet differ in their shared errors: modes that depend on where points
were seen, as pins' modes do, are made of the mean :math:`g(x_r)` of each set, so that the errors of
all sets are one object with a leading axis. They are marginalised: y is Gaussian about g(x) with

.. math:: S_r(\alpha) = C + V_r V_r^T + \alpha^2 U_r U_r^T, \qquad V_r = V(g(x_r)),

the covariance of the noise, of errors of known size and of errors whose size :math:`\alpha` is
inferred, in the data's units squared. An error that is a share of the prediction follows x itself.
A fit to measured data does not know :math:`g(x_r)` and takes the data for it where points were seen
(:mod:`calibrate.model_error.kinds`).

Before data, a size that is inferred is integrated over its prior, with distribution function
:math:`\Phi`, by K values that are equally probable:

.. math:: p(y \mid x) = \frac1K \sum_{k=1}^K N\left(y;\, g(x),\, S_r(\alpha_k)\right), \qquad
          \alpha_k = \Phi^{-1}\left(\tfrac{k - 1/2}{K}\right).

If the size of an error is inferred, each data set takes another quantile of the size's prior, and F
is the information about x at that size. Gaussian data has no information about x and the size in
common, so that an unknown size widens x in second order only.

**Next measurement.** A candidate :math:`y' = g'(x) + \varepsilon'` with the information F' about x
would add to the present posterior, of covariance C,

.. math:: \Delta = \tfrac12 \log_2 \det\left(1 + C F'\right) \text{ bits},

where the map is linear over the posterior (Lindley 1956; Chaloner and Verdinelli 1995). The gain is
averaged over draws of the posterior; no data is simulated and no posterior sampled. A candidate has
its own noise only: an error that it would share with the present data is not counted.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.scipy.special import logsumexp

from calibrate.analysis.identifiability import combinations, prior_table
from calibrate.importance.proposals import Group, Kernels, PosteriorPoints
from calibrate.importance.weights import effective, normalised
from calibrate.measurements import Observation, Observations
from calibrate.model_error.algebra import check_algebra
from calibrate.model_error.marginal import Means, ModelError, times
from calibrate.noise import Noise, information_about_means
from calibrate.posterior import Posterior
from calibrate.statistical_model import Model
from calibrate.statistical_model.density import Heights, without_nan
from calibrate.statistical_model.errors import errors_of_data
from emulator.core.errors import InputError
from emulator.core.kept import kept

_DRAWS = 32  # draws of a posterior over which a gain is averaged
_DATA_SETS = 64
_FROM_PRIOR = 3072  # draws of the prior that all data sets share
_AROUND = 512  # draws of Student's t for each data set
_ROUNDS = 2  # proposals of a data set; the second is fitted to the draws before
_BATCH = 128
_EFFECTIVE = 30.0  # effective draws; below, the covariance of the linear map and a normal prior
_DOF = 5.0
_SIZES = 32  # values of an inferred size, equally probable
_WIDER = 1.3  # factor by which Student's t is wider than the estimated covariance


At = Callable[[jax.Array, ModelError, jax.Array], jax.Array]
"""The function of x (q,), the shared errors and their size () that returns the information F
(q, q)."""


def information_at(model: Model, observe: Observations, noise: Mapping[str, Noise]) -> At:
    """Return F of data ``observe`` with ``noise`` of known sd, as a function of x.

    Both may be other than the model's: a measurement to add, in all of its load states or some.

    Raises
    ------
    InputError
        A load state that the model does not have, or noise whose sd is inferred.
    """
    check_algebra("identifiability", noise, gaussian=False)
    names, known = model.states.unknowns, model.states.states
    for state in observe.states:
        if state not in known:
            problem = f"load state '{state}' is unknown" if state else "no load state is named"
            raise InputError(f"{problem}; known: {', '.join(filter(None, known)) or 'none'}")
    rows = np.array([known.index(state) for state in observe.states])
    predicted = observe.through(model.full)

    def data(x: jax.Array) -> tuple[jax.Array, dict[str, jax.Array]]:
        thetas = model.states.thetas(dict(zip(names, model.from_scales(x), strict=True)))[rows]
        means, _ = predicted(thetas)
        return ravel_pytree(means)[0], means

    def at(x: jax.Array, error: ModelError, size: jax.Array) -> jax.Array:
        J, means = jax.jacfwd(data, has_aux=True)(x)
        about_means = information_about_means(noise, means)
        return times(J.T, error.information_left(about_means, size, means)) @ J

    return at


def expected_precision(
    model: Model,
    at: Mapping[str, float] | None = None,
    *,
    systematic: Mapping[str, Mapping[str, Any]] | None = None,
    data_sets: int = _DATA_SETS,
    seed: int = 0,
) -> dict[str, Any]:
    """Return the precision expected of ``model``'s observations before any data, as plain JSON.

    Parameters
    ----------
    at : the unknowns by name at which the map is linearised, with a normal prior; by default the
        posteriors of ``data_sets`` data sets, made at draws of the prior, are averaged.
    systematic : errors that many numbers share, by name, as in an experiment file
        (:mod:`~calibrate.model_error.kinds`), made for each data set. Those of
        :func:`calibrate.with_systematic` are the model's already, the same for all data.

    Returns
    -------
    sd : the expected posterior sd of each unknown relative to the prior's, on its parameter's
        scale.
    combinations : the combinations of :func:`~calibrate.analysis.identifiability.identify` that
        the data would inform, from the mean posterior covariance.

    Raises
    ------
    InputError
        The forward map has no answer at any of the draws, noise has no known sd, or an error that
        does not fit.
    """
    errors: Errors = errors_of_data(model, systematic) if systematic else lambda _: model.error
    names, table = model.states.unknowns, prior_table(model)
    mean, prior = table.mean(axis=0), np.asarray(model.on_scales(table))
    before = np.atleast_2d(np.cov(prior, rowvar=False))
    if at is None:
        covariances = _posterior_covariances(model, errors, prior, before, data_sets, seed)
    else:
        means, valid = model.predict({name: jnp.asarray(float(at[name])) for name in names})
        _some(valid)
        error = errors(means)
        information_of = information_at(model, model.observe, model.noise)
        mean = np.array([float(at[name]) for name in names])
        x = model.on_scales(mean)
        by_size = jax.jit(jax.vmap(lambda size: information_of(x, error, size)))(sizes_of(error))
        covariances = np.linalg.inv(np.asarray(by_size) + np.linalg.inv(before))
    sd = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2)).mean(axis=0)
    ratio = sd / np.sqrt(np.diagonal(before))
    many = sum(int(np.prod(shape)) for shape in model.observe.shapes.values())
    best = combinations(model, covariances.mean(axis=0), before, mean)[:many]
    return {"sd": dict(zip(names, ratio.tolist(), strict=True)), "combinations": best}


class _DataPrograms:
    """The compiled functions of a model's unknowns x (q,) that all data sets share."""

    def __init__(self, model: Model) -> None:
        self.model = model
        self._information = information_at(model, model.observe, model.noise)
        self.log_priors = jax.jit(jax.vmap(self._log_prior))
        self.answers = jax.jit(partial(jax.lax.map, self._answer, batch_size=_BATCH))
        self.log_likelihoods = jax.jit(self._log_likelihoods)
        self.data_sets = jax.jit(partial(jax.lax.map, self._data_set))

    def _values(self, x: jax.Array) -> dict[str, jax.Array]:
        return dict(zip(self.model.states.unknowns, self.model.from_scales(x), strict=True))

    def _log_prior(self, x: jax.Array) -> jax.Array:
        jacobian = jnp.sum(jnp.where(self.model.on_log_scale, x, 0.0))
        return without_nan(self.model.log_prior(self._values(x)) + jacobian)

    def _answer(self, x: jax.Array) -> tuple[dict[str, jax.Array], jax.Array]:
        """Return the data without noise, and whether the map has an answer."""
        return self.model.predict(self._values(x))

    def _log_likelihood(self, answer: Any, data: Any, error: ModelError) -> jax.Array:
        means, valid = answer
        residual = {name: data[name] - mean for name, mean in means.items()}
        log_density = self.model.log_density({}, means, data)
        log_density += log_ratio(error, residual, means)
        return without_nan(jnp.where(valid, log_density, -jnp.inf))

    def _log_likelihoods(self, answers: Any, data: Any, error: ModelError) -> jax.Array:
        one = partial(self._log_likelihood, data=data, error=error)
        return jax.lax.map(one, answers, batch_size=_BATCH)

    def _data_set(self, inputs: tuple[Any, ...]) -> tuple[Any, jax.Array, jax.Array]:
        """Return data made at x (q,), F (q, q), and the log likelihood's slope (q,) there."""
        x, means, error, size, key = inputs
        noise_key, error_key = jax.random.split(key)
        means = error.draw(error_key, size, means)
        parts = self.model.distributions({}, means)
        keys = jax.random.split(noise_key, len(parts))
        data = {n: d.sample(k) for (n, d), k in zip(parts.items(), keys, strict=True)}
        slope = jax.grad(lambda x: self._log_likelihood(self._answer(x), data, error))(x)
        return data, self._information(x, error, size), slope


@kept
def _data_programs(model: Model) -> _DataPrograms:
    """Return the compiled functions of a model, which the model keeps."""
    return _DataPrograms(model)


def _posterior_covariances(
    model: Model, errors: Errors, prior: np.ndarray, before: np.ndarray, count: int, seed: int
) -> np.ndarray:
    """Return posterior covariances (r, q, q) given data made at draws of the prior's x (s, q)."""
    programs, shared = _data_programs(model), prior[count:][:_FROM_PRIOR]
    means, valid = programs.answers(prior[:count])
    rows = _some(valid)
    truths, means = prior[rows], {name: mean[rows] for name, mean in means.items()}
    set_errors = of_each(errors, means)
    keys = jax.random.split(jax.random.key(seed), count)[rows]
    sizes = sizes_of(set_errors, count)[rows]
    made = programs.data_sets((truths, means, set_errors, sizes, keys))
    log_prior, answers = np.asarray(programs.log_priors(shared)), programs.answers(shared)
    centre, precision = shared.mean(axis=0), np.linalg.inv(before)
    rng, covariances = np.random.default_rng(seed), []
    for k, x in enumerate(truths):
        of_set = jax.tree.map(lambda stacked, k=k: np.asarray(stacked[k]), (*made, set_errors))
        data, information, slope, error = of_set

        def log_densities(z: np.ndarray, x=x, data=data, error=error) -> Heights:  # noqa: ANN001
            inside = np.asarray(programs.log_priors(z))
            # The map may be undefined at points of prior density 0, so x takes their place.
            z = np.where(np.isfinite(inside)[:, None], z, x)
            return Heights(inside, programs.log_likelihoods(programs.answers(z), data, error))

        likelihood = programs.log_likelihoods(answers, data, error)
        points = PosteriorPoints(
            z=shared, at=Heights(log_prior, likelihood), priors=len(shared),
            log_kernels=np.zeros((0, len(shared))), log_densities=log_densities,
        )  # fmt: skip
        # A Newton step from the data's own x, in the linear map with a normal prior.
        normal = np.linalg.inv(information + precision)
        score = slope - precision @ (x - centre)
        start = x + normal @ np.where(np.isfinite(score), score, 0.0)
        covariances.append(_covariance(points, start, normal, rng))
    return np.stack(covariances)[_some(np.isfinite(covariances).all(axis=(1, 2)))]


def _covariance(
    points: PosteriorPoints, centre: np.ndarray, normal: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Return a posterior's covariance (q, q); NaN where it has no density.

    points : draws of the prior. centre, normal : the mean (q,) and covariance of the linear map's.
    """
    C = normal
    for _ in range(_ROUNDS):
        if not np.isfinite(C).all():
            break
        kernel = Group.at_mode(centre, _WIDER * np.linalg.cholesky(C), 1)
        points = points.extended(Kernels((kernel,), (1.0,), _DOF), _AROUND, rng)
        weights = normalised(points.log_weights)
        if not weights.any():
            return np.full_like(normal, np.nan)
        centre = weights @ points.z
        deviation = points.z - centre
        # A few draws that carry all weight hardly spread: their covariance would be too small.
        enough = effective(weights) >= _EFFECTIVE
        C = (weights[:, None] * deviation).T @ deviation if enough else normal
    return C


def _some(valid: Any) -> np.ndarray:
    """Return the indices at which ``valid`` is true; :class:`InputError` if there are none."""
    if not np.any(valid):
        raise InputError("identifiability: the forward map has no valid answer at any draw")
    return np.flatnonzero(valid)


Errors = Callable[[Mapping[str, Any]], ModelError]
"""The function of data without noise, by name, that returns the model's errors besides noise."""


def of_each(errors: Errors, means: Mapping[str, jax.Array]) -> ModelError:
    """Return the errors of all data sets, stacked along a leading axis; means (r, ...) by name."""
    arrays = {name: np.asarray(values) for name, values in means.items()}
    count = len(next(iter(arrays.values())))
    data_sets = ({name: values[k] for name, values in arrays.items()} for k in range(count))
    model_errors = [errors(data) for data in data_sets]
    leaves = zip(*map(jax.tree.leaves, model_errors), strict=True)
    structure = jax.tree.structure(model_errors[0])
    return jax.tree.unflatten(structure, [_stacked(alike) for alike in leaves])


def _stacked(arrays: Sequence[Any]) -> np.ndarray:
    """Return the arrays stacked, with zeros for missing rows: a mode of zeros changes nothing."""
    shape = np.max([np.shape(array) for array in arrays], axis=0).astype(int)
    stack = np.zeros((len(arrays), *shape))
    for k, array in enumerate(arrays):
        corner: tuple[int | slice, ...] = (k, *(slice(size) for size in np.shape(array)))
        stack[corner] = array
    return stack


def sizes_of(error: ModelError, count: int = _SIZES) -> jax.Array:
    """Return equally probable sizes (count,) of the error, 1 if its size is known."""
    prior = next(iter(error.priors.values()), None)
    return jnp.ones(count) if prior is None else prior.icdf((jnp.arange(count) + 0.5) / count)


def log_ratio(error: ModelError, residual: Means, means: Means) -> jax.Array:
    """Return an error's share () of the log likelihood of ``residual``."""
    sizes = sizes_of(error, _SIZES if error.priors else 1)
    log_ratios = jax.vmap(lambda size: error.log_ratio(size, residual, means))(sizes)
    return logsumexp(log_ratios) - jnp.log(len(sizes))


class Candidate(NamedTuple):
    """A possible measurement, with the knowledge expected from it.

    bits : expected information gain.
    sd : per unknown, its expected sd relative to the present one.
    """

    bits: float
    sd: dict[str, float]


def next_measurement(
    posterior: Posterior, candidates: Mapping[str, tuple[Observation, Noise]]
) -> dict[str, Candidate]:
    """Return the candidates by name, the most informative first.

    Parameters
    ----------
    candidates : an observation and its noise, of known sd, by name; in a body with several load
        states the name says in which, as in ``volume@diastole``.
    """
    model, draws = posterior.model, posterior.draws()
    table = np.stack([draws[name] for name in model.states.unknowns], axis=1)
    x = np.asarray(model.on_scales(table))
    covariance = np.atleast_2d(np.cov(x, rowvar=False))
    root = np.linalg.cholesky(covariance)
    rows = np.linspace(0, len(x) - 1, min(_DRAWS, len(x))).astype(int)
    gains_by_name = {}
    for name, (part, noise) in candidates.items():
        information_of = jax.jit(information_at(model, Observations({name: part}), {name: noise}))
        gains, ratios = [], []
        for k in rows:
            information = np.asarray(information_of(jnp.asarray(x[k]), ModelError(), jnp.ones(())))
            precision = np.eye(len(root)) + root.T @ information @ root
            gains.append(0.5 * np.linalg.slogdet(precision)[1] / np.log(2.0))
            after = root @ np.linalg.solve(precision, root.T)
            ratios.append(np.sqrt(np.diagonal(after) / np.diagonal(covariance)))
        sd = dict(zip(model.states.unknowns, np.mean(ratios, axis=0).tolist(), strict=True))
        gains_by_name[name] = Candidate(float(np.mean(gains)), sd)
    return dict(sorted(gains_by_name.items(), key=lambda item: -item[1].bits))
