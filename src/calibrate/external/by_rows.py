r"""What a table of runs says of a posterior, without a solver that could make more.

The posterior allows for the emulator's error: data have Gaussian noise and an error of the
emulator, whose covariance over the outputs is that of errors at rows that are left out (sds by
their 90 % quantile over a Gaussian's). Outputs of one run are wrong together: taken for independent
ones, 26 errors that are nearly one would pass for 26 facts.

The verdict asks what a certificate asks, by how much the true solver would move the posterior, of
what the rows leave open: error functions :math:`e_s` of the emulator are drawn from its process
given all rows, jointly at draws of the posterior, which get the weights

.. math:: w_s \propto \exp[\log L(\hat y + e_s) - \log L(\hat y)] ,

and the root mean square over s of the moves of a mean is compared with the limit of a certificate.
It rests on the process, whose sds were widened by what they missed at rows kept apart
(:mod:`emulator.external.rows`), and not on runs at the posterior: there are none.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from calibrate.certificate.estimates import misfits, sampling_of
from calibrate.certificate.evidence import Changes, Evidence, Figure, MeshChange, Physics, Tail
from calibrate.certificate.verdict import Certificate, judge
from calibrate.importance.proposals import key_from
from calibrate.importance.weights import effective, normalised
from calibrate.posterior import Posterior
from calibrate.project.problem import Problem
from calibrate.state_names import split
from calibrate.statistical_model.predictive import Predictive
from emulator.core.errors import InputError
from emulator.external.rows import RowsMap, correlations, process_in, samples_of
from emulator.surrogates.correction import no_correction
from emulator.surrogates.discrepancy import maximin_subset

NEXT = "next_runs.csv"
"""The file of the runs that would say most, in the folder of a posterior."""
_DRAWS, _FUNCTIONS = 400, 256  # of the posterior, and of the emulator's error
_NEXT, _CANDIDATES = 8, 4  # runs to make next, each of so many draws
_NORMAL_90 = 1.6449
_LEAST_MODE = 1e-8  # of the largest variance: below it a mode is left to the noise
EMULATOR_ERROR = "emulator"
"""The name of an emulator's error among the systematic ones."""


def with_emulator_error(problem: Problem) -> Problem:
    """Return the problem of a table with the emulator's error besides the noise.

    Beside a noise whose sd is inferred, or that is not Gaussian, errors that go together cannot be
    integrated out: each known sd is then widened by its own error.
    """
    run, process = problem.run, process_in(problem.scene)
    assert isinstance(run.noise, Mapping)
    noises = problem.observe.expand(run.noise, "noise")
    known = {name: sd for name, (_, sd) in noises.items() if isinstance(sd, int | float)}
    if len(known) < len(noises):
        widened = dict(run.noise)
        for name, sd in known.items():
            sds = _sds(process.left_out[:, problem.observe.parts[name].nodes])
            widened[noises[name][0]] = float(np.hypot(sd, np.sqrt(np.mean(sds**2))))
        return replace(problem, run=replace(run, noise=widened))
    errors, of_state = {}, dict[str, list[str]]()
    for name in problem.observe.parts:
        of_state.setdefault(split(name)[1], []).append(name)
    for state, names in of_state.items():
        outputs = np.concatenate([problem.observe.parts[name].nodes for name in names])
        modes = error_modes(process.left_out[:, outputs])
        errors[f"{EMULATOR_ERROR} {state}".strip()] = {
            "kind": "modes",
            "of": "+".join(names),
            "modes": modes.tolist(),
        }
    return replace(problem, run=replace(run, systematic={**run.systematic, **errors}))


def error_modes(errors: np.ndarray) -> np.ndarray:
    r"""Return the modes V (s, n) of the covariance :math:`C = V^T V` of errors (c, n).

    The sds :math:`s_j` are 90 % quantiles over a Gaussian's, so that a few far errors do not set
    them. With correlations R, the modes follow from
    :math:`C_{jk} = s_j R_{jk} s_k = Q \Lambda Q^T` as :math:`V = \Lambda^{1/2} Q^T`.
    """
    sds = _sds(errors)
    values, vectors = np.linalg.eigh(np.outer(sds, sds) * correlations(errors))
    used = values > _LEAST_MODE * values[-1]
    return (vectors[:, used] * np.sqrt(values[used])).T


def _sds(errors: np.ndarray) -> np.ndarray:
    return np.quantile(np.abs(errors), 0.9, axis=0) / _NORMAL_90


class _Moves(NamedTuple):
    """Moves of means in sd (f, p) and of log sds (f, p) by f functions, and effective draws."""

    means: np.ndarray
    log_sds: np.ndarray
    effective: np.ndarray


