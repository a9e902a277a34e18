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

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from numpyro.infer import MCMC, NUTS, init_to_value
from studies.sheep_myocardium import cube
from studies.sheep_myocardium.curves import Emulated, forces
from studies.sheep_myocardium.experiment import MODES, Heart

from calibrate.statistical_model.curve import curve_covariance

CELL = 3e-3  # N, noise of the load cell
POINT = 0.03  # of a force, at each point for itself
ANGLE = 15.0  # degrees
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


@lru_cache
def _sampler(law: str, angles: bool, draws: int, warmup: int, chains: int) -> MCMC:
    """One for all hearts: its program takes them as arguments."""
    start = {f"x_{n}": jnp.zeros(()) for n in parameters(law) if n not in MEANS}
    start |= {n: jnp.asarray(0.5 * MEANS[n]) for n in parameters(law) if n in MEANS}
    start["omega"] = jnp.asarray(0.2)
    if angles:
        start["angles"] = jnp.zeros((_CUBES, len(cube.ANGLES)))
    kernel = NUTS(
        program(law, angles=angles),
        target_accept_prob=0.9,
        max_tree_depth=8,
        dense_mass=True,
        init_strategy=init_to_value(values=start),
    )
    return MCMC(
        kernel, num_warmup=warmup, num_samples=draws, num_chains=chains,
        chain_method="sequential", progress_bar=False, jit_model_args=True,
    )  # fmt: skip


def forget_programs() -> None:
    """Free all compiled programs: those of several hearts are more than a process can map."""
    _sampler.cache_clear()
    jax.clear_caches()


@dataclass(frozen=True, eq=False)
class Found:
    """Draws (d, ...) by name of a heart's posterior, with how sampling went.

    ``x`` (d, 8) is the material's position in the box, ``means`` (d, 9, j) the forces in N.
    """

    heart: Heart
    of: Seen
    law: str
    draws: dict[str, np.ndarray]
    divergences: int
    worst_rhat: float
    least_ess: float

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


def sample(
    heart: Heart,
    cubes: Emulated,
    seed: int,
    law: str = ORTHOTROPIC,
    *,
    angles: bool = True,
    left_out: tuple[str, ...] = (),
    draws: int = 500,
    warmup: int = 500,
    chains: int = 2,
) -> Found:
    """Draws of a heart's posterior by NumPyro's NUTS."""
    of = seen(heart, cubes, left_out)
    run = _sampler(law, angles, draws, warmup, chains)
    run.run(jax.random.key(seed), of, extra_fields=("diverging",))
    by_chain: Mapping[str, Any] = run.get_samples(group_by_chain=True)
    unknown = {name: v for name, v in by_chain.items() if name not in ("x", "means")}
    told = numpyro.diagnostics.summary(unknown)
    return Found(
        heart,
        of,
        law,
        {name: np.asarray(v) for name, v in run.get_samples().items()},
        int(np.sum(run.get_extra_fields()["diverging"])),
        float(max(np.nanmax(s["r_hat"]) for s in told.values())),
        float(min(np.nanmin(s["n_eff"]) for s in told.values())),
    )
