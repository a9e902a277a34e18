r"""Forces along the curves of a heart, by FEM at some theta and by an emulator everywhere.

What is emulated is how far glued plates take the force from the formula's of a homogeneous cube
(:mod:`.cube`),

.. math:: F_j(\theta) = F_j^\text{hom}(\theta)\, e^{q_j(x)}

with q a Gaussian process (:mod:`.process`) through FEM's values and slopes
:math:`\partial q_j / \partial x_i` at positions :math:`x \in [-1, 1]^p` in the box. The formula
carries the exponentials. Runs go where the posterior is, round by round: over the whole box,
fibres that switch on make too many shapes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from studies.sheep_myocardium import cube, process
from studies.sheep_myocardium.experiment import Curve, Heart
from studies.sheep_myocardium.process import Known, Process

import emulator as em
from emulator.errors import SolverError
from emulator.fem.campaign.threads import at_once, in_order
from emulator.fem.support_force import SupportForce

MODES_OF_A_CUBE = 3
_AXES = ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0))  # along which each mode moves


class Runs(NamedTuple):
    """FEM at positions x (r, p) in the box: forces, their slopes in x and normal forces, in N.

    NaN where FEM did not converge. force, normal : (r, j). slopes : (r, j, p).
    """

    x: np.ndarray
    force: np.ndarray
    slopes: np.ndarray
    normal: np.ndarray


@dataclass(frozen=True, eq=False)
class Cube:
    """One cube of a heart by FEM; its points are those of its three curves, one after the other."""

    number: int
    sizes: np.ndarray
    curves: Sequence[Curve]
    cells: int = cube.CELLS

    @cached_property
    def simulator(self) -> em.Simulator:
        """FEM of the cube."""
        return em.Simulator(cube.scene(self.number, self.sizes, self.cells))

    @property
    def body(self) -> em.Scene:
        """The scene."""
        return self.simulator.scene

    @property
    def unknowns(self) -> int:
        """Material parameters and angles, p; the rest of theta are the amounts."""
        return len(self.body.parameters) - len(cube.AMOUNTS)

    def material(self, x: jax.Array) -> jax.Array:
        """Material parameters and angles (p,) at the position ``x`` (p,)."""
        return self.thetas(x, 0, jnp.zeros(1))[0, : self.unknowns]

    def thetas(self, x: jax.Array, mode: int, amounts: jax.Array) -> jax.Array:
        """Theta (k, p + 3) at the position ``x`` (p,) and ``amounts`` (k,) of a mode."""
        rest = jnp.full(len(cube.AMOUNTS), 0.5)
        theta = self.body.from_unit(jnp.concatenate([0.5 * (x + 1.0), rest]))
        column = self.unknowns + mode
        return jnp.tile(theta, (len(amounts), 1)).at[:, column].set(amounts)

    def runs(self, x: np.ndarray, *, slopes: bool = True) -> Runs:
        """FEM at positions (r, p), as many at once as there are cores.

        Without ``slopes`` these are NaN.
        """

        def run(row: np.ndarray) -> tuple[np.ndarray, ...]:
            return self._run(jnp.asarray(row), slopes)

        each = in_order(run, iter(x), at_once(self.simulator))
        force, rising, normal = (np.stack(part) for part in zip(*each, strict=True))
        return Runs(x, force, rising, normal)

    def _run(self, x: jax.Array, slopes: bool) -> tuple[np.ndarray, ...]:
        parts = []
        for mode, curve in enumerate(self.curves):
            half = len(curve.amount) // 2
            below = [p[::-1] for p in self._half(x, mode, curve.amount[:half][::-1], slopes)]
            above = self._half(x, mode, curve.amount[half:], slopes)
            parts.append([np.concatenate(p) for p in zip(below, above, strict=True)])
        force, rising, normal = (np.concatenate(p) for p in zip(*parts, strict=True))
        return force, rising, normal

    def _half(self, x: jax.Array, mode: int, amounts: np.ndarray, slopes: bool) -> list[np.ndarray]:
        """Forces, slopes and normal forces on the way from rest to the last of ``amounts``."""
        thetas = self.thetas(x, mode, jnp.asarray(amounts))
        found = self.simulator.path(thetas)
        converged = np.asarray(found.converged)
        told: list[list[np.ndarray]] = [[], [], []]
        for k in range(len(amounts)):
            if not converged[: k + 1].all():
                empty = (np.nan, np.full(self.unknowns, np.nan), np.nan)
                for part, nothing in zip(told, empty, strict=True):
                    part.append(np.asarray(nothing))
                continue
            u, theta = found.displacement[k], thetas[k]
            moved = (
                self.simulator.sensitivities(u, theta)
                if slopes
                else jnp.full((len(theta), *u.shape), jnp.nan)
            )
            for part, value in zip(told, self._each_force[mode](u, theta, moved), strict=True):
                part.append(np.asarray(value))
        return [np.stack(part) for part in told]

    @cached_property
    def _each_force(self) -> list[Callable[..., tuple[jax.Array, ...]]]:
        return [jax.jit(partial(self._force, mode)) for mode in range(MODES_OF_A_CUBE)]

    def _force(
        self, mode: int, u: jax.Array, theta: jax.Array, slopes: jax.Array
    ) -> tuple[jax.Array, ...]:
        """Force () N along the motion, its slopes (p,) in x, and the force across the plate."""
        along = SupportForce(self.body, "right", _AXES[mode])
        across = SupportForce(self.body, "right", _AXES[2])
        nodes, rates = along.nodes, self.body.space.rates(theta[None])[0]

        def slope(k: jax.Array) -> jax.Array:
            direction = jnp.zeros(len(theta)).at[k].set(1.0)
            return jax.jvp(along, (u[nodes], theta), (slopes[k][nodes], direction))[1]

        each = jax.vmap(slope)(jnp.arange(self.unknowns)) * rates[: self.unknowns] / 2.0
        return 1e-3 * along(u[nodes], theta), 1e-3 * each, 1e-3 * across(u[across.nodes], theta)

    @property
    def amounts(self) -> np.ndarray:
        """Of the three modes, (3, j)."""
        return np.stack([curve.amount for curve in self.curves])

    @property
    def area(self) -> float:
        """Of a plate, mm2."""
        return float(self.sizes[0] * self.sizes[1])


def cubes(heart: Heart, cells: int = cube.CELLS) -> list[Cube]:
    """The three cubes of a heart."""
    return [Cube(k, heart.sizes[k], heart.of_cube(k), cells) for k in range(3)]


class Emulated(NamedTuple):
    """The emulator of a heart's forces, arrays only, so that one program serves all hearts.

    process : of each cube, arrays with a first axis of 3. finer : (3, k) by which a finer mesh's
    forces differ, a factor. ends : (3, 2), see :func:`.process.ends`. amounts : (3, 3, j).
    H, C : as of :func:`.cube.homogeneous`. area : (3,) mm2.
    """

    process: Process
    finer: jax.Array
    ends: jax.Array
    amounts: jax.Array
    H: jax.Array
    C: jax.Array
    area: jax.Array


def forces(emulated: Emulated, x: jax.Array) -> jax.Array:
    """Forces (3, k) in N of a heart's cubes at positions (3, p)."""
    phi = jax.vmap(process.features)(x, emulated.ends)
    q = jax.vmap(process.correction)(emulated.process, phi)
    return emulated.finer * cube.formula(x, emulated.H, emulated.C, emulated.area) * jnp.exp(q)


