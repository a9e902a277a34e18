r"""The posterior of a heart: one material, three cubes, nine modes.

.. math:: y_{mj} = F_{mj}(\theta)\,(1 + \delta_m(\gamma_j)) + \varepsilon_{mj}, \qquad
          \delta_m \sim \mathrm{GP}\big(0,\;
              \omega^2\, [\tfrac12 + \tfrac12 k(|\gamma - \gamma'|)] + 0.03^2\,
              1_{\gamma = \gamma'}\big)

Each mode m is off by a fraction of its own, half of it the same along the curve and half changing
with the amount :math:`\gamma` (Matern 3/2, length half of the largest amount; what
:mod:`calibrate.model_error.systematic` is for), so that a hundred points of a curve are not a
hundred facts; 3 % of each point are its own, for what the emulator is
off. :math:`\omega` is inferred, the load cell's noise is 3 mN. Each cube has fibre angles of its
own, 15 degrees about the direction it was cut along.

What differs between hearts and between laws is arrays: one program is compiled for all of them. A
parameter that a law leaves out is drawn from its prior and not looked at.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from studies.common.kernels import matern32
from studies.sheep_myocardium import cube
from studies.sheep_myocardium.chains import Drawn, by_chain, marked, sampler, side_by_side
from studies.sheep_myocardium.curves import Emulated, forces
from studies.sheep_myocardium.experiment import MODES, Heart
from studies.sheep_myocardium.moves import EXPLORING, Modes, joined, modes, unknown

import calibrate as cal

CELL = 3e-3  # N, noise of the load cell
POINT = 0.03  # of a force, at each point for itself
ANGLE = 15.0  # degrees
AGREE = 1.02  # R-hat of chains that found the same
OFF = 0.3  # scale of the half-normal prior of omega
MEANS = {"a_f": 2.0, "a_s": 1.0, "a_fs": 0.5}
"""Means in kPa of the exponential priors of moduli that may be zero; logarithms are uniform."""
LAWS = {
    "isotropic": ("a_f", "a_s", "a_fs"),
    "fibres": ("a_s", "a_fs"),
    "fibres, sheets": ("a_fs",),
    "fibres, shear": ("a_s",),
    "fibres, sheets, shear": (),
}
"""Laws by name: moduli of Holzapfel and Ogden's orthotropic one that each leaves out."""
ORTHOTROPIC = "fibres, sheets, shear"
MATERIAL = tuple(p.name for p in cube.MATERIAL)
_EXPONENT = {"a_f": "b_f", "a_s": "b_s", "a_fs": "b_fs"}
_CUBES = 3
_ANGLES = (_CUBES, len(cube.ANGLES))
TIMES = 4
"""As many draws as steps of warm-up, at most."""
ANGLE_SD = ANGLE / cube.ANGLES[0].high  # in half widths of the box


def r_hat(values: np.ndarray) -> float:
    """Return the rank-normalised split R-hat of ``values`` (chains, draws)."""
    return float(cal.array_stats.rhat(values, chain_axis=0, draw_axis=1))


def least_ess(values: np.ndarray) -> float:
    """Return the effective number of draws of ``values`` (chains, draws), in bulk or tails."""
    axes = {"chain_axis": 0, "draw_axis": 1}
    bulk = cal.array_stats.ess(values, method="bulk", **axes)
    return float(min(bulk, cal.array_stats.ess(values, method="tail", prob=(0.05, 0.95), **axes)))


def _along_curve(amounts: jax.Array, length: Any) -> jax.Array:
    """Return the correlation of a curve's points: half constant, half Matern's."""
    distance = (amounts[..., :, None] - amounts[..., None, :]) / length
    return 0.5 + 0.5 * matern32(distance**2)


class Seen(NamedTuple):
    """What the program is given of a heart and a law.

    cubes : the emulator. data : (9, j) N. used : (9,) power that a mode's likelihood is taken to,
    0 for one that is left out.
    acting : (8,) whether the law has a parameter. turned : () 1 where fibre angles are unknown, 0
    where fibres are along the cut. twin : (9, j) N of a second experiment, or None.
    """

    cubes: Emulated
    data: jax.Array
    used: jax.Array
    acting: jax.Array
    turned: jax.Array
    twin: jax.Array | None = None

    @property
    def amounts(self) -> jax.Array:
        """Of every mode, (9, j)."""
        return self.cubes.amounts.reshape(len(MODES), -1)


