r"""The population that seven hearts are of, and an eighth.

.. math:: \log\theta_h = \mu + \mathrm{diag}(\sigma)\, z_h, \quad z_h \sim N(0, I), \qquad
          \mu \sim N(\mu_0, 1), \quad \sigma \sim N^+(0, 0.5)

for the eight parameters of the orthotropic law; the fraction :math:`\omega` by which modes are off
likewise. Sampled jointly with all hearts, angles included. An eighth heart is a fresh z.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from studies.sheep_myocardium import cube
from studies.sheep_myocardium.campaign import Campaign
from studies.sheep_myocardium.chains import by_chain, marked, sampler, side_by_side
from studies.sheep_myocardium.inference import (
    ANGLE_SD,
    Seen,
    least_ess,
    log_likelihoods,
    means,
    r_hat,
    seen,
)
from studies.sheep_myocardium.moves import unknown

NAMES = (*(p.name for p in cube.MATERIAL), "omega")
_CENTRE = np.log([0.5, 8.0, 0.8, 8.0, 0.8, 8.0, 0.3, 8.0, 0.25])
_WIDE, _SPREAD = 1.0, 0.5
_CHAINS = 2


def positions(logs: jax.Array) -> jax.Array:
    """Positions (p,) in the box, at its walls beyond them, of the parameters' logarithms."""
    values = jnp.exp(logs)
    unit = [jnp.clip(p.to_unit(v), 0.0, 1.0) for p, v in zip(cube.MATERIAL, values, strict=True)]
    return 2.0 * jnp.stack(unit) - 1.0


def program(hearts: Sequence[Seen]) -> None:
    """The NumPyro program of all hearts."""
    count = len(NAMES)
    moved = numpyro.sample("moved", dist.Normal(0.0, 1.0).expand((count,)).to_event(1))
    centre = numpyro.deterministic("mean", _CENTRE + _WIDE * moved)
    spread = numpyro.sample("spread", dist.HalfNormal(_SPREAD * np.ones(count)).to_event(1))
    z = numpyro.sample("z", dist.Normal(0.0, 1.0).expand((len(hearts), count)).to_event(2))
    shape = (len(hearts), 3, len(cube.ANGLES))
    normal = dist.TruncatedNormal(0.0, ANGLE_SD, low=-1.0, high=1.0)
    angles = numpyro.sample("angles", normal.expand(shape).to_event(3))
    logs = centre + spread * z
    for k, of in enumerate(hearts):
        mean = means(of, positions(logs[k, :-1]), angles[k])
        told = log_likelihoods(of, mean, jnp.exp(logs[k, -1]))
        numpyro.factor(f"heart {k}", jnp.vdot(of.used, told))


@dataclass(frozen=True, eq=False)
class Sampled:
    """Draws (d, ...) of mean, spread, z and angles, with how their chains went.

    worst_rhat, least_ess : of mean and spread, which the population is.
    """

    draws: dict[str, np.ndarray]
    divergences: int
    worst_rhat: float
    least_ess: float


def sampled(
    found: Sequence[Campaign], seed: int, *, draws: int = 400, warmup: int = 400
) -> Sampled:
    """Draws of the population and its hearts, from :data:`_CHAINS` chains side by side."""
    models = [seen(each.heart, each.cubes) for each in found]
    count = len(NAMES)
    sites = {
        "moved": jnp.zeros(count),
        "spread": jnp.zeros(count),
        "z": jnp.zeros((len(found), count)),
        "angles": jnp.zeros((len(found), 3, len(cube.ANGLES))),
    }
    mirrored = marked(sites, {"angles": True})
    # Warm-up is too short to learn the correlations of so many unknowns (docs/experiments.md).
    run = sampler(program, sites, mirrored, warmup=warmup, room=draws, dense=False)
    length = {"chains": _CHAINS, "draws": draws}
    told, chain = side_by_side(run, models, unknown(len(mirrored)), seed, **length)
    each = [
        by_chain(told[name], _CHAINS)[..., k] for name in ("mean", "spread") for k in range(count)
    ]
    diverging = int(chain.diverging.sum())
    return Sampled(told, diverging, max(map(r_hat, each)), min(map(least_ess, each)))


def eighth(draws: dict[str, np.ndarray], seed: int) -> np.ndarray:
    """Parameters and omega (d, 9) of a heart that was not seen."""
    z = np.random.default_rng(seed).normal(size=draws["mean"].shape)
    return np.exp(draws["mean"] + draws["spread"] * z)