@jax.jit
def _formula_and_slopes(
    x: jax.Array, H: jax.Array, C: jax.Array, area: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Homogeneous forces (3, k) of cubes at one material (3, p), and slopes (3, k, p)."""

    def of(x: jax.Array) -> tuple[jax.Array, jax.Array]:
        value = cube.formula(x, H, C, area)
        return value, value

    slopes, value = jax.jacfwd(of, has_aux=True)(x)  # (c, k, c, p)
    # The material is the first cube's; angles are each cube's own.
    material = len(cube.MATERIAL)
    own = jnp.einsum("ckcp->ckp", slopes)[..., material:]
    return value, jnp.concatenate([slopes[:, :, 0, :material], own], axis=-1)


def joined(parts: Sequence[Runs]) -> Runs:
    """Runs one after the other."""
    return Runs(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


@dataclass(frozen=True, eq=False)
class Fit:
    """What a heart's runs say: the emulator, and of each cube what it was made of."""

    emulated: Emulated
    known: list[Known]

    @property
    def lengths(self) -> np.ndarray:
        """Of each cube's process, (3, f)."""
        return np.asarray(self.emulated.process.lengths)

    def left(self, number: int, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What a cube's runs leave at positions (m, p).

        Covariance of q and its slopes, :func:`.process.left`, and the sd (m,) of q: a fraction of
        the force.
        """
        phi, J = process.with_slopes(jnp.asarray(x), self.emulated.ends[number])
        lengths = self.emulated.process.lengths[number]
        covariance, sd = process.left(self.known[number], lengths, phi, J)
        variance = np.diagonal(covariance)[:: len(covariance) // len(x)]
        return np.asarray(covariance), float(sd) * np.sqrt(np.maximum(variance, 0.0))


def fit(bodies: Sequence[Cube], runs: Sequence[Runs], before: Fit | None = None) -> Fit:
    """The processes through the logarithm of FEM's forces over the formula's, and its slopes.

    Lengths are sought from those ``before``.

    Raises
    ------
    SolverError
        Half of a cube's runs failed, or more.
    """
    amounts = np.stack([body.amounts for body in bodies])
    H, C = (jnp.asarray(np.stack(p)) for p in zip(*map(cube.homogeneous, amounts), strict=True))
    area = jnp.asarray([body.area for body in bodies])
    ends = np.stack([process.ends(each) for each in amounts])
    known = [_known(k, each, ends[k], H, C, area) for k, each in enumerate(runs)]
    made = []
    for k, told in enumerate(known):
        start = None if before is None else before.lengths[k]
        made.append(process.conditioned(told, jnp.asarray(process.likeliest(told, start))))
    one = jax.tree.map(lambda *each: jnp.stack(each), *made)
    rest = (jnp.asarray(ends), jnp.asarray(amounts), H, C, area)
    return Fit(Emulated(one, jnp.ones(one.mean.shape), *rest), known)


def _known(
    k: int, runs: Runs, ends: np.ndarray, H: jax.Array, C: jax.Array, area: jax.Array
) -> Known:
    """What one cube's runs say of its q."""
    told = []
    for row in runs.x:
        value, slopes = _formula_and_slopes(jnp.tile(jnp.asarray(row), (len(H), 1)), H, C, area)
        told.append((np.asarray(value)[k], np.asarray(slopes)[k]))
    formula, rising = (np.stack(part) for part in zip(*told, strict=True))
    ratio = runs.force / formula
    sound = (np.isfinite(ratio) & (ratio > 0.0)).all(axis=1)
    if not sound.sum() > 0.5 * len(sound):
        raise SolverError(f"{(~sound).sum()} of {len(sound)} runs of cube {k + 1} failed")
    slopes = (runs.slopes / runs.force[..., None] - rising / formula[..., None])[sound]
    return process.known(runs.x[sound], np.log(ratio[sound]), slopes, ends)
