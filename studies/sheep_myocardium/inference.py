r"""The posterior of a heart: one material, three cubes, nine modes.

.. math:: y_{mj} = F_{mj}(\theta)\,(1 + \delta_m(\gamma_j)) + \varepsilon_{mj}, \qquad
          \delta_m \sim \mathrm{GP}\big(0,\;
              \omega^2\, [\tfrac12 + \tfrac12 k(|\gamma - \gamma'|)] + 0.03^2\,
              1_{\gamma = \gamma'}\big)

Each mode m is off by a fraction of its own, half of it the same along the curve and half changing
with the amount :math:`\gamma` (Matern 3/2, length half of the largest amount; what
:mod:`calibrate.statistical_model.curve` is for), so that a hundred points of a curve are not a
hundred facts; 3 % of each point are its own, for what the emulator is
off. :math:`\omega` is inferred, the load cell's noise is 3 mN. Each cube has fibre angles of its
own, 15 degrees about the direction it was cut along.

What differs between hearts is arrays, so that a law's program is compiled once for all of them.
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
from jax.flatten_util import ravel_pytree
from numpyro.infer.util import constrain_fn, potential_energy
from studies.sheep_myocardium import cube
from studies.sheep_myocardium.curves import Emulated, forces
from studies.sheep_myocardium.experiment import MODES, Heart
from studies.sheep_myocardium.moves import Chain, Modes, chain, modes, unknown

from calibrate.samplers.stopping import least_ess, r_hat
from calibrate.statistical_model.curve import curve_covariance
from emulator.fem.campaign.threads import in_order
from emulator.machine import cores

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
ANGLE_SD = ANGLE / cube.ANGLES[0].high  # in half widths of the box


class Seen(NamedTuple):
    """What a program is given of a heart.

    cubes : the emulator. data : (9, j) N. used : (9,) 1 for modes whose data is used, else 0.
    """

    cubes: Emulated
    data: jax.Array
    used: jax.Array

    @property
    def amounts(self) -> jax.Array:
        """Of every mode, (9, j)."""
        return self.cubes.amounts.reshape(len(MODES), -1)


def seen(heart: Heart, cubes: Emulated, left_out: tuple[str, ...] = ()) -> Seen:
    """A heart's forces and data; modes may be left out."""
    data = np.stack([heart.curves[mode].force for mode in MODES])
    used = np.array([float(mode not in left_out) for mode in MODES])
    return Seen(cubes, jnp.asarray(data), jnp.asarray(used))


def parameters(law: str) -> tuple[str, ...]:
    """Names of a law's parameters."""
    absent = LAWS[law]
    dead = {*absent, *(_EXPONENT[name] for name in absent)}
    return tuple(name for name in MATERIAL if name not in dead)


def means(of: Seen, material: jax.Array, turned: jax.Array) -> jax.Array:
    """Forces (9, j) in N at positions in the box: of the material (8,), of angles (3, 2)."""
    x = jnp.concatenate([jnp.tile(material, (_CUBES, 1)), turned], axis=1)
    return forces(of.cubes, x).reshape(len(MODES), -1)


def covariances(amounts: jax.Array, mean: jax.Array, omega: jax.Array) -> jax.Array:
    """Covariances (..., j, j) in N2 of modes' data with ``mean`` (..., j)."""
    length = 0.5 * jnp.abs(amounts).max(axis=-1)[..., None, None]
    alike = curve_covariance(amounts, mean, length, share=omega, constant=0.5)
    own = jnp.eye(mean.shape[-1]) * mean[..., None, :] ** 2
    return alike + POINT**2 * own + CELL**2 * jnp.eye(mean.shape[-1])


def log_likelihoods(of: Seen, mean: jax.Array, omega: jax.Array) -> jax.Array:
    """Log density (9,) of each mode's data."""
    covariance = covariances(of.amounts, mean, omega)
    return dist.MultivariateNormal(mean, covariance).log_prob(of.data)


def _position(name: str, value: jax.Array) -> jax.Array:
    """Position of a modulus in the box, at its wall beyond it."""
    parameter = cube.MATERIAL[MATERIAL.index(name)]
    return 2.0 * parameter.to_unit(jnp.minimum(value, parameter.high)) - 1.0


def program(law: str, *, angles: bool) -> Callable[[Seen], None]:
    """The NumPyro program of a heart by a law; ``angles`` says whether the fibres' are unknown."""

    def model(of: Seen) -> None:
        x = {name: jnp.asarray(-1.0) for name in MATERIAL}
        for name in parameters(law):
            if name in MEANS:
                value = numpyro.sample(name, dist.Exponential(1.0 / MEANS[name]))
                x[name] = _position(name, value)
            else:
                x[name] = numpyro.sample(f"x_{name}", dist.Uniform(-1.0, 1.0))
        turned = jnp.zeros((_CUBES, len(cube.ANGLES)))
        if angles:
            normal = dist.TruncatedNormal(0.0, ANGLE_SD, low=-1.0, high=1.0)
            turned = numpyro.sample("angles", normal.expand(turned.shape).to_event(2))
        omega = numpyro.sample("omega", dist.HalfNormal(OFF))
        material = numpyro.deterministic("x", jnp.stack(list(x.values())))
        mean = numpyro.deterministic("means", means(of, material, turned))
        numpyro.factor("data", jnp.vdot(of.used, log_likelihoods(of, mean, omega)))

    return model


def _sites(law: str, *, angles: bool) -> dict[str, jax.Array]:
    """Zeros like each unknown of a law's program, by its site."""
    sites = {n if n in MEANS else f"x_{n}": jnp.zeros(()) for n in parameters(law)}
    turned = {"angles": jnp.zeros((_CUBES, len(cube.ANGLES)))} if angles else {}
    return sites | turned | {"omega": jnp.zeros(())}