def parameters(law: str) -> tuple[str, ...]:
    """Names of a law's parameters."""
    absent = LAWS[law]
    dead = {*absent, *(_EXPONENT[name] for name in absent)}
    return tuple(name for name in MATERIAL if name not in dead)


def seen(
    heart: Heart,
    cubes: Emulated,
    law: str = ORTHOTROPIC,
    *,
    angles: bool = True,
    left_out: tuple[str, ...] = (),
    power: float = 1.0,
    twin: Heart | None = None,
) -> Seen:
    """A heart's forces and data by a law, with fibre ``angles`` unknown; modes may be left out.

    The likelihood is taken to a ``power``. A ``twin`` is of the same parameters, and seen too.
    """

    def measured(each: Heart) -> jax.Array:
        return jnp.asarray(np.stack([each.curves[mode].force for mode in MODES]))

    used = power * np.array([float(mode not in left_out) for mode in MODES])
    acting = np.array([name in parameters(law) for name in MATERIAL])
    told = map(jnp.asarray, (used, acting, float(angles)))
    return Seen(cubes, measured(heart), *told, twin=None if twin is None else measured(twin))


def means(of: Seen, material: jax.Array, turned: jax.Array) -> jax.Array:
    """Forces (9, j) in N at positions in the box: of the material (8,), of angles (3, 2)."""
    x = jnp.concatenate([jnp.tile(material, (_CUBES, 1)), turned], axis=1)
    return forces(of.cubes, x).reshape(len(MODES), -1)


def covariances(amounts: jax.Array, mean: jax.Array, omega: jax.Array) -> jax.Array:
    """Covariances (..., j, j) in N2 of modes' data with ``mean`` (..., j)."""
    length = 0.5 * jnp.abs(amounts).max(axis=-1)[..., None, None]
    products = mean[..., :, None] * mean[..., None, :]
    alike = omega**2 * products * _along_curve(amounts, length)
    own = jnp.eye(mean.shape[-1]) * mean[..., None, :] ** 2
    return alike + POINT**2 * own + CELL**2 * jnp.eye(mean.shape[-1])


def log_likelihoods(of: Seen, mean: jax.Array, omega: jax.Array) -> jax.Array:
    """Log density (9,) of each mode's data."""
    covariance = covariances(of.amounts, mean, omega)
    return dist.MultivariateNormal(mean, covariance).log_prob(of.data)


_of_draws = jax.jit(jax.vmap(log_likelihoods, (None, 0, 0)))


def of_draws(of: Seen, mean: np.ndarray, omega: np.ndarray) -> np.ndarray:
    """Log densities (d, 9) of the modes' data at draws: mean (d, 9, j) in N, omega (d,)."""
    return np.asarray(_of_draws(of, jnp.asarray(mean), jnp.asarray(omega)))


def _position(name: str, value: jax.Array) -> jax.Array:
    """Position of a modulus in the box, at its wall beyond it."""
    parameter = cube.MATERIAL[MATERIAL.index(name)]
    return 2.0 * parameter.to_unit(jnp.minimum(value, parameter.high)) - 1.0


def program(of: Seen) -> None:
    """The NumPyro program of a heart by a law."""
    x = []
    for k, name in enumerate(MATERIAL):
        if name in MEANS:
            value = numpyro.sample(name, dist.Exponential(1.0 / MEANS[name]))
            at = _position(name, value)
        else:
            at = numpyro.sample(f"x_{name}", dist.Uniform(-1.0, 1.0))
        x.append(jnp.where(of.acting[k], at, -1.0))
    normal = dist.TruncatedNormal(0.0, ANGLE_SD, low=-1.0, high=1.0)
    turned = of.turned * numpyro.sample("angles", normal.expand(_ANGLES).to_event(2))
    omega = numpyro.sample("omega", dist.HalfNormal(OFF))
    material = numpyro.deterministic("x", jnp.stack(x))
    numpyro.deterministic("turned", turned)
    mean = numpyro.deterministic("means", means(of, material, turned))
    numpyro.factor("data", jnp.vdot(of.used, log_likelihoods(of, mean, omega)))
    if of.twin is not None:
        beside = log_likelihoods(of._replace(data=of.twin), mean, omega)
        numpyro.factor("twin", beside.sum())


_SITES = {
    **{name if name in MEANS else f"x_{name}": jnp.zeros(()) for name in MATERIAL},
    "angles": jnp.zeros(_ANGLES),
    "omega": jnp.zeros(()),
}
"""Zeros like each unknown, by its site."""


