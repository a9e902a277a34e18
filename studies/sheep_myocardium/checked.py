"""The certificate of a heart: what FEM changes of its posterior, judged by the library's limits.

FEM at draws of the posterior, which its emulator was not fitted to, weights these by the ratio of
FEM's likelihood over the emulator's. What that changes of means and standard deviations, the tail
of the weights and the chains are judged as :func:`calibrate.certify` judges (of correlations it
also asks, which takes more runs than thirty). All is in logarithms of parameters.

The mesh's error is taken off by its order (:func:`.solver.without_mesh`); what may be left of it
is three tenths of the correction, which an order of 1 or 2 in place of 1.2 would change of it.
"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import numpy as np
from scipy.special import softmax
from studies.common.output import Case
from studies.sheep_myocardium.campaign import Campaign, Plan, again, campaign, further
from studies.sheep_myocardium.experiment import Heart
from studies.sheep_myocardium.inference import Found, parameters
from studies.sheep_myocardium.solver import FINER

from calibrate.certificate.estimates import jackknife, moments
from calibrate.certificate.evidence import Changes, Evidence, Figure, MeshChange, Physics, Tail
from calibrate.certificate.verdict import Certificate, judge
from calibrate.importance.weights import pareto_shape
from calibrate.posterior.diagnosis import Sampling

_LEFT = 0.3  # of the mesh's correction
_MOST = 3  # sets of tests of one posterior


def logarithms(found: Found) -> dict[str, np.ndarray]:
    """Logarithms of parameters and omega, (d,) each."""
    each = {name: np.log(found.theta(name)) for name in parameters(found.law)}
    return each | {"omega": np.log(found.draws["omega"])}


def certificate(found: Campaign) -> Certificate:
    """FEM's at the tests, and the mesh's."""
    explored, differences = found.explored, found.likelihood_differences()
    sound = np.isfinite(differences)
    named = logarithms(explored)
    x = np.stack(list(named.values()), axis=1)[found.tested][sound]
    log_ratio = differences[sound]
    weights = softmax(log_ratio) * len(log_ratio)
    p = len(named)

    def change(used: np.ndarray) -> np.ndarray:
        return moments(x, weights * used)[: 2 * p] - moments(x, 1.0 * used)[: 2 * p]

    value, error = jackknife(change, len(x))
    sd = np.stack(list(named.values()), axis=1).std(axis=0)
    changes = Changes(
        _figures(named, value[:p] / sd, error[:p] / sd), _figures(named, value[p:], error[p:]), {}
    )
    tail = Tail(
        pareto_shape(log_ratio),
        float(min(1.0 - 1.0 / np.log10(max(len(x), 10)), 0.7)),
        float(weights.sum() ** 2 / (weights**2).sum()),
        float(weights.max()),
        float(log_ratio.std()),
        explored.least_ess,
        0,
    )
    failed = int((~sound).sum())
    physics = Physics(len(sound), failed, failed / len(sound), float("nan"), 0, 0)
    sampling = Sampling(
        explored.worst_rhat, explored.least_ess, explored.least_ess, explored.divergences,
        len(explored.positions),
    )  # fmt: skip
    mesh = MeshChange(
        *_mesh(found), nodes=(2 * FINER + 1) ** 3, runs=sum(len(r.x) for r in found.meshes[1])
    )
    there = np.stack(list(named.values()), axis=1)
    means = _figures(named, there.mean(axis=0) + value[:p], error[:p])
    by_fem = sd * np.exp(value[p:])
    sds = _figures(named, by_fem, by_fem * error[p:])
    return judge(Evidence(changes, changes, means, sds, sampling, physics, tail, {}, mesh=mesh))


def decided(heart: Heart, plan: Plan, kept: Path | None, seed: int) -> Campaign:
    """A heart's campaign, until its certificate is accepted or it was tested often enough.

    Where too few tests leave the verdict open there are more of the same posterior; where these
    leave it open too, or say that the map is wrong, they become runs of another.
    """
    found = campaign(heart, plan, kept, seed)
    for left in reversed(range(plan.again + 1)):
        given = certificate(found)
        print(f"{heart.name}, {found.seconds:.0f} s: {given}", flush=True)
        if given.verdict == "accepted" or not left:
            break
        few = given.verdict == "undecided" and len(found.tested) < _MOST * plan.tests
        found = (further if few else again)(found, plan, kept, seed)
    return found


def _figures(
    names: dict[str, np.ndarray], value: np.ndarray, error: np.ndarray
) -> dict[str, Figure]:
    return {n: Figure(float(v), float(e)) for n, v, e in zip(names, value, error, strict=True)}


def _mesh(found: Campaign) -> tuple[dict[str, Figure], dict[str, Figure]]:
    """What may be left of the mesh's error, of means and standard deviations of logarithms.

    Draws are weighted by the ratio of the likelihoods with that error and without.
    """
    differences = found.mesh_differences()
    weights = softmax(differences) * len(differences)
    # Of weights that are not smoothed these errors are 1.3 to 2.3 times too large (Gaussians).
    root = np.sqrt(found.explored.least_ess)
    moved, spread = {}, {}
    for name, x in logarithms(found.explored).items():
        z = (x - x.mean()) / x.std()
        shift = (weights * z).mean()
        change = 0.5 * np.log((weights * (z - shift) ** 2).mean())
        error = ((weights - 1.0) * z).std() / root
        moved[name] = Figure(-_LEFT * float(shift), _LEFT * float(error))
        error = 0.5 * ((weights - 1.0) * z**2).std() / root
        spread[name] = Figure(-_LEFT * float(change), _LEFT * float(error))
    return moved, spread


def told(found: Campaign) -> Case:
    """Errors of the emulators at draws of the posterior, and what FEM changes of it."""
    errors = np.abs(found.by_map / found.by_fem - 1.0)
    given = certificate(found)
    return {
        "fem": {
            "runs_a_cube": found.runs_a_cube,
            "seconds": found.seconds,
            "error_median": float(np.nanmedian(errors)),
            "error_90": float(np.nanquantile(errors, 0.9)),
            "doubt_by_round": list(found.learned.doubt),
            "sd_of_log_likelihood_difference": float(np.nanstd(found.likelihood_differences())),
        },
        "certificate": {
            "verdict": given.verdict,
            "reason": given.reason,
            "findings": list(given.findings),
            "shift": given.shift,
            "mesh_shift": {n: f.value for n, f in given.evidence.mesh.shift.items()},
            "sampling": asdict(given.evidence.sampling),
            "tail": asdict(given.evidence.tail),
        },
    }