def examine_rows(posterior: Posterior, folder: Path | None = None, seed: int = 0) -> Certificate:
    """Return the certificate that a table of runs allows.

    folder : where :data:`NEXT` is written, if anywhere.

    :class:`InputError` for a posterior of another forward map.
    """
    model, full = posterior.model, posterior.model.full
    if not isinstance(full, RowsMap):
        raise InputError("this posterior is not of a table's rows")
    rng = np.random.default_rng(seed)
    every = posterior.draws()
    count = len(next(iter(every.values())))
    rows = rng.choice(count, size=min(_DRAWS, count), replace=False)
    draws = {name: values[rows] for name, values in every.items()}
    thetas = np.asarray(model.states.thetas(draws))
    moves, sds = _moves(posterior, full, draws, thetas, rng)
    names = model.names
    shift = {n: _figure(moves.means[:, k]) for k, n in enumerate(names)}
    log_sd = {n: _figure(moves.log_sds[:, k]) for k, n in enumerate(names)}
    changes = Changes(shift, log_sd)
    predictive = Predictive(model, posterior.data, every)
    none = no_correction(1, len(model.states.unknowns), len(predictive.scales))
    z = predictive.unconstrain(draws)
    evidence = Evidence(
        changes,
        changes,
        {},
        {},
        sampling_of(posterior),
        Physics(0, 0, 0.0, np.nan, 0, 0),
        Tail(np.nan, np.nan, float(moves.effective.mean()), 1.0, 0.0, np.inf, 0),
        misfits(predictive, none, z, key_from(rng)),
        mesh=MeshChange(why="its mesh is another program's, which only that one can refine"),
        box=tuple(posterior.box_ends()),
        noise=tuple(posterior.inferred_noise()),
        forward=full.kind,
    )
    certificate = judge(evidence)
    findings = [*certificate.findings, _basis(full)]
    if folder is not None:
        _write_next(full, thetas, sds, folder / NEXT)
        findings.append(f"the runs that would say most are in {folder / NEXT}")
    return replace(certificate, findings=tuple(findings))


def _basis(full: RowsMap) -> str:
    rows = samples_of(full.scene)
    return (
        f"by {len(rows.theta)} rows ({rows.failed} without an output and {rows.repeated} that are "
        "there before are left out), no run was made: it holds if the solver is as smooth where "
        "the posterior is as at rows that were left out"
    )


def _figure(moves: np.ndarray) -> Figure:
    """Return the root mean square of moves (f,), which so many functions tell to a few per cent."""
    return Figure(float(np.sqrt(np.mean(moves**2))), 0.0)


def _moves(
    posterior: Posterior,
    full: RowsMap,
    draws: Mapping[str, np.ndarray],
    thetas: np.ndarray,
    rng: np.random.Generator,
) -> tuple[_Moves, np.ndarray]:
    """Return moves by error functions drawn at ``thetas`` (s, S, p), and sds (s, S, n) there."""
    model, data = posterior.model, posterior.data
    nodes = model.observe.nodes
    points = thetas.reshape(-1, thetas.shape[-1])
    errors, sds = full.drawn_errors(points, nodes, _FUNCTIONS, rng)  # (f, a, k), (a, k)
    errors = errors.reshape(len(errors), *thetas.shape[:2], -1)
    predicted = jax.jit(jax.vmap(full.at(nodes)))(jnp.asarray(points))
    u = predicted.reshape(*thetas.shape[:2], len(nodes), 3)

    @jax.jit
    def likelihood(u: jax.Array, thetas: jax.Array, draw: Any, added: jax.Array) -> jax.Array:
        means = model.observe(u.at[..., 0].add(added), thetas)
        return model.log_likelihood(draw, means, data)

    of_draws = jax.jit(jax.vmap(likelihood))
    stacked = {name: jnp.asarray(values) for name, values in draws.items()}
    base = of_draws(u, thetas, stacked, jnp.zeros(u.shape[:-1]))
    x = np.stack([draws[name] for name in model.names], axis=1)
    mean, sd = x.mean(axis=0), x.std(axis=0)
    sd = np.where(sd > 0.0, sd, 1.0)
    means, logs, sizes = [], [], []
    for error in errors:
        with np.errstate(over="ignore"):
            weights = normalised(
                np.asarray(of_draws(u, thetas, stacked, jnp.asarray(error)) - base)
            )
        shifted = weights @ x
        spread = np.sqrt(np.maximum(weights @ (x - shifted) ** 2, 1e-300))
        means.append((shifted - mean) / sd)
        logs.append(np.log(spread / sd))
        sizes.append(effective(weights))
    return _Moves(np.stack(means), np.stack(logs), np.array(sizes)), sds.reshape(
        *thetas.shape[:2], -1
    )


def _write_next(full: RowsMap, thetas: np.ndarray, sds: np.ndarray, path: Path) -> None:
    """Write theta at which a run would say most: where errors are large, and far apart."""
    scene = full.scene
    doubt = (sds / sds.mean(axis=(0, 1))).mean(axis=2)  # (s, S)
    points, doubt = thetas.reshape(-1, thetas.shape[-1]), doubt.ravel()
    most = np.argsort(-doubt)[: max(len(doubt) // _CANDIDATES, _NEXT)]
    positions = np.asarray(scene.to_unit(jnp.asarray(points[most])))
    rows = most[maximin_subset(positions, min(_NEXT, len(most)))]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(scene.parameter_names)
        writer.writerows([[f"{value:.8g}" for value in points[row]] for row in rows])