@lru_cache
def _sampler(steps: int) -> Callable[[jax.Array, Seen, Modes, int], Drawn]:
    """One program for all hearts, laws, chains and modes; the last argument is how many draws."""
    mirrored = marked(_SITES, {"angles": True})
    return sampler(program, _SITES, mirrored, warmup=steps, room=TIMES * steps)


@dataclass(frozen=True, eq=False)
class Found:
    """Draws (d, ...) by name of a heart's posterior, chain after chain, with how sampling went.

    draws : by site; ``x`` (d, 8) is the material's position in the box, ``turned`` (d, 3, 2) that
    of the angles in theirs, ``means`` (d, 9, j) the forces in N. z : (d, u) unconstrained.
    log_density : (d,) there. modes : between which it was drawn, or, where none were known, those
    that its chains found.
    """

    heart: Heart
    of: Seen
    law: str
    draws: dict[str, np.ndarray]
    z: np.ndarray
    divergences: int
    chains: int
    log_density: np.ndarray
    modes: Modes

    @property
    def positions(self) -> np.ndarray:
        """Of each cube in its box, (d, 3, p)."""
        material = np.repeat(self.draws["x"][:, None], _CUBES, axis=1)
        return np.concatenate([material, self.draws["turned"]], axis=2)

    @cached_property
    def log_likelihoods(self) -> np.ndarray:
        """Log densities (d, 9) of the modes' data."""
        return of_draws(self.of, self.draws["means"], self.draws["omega"])

    def theta(self, name: str) -> np.ndarray:
        """A parameter (d,) in its unit."""
        k = MATERIAL.index(name)
        unit = jnp.asarray(0.5 * (self.draws["x"][:, k] + 1.0))
        return np.asarray(cube.MATERIAL[k].from_unit(unit))

    def _unknowns(self) -> np.ndarray:
        """Unconstrained positions of what acts, by unknown and chain."""
        marks = {"angles": bool(self.of.turned), "omega": True}
        for name in parameters(self.law):
            marks[name if name in MEANS else f"x_{name}"] = True
        acting = marked(_SITES, marks)
        return np.moveaxis(by_chain(self.z, self.chains)[..., acting], 2, 0)

    @cached_property
    def worst_rhat(self) -> float:
        """Largest R-hat of an unknown."""
        return max(r_hat(each) for each in self._unknowns())

    @cached_property
    def least_ess(self) -> float:
        """Smallest effective number of draws of an unknown, in the bulk or in the tails."""
        return min(least_ess(each) for each in self._unknowns())


def sample(
    heart: Heart,
    cubes: Emulated,
    seed: int,
    law: str = ORTHOTROPIC,
    *,
    angles: bool = True,
    left_out: tuple[str, ...] = (),
    power: float = 1.0,
    twin: Heart | None = None,
    known: Modes | None = None,
    steps: int = 300,
    times: int = 1,
    chains: int = EXPLORING,
) -> Found:
    """Draws of a heart's posterior by NumPyro's NUTS, and moves between ``known`` modes.

    Each chain begins at a place of its own, and warms up for ``steps``; ``times`` as many, at most
    :data:`TIMES`, are kept. Modes left out, ``power`` and ``twin`` are as of :func:`seen`. Chains
    that know no modes find one each. As many are drawn at once as there are cores.
    """
    of = seen(heart, cubes, law, angles=angles, left_out=left_out, power=power, twin=twin)
    given = unknown(len(marked(_SITES, {}))) if known is None else known
    draws = times * steps
    every = side_by_side(_sampler(steps), of, given, seed, chains=chains, draws=draws)
    z, density, diverging = every.chain
    if known is None and chains == EXPLORING:
        given = joined(None, modes(by_chain(z, chains), by_chain(density, chains)))
    diverged = int(diverging.sum())
    return Found(heart, of, law, every.draws, z, diverged, chains, density, given)


def settled(
    heart: Heart,
    cubes: Emulated,
    seed: int,
    law: str = ORTHOTROPIC,
    *,
    known: Modes | None = None,
    times: int = 1,
    **how: Any,
) -> Found:
    """As :func:`sample`; where chains disagree, again, with moves between more modes.

    Without ``known`` modes the chains, one each, have found some; with them others are sought, and
    those that were known are kept: chains that find the same mode say nothing of another.
    """
    first = 1 if known is None else times
    found = sample(heart, cubes, seed, law, known=known, times=first, **how)
    if found.worst_rhat <= AGREE:
        return found
    between = found.modes
    if known is not None:
        between = joined(known, sample(heart, cubes, seed + 2, law, **how).modes)
    return sample(heart, cubes, seed + 1, law, known=between, times=times, **how)
