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
from numpyro.infer import MCMC, NUTS, init_to_uniform
from numpyro.infer.util import unconstrain_fn
from studies.sheep_myocardium import cube
from studies.sheep_myocardium.curves import Emulated, forces
from studies.sheep_myocardium.experiment import MODES, Heart
from studies.sheep_myocardium.moves import Modes, Moving, modes, unknown

from calibrate.samplers.stopping import least_ess, r_hat
from calibrate.statistical_model.curve import curve_covariance

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


def program(law: str, *, angles: bool) -> Callable[[Seen, Modes], None]:
    """The NumPyro program of a heart by a law; ``angles`` says whether the fibres' are unknown."""

    def model(of: Seen, _: Modes) -> None:
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


def dimension(law: str, *, angles: bool) -> int:
    """Number of a law's unknowns."""
    return len(parameters(law)) + angles * _CUBES * len(cube.ANGLES) + 1


@lru_cache
def _sampler(law: str, angles: bool, draws: int, warmup: int) -> MCMC:
    """One for all hearts and chains: its program takes a heart and modes as arguments."""
    kernel = NUTS(
        program(law, angles=angles),
        target_accept_prob=0.9,
        max_tree_depth=8,
        dense_mass=True,
        init_strategy=init_to_uniform(radius=1.0),
    )
    return MCMC(
        Moving(kernel, "angles"), num_warmup=warmup, num_samples=draws, progress_bar=False,
        jit_model_args=True,
    )  # fmt: skip


def forget_programs() -> None:
    """Free all compiled programs: those of several hearts are more than a process can map."""
    _sampler.cache_clear()
    jax.clear_caches()


@dataclass(frozen=True, eq=False)
class Found:
    """Draws (d, ...) by name of a heart's posterior, chain after chain, with how sampling went.

    ``x`` (d, 8) is the material's position in the box, ``means`` (d, 9, j) the forces in N.
    """

    heart: Heart
    of: Seen
    law: str
    draws: dict[str, np.ndarray]
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

    @cached_property
    def unknowns(self) -> dict[str, np.ndarray]:
        """Draws of what was sampled, by name of the site."""
        return {name: v for name, v in self.draws.items() if name not in ("x", "means")}

    def _by_chain(self) -> list[np.ndarray]:
        flat = [v.reshape(len(v), -1) for v in self.unknowns.values()]
        return list(
            np.moveaxis(np.concatenate(flat, axis=1).reshape(self.chains, -1, self.size), 2, 0)
        )

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return sum(v[0].size for v in self.unknowns.values())

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
        z = np.asarray(_unconstrained(self.law, "angles" in self.draws)(self.of, self.unknowns))
        rows = (self.chains, -1)
        return modes(z.reshape(*rows, z.shape[1]), self.log_density.reshape(rows))


@lru_cache
def _unconstrained(law: str, angles: bool) -> Callable[[Seen, dict[str, np.ndarray]], jax.Array]:
    """Unconstrained positions (d, u) of draws, as the sampler flattens them."""
    model = program(law, angles=angles)
    none = unknown(dimension(law, angles=angles))

    def one(of: Seen, draw: dict[str, jax.Array]) -> jax.Array:
        return ravel_pytree(unconstrain_fn(model, (of, none), {}, draw))[0]

    return jax.jit(jax.vmap(one, (None, 0)))


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

    Each chain begins at a place of its own; :data:`.moves.MODES` of them find modes.
    """
    of = seen(heart, cubes, left_out)
    given = unknown(dimension(law, angles=angles)) if known is None else known
    run = _sampler(law, angles, draws, warmup)
    told: list[dict[str, np.ndarray]] = []
    energies, diverging = [], 0
    for key in jax.random.split(jax.random.key(seed), chains):
        run.run(key, of, given, extra_fields=("diverging", "potential_energy"))
        fields = run.get_extra_fields()
        told.append({name: np.asarray(v) for name, v in run.get_samples().items()})
        energies.append(np.asarray(fields["potential_energy"]))
        diverging += int(np.sum(fields["diverging"]))
    joined = {name: np.concatenate([each[name] for each in told]) for name in told[0]}
    return Found(heart, of, law, joined, diverging, chains, -np.concatenate(energies))


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