class Drawn(NamedTuple):
    """A chain: draws by site, of deterministic ones too, with how it went."""

    draws: dict[str, jax.Array]
    chain: Chain


@lru_cache
def _sampler(
    law: str, angles: bool, draws: int, warmup: int
) -> Callable[[jax.Array, Seen, Modes], Drawn]:
    """One program for all hearts, chains and modes."""
    model = program(law, angles=angles)
    sites = _sites(law, angles=angles)
    unravel = ravel_pytree(sites)[1]
    marks = {name: jnp.full(v.shape, name == "angles") for name, v in sites.items()}
    mirrored = np.asarray(ravel_pytree(marks)[0])

    def run(key: jax.Array, of: Seen, given: Modes) -> Drawn:
        def potential(z: jax.Array) -> jax.Array:
            return potential_energy(model, (of,), {}, unravel(z))

        found = chain(potential, given, mirrored, key, warmup=warmup, draws=draws)

        def told(z: jax.Array) -> dict[str, jax.Array]:
            return constrain_fn(model, (of,), {}, unravel(z), return_deterministic=True)

        return Drawn(jax.lax.map(told, found.z), found)

    return jax.jit(run)


def forget_programs() -> None:
    """Free all compiled programs: those of several hearts are more than a process can map."""
    _sampler.cache_clear()
    jax.clear_caches()


@dataclass(frozen=True, eq=False)
class Found:
    """Draws (d, ...) by name of a heart's posterior, chain after chain, with how sampling went.

    draws : by site; ``x`` (d, 8) is the material's position in the box, ``means`` (d, 9, j) the
    forces in N. z : (d, u) unconstrained. log_density : (d,) there.
    """

    heart: Heart
    of: Seen
    law: str
    draws: dict[str, np.ndarray]
    z: np.ndarray
    divergences: int
    chains: int
    log_density: np.ndarray

    @property
    def angles(self) -> np.ndarray:
        """Positions (d, 3, 2) of the angles in their box."""
        known = np.zeros((len(self.draws["x"]), _CUBES, len(cube.ANGLES)))
        return self.draws.get("angles", known)

    @property
    def positions(self) -> np.ndarray:
        """Of each cube in its box, (d, 3, p)."""
        material = np.repeat(self.draws["x"][:, None], _CUBES, axis=1)
        return np.concatenate([material, self.angles], axis=2)

    @cached_property
    def log_likelihoods(self) -> np.ndarray:
        """Log densities (d, 9) of the modes' data."""
        each = jax.jit(jax.vmap(log_likelihoods, (None, 0, 0)))
        return np.asarray(each(self.of, self.draws["means"], self.draws["omega"]))

    def theta(self, name: str) -> np.ndarray:
        """A parameter (d,) in its unit."""
        k = MATERIAL.index(name)
        unit = jnp.asarray(0.5 * (self.draws["x"][:, k] + 1.0))
        return np.asarray(cube.MATERIAL[k].from_unit(unit))

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.z.shape[1]

    def _by_chain(self) -> np.ndarray:
        return np.moveaxis(self.z.reshape(self.chains, -1, self.size), 2, 0)

    @cached_property
    def worst_rhat(self) -> float:
        """Largest R-hat of an unknown."""
        return max(r_hat(each) for each in self._by_chain())

    @cached_property
    def least_ess(self) -> float:
        """Smallest effective number of draws of an unknown, in the bulk or in the tails."""
        return min(least_ess(each) for each in self._by_chain())

    def modes(self) -> Modes:
        """A mode a chain."""
        rows = (self.chains, -1)
        return modes(self.z.reshape(*rows, self.size), self.log_density.reshape(rows))


def sample(
    heart: Heart,
    cubes: Emulated,
    seed: int,
    law: str = ORTHOTROPIC,
    *,
    angles: bool = True,
    left_out: tuple[str, ...] = (),
    known: Modes | None = None,
    draws: int = 300,
    warmup: int = 300,
    chains: int = 4,
) -> Found:
    """Draws of a heart's posterior by NumPyro's NUTS, and moves between ``known`` modes.

    Each chain begins at a place of its own; :data:`.moves.MODES` of them find modes. As many are
    drawn at once as there are cores.
    """
    of = seen(heart, cubes, left_out)
    size = sum(site.size for site in _sites(law, angles=angles).values())
    given = unknown(size) if known is None else known
    run = _sampler(law, angles, draws, warmup)

    def one(key: jax.Array) -> Drawn:
        return jax.block_until_ready(run(key, of, given))

    keys = iter(jax.random.split(jax.random.key(seed), chains))
    told = in_order(one, keys, min(cores(), chains))
    every = jax.tree.map(lambda *parts: np.concatenate(parts), *told)
    diverged, density = int(every.chain.diverging.sum()), every.chain.log_density
    return Found(heart, of, law, every.draws, every.chain.z, diverged, chains, density)


def settled(
    heart: Heart, cubes: Emulated, seed: int, law: str = ORTHOTROPIC, *, times: int = 1, **how: Any
) -> Found:
    """As :func:`sample`; chains that disagree are drawn again, with moves between their modes.

    ``times`` as many draws then.
    """
    found = sample(heart, cubes, seed, law, **how)
    if found.worst_rhat <= AGREE:
        return found
    longer = how | {"draws": times * how.get("draws", 300), "known": found.modes()}
    return sample(heart, cubes, seed + 1, law, **longer)
