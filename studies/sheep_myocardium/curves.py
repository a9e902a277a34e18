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
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from studies.common.output import cores
from studies.sheep_myocardium import cube, process
from studies.sheep_myocardium.experiment import Curve, Heart
from studies.sheep_myocardium.process import Known, Process
from threadpoolctl import threadpool_limits

import calibrate as cal
import emulator as em

_TOLERANCE = 1e-6  # of forces without slopes, which are then known to 1e-8
_AXES = "yzx"  # along which each mode moves


class Runs(NamedTuple):
    """FEM at positions x (r, p) in the box: forces (r, j) in N and their slopes in x (r, j, p).

    NaN where FEM did not converge.
    """

    x: np.ndarray
    force: np.ndarray
    slopes: np.ndarray


@dataclass(frozen=True, eq=False)
class Cube:
    """One cube of a heart by FEM; its points are those of its three curves, one after the other.

    cells : along an edge. sloping : whether slopes of forces are asked for.
    """

    number: int
    sizes: np.ndarray
    curves: Sequence[Curve]
    cells: int = cube.CELLS
    sloping: bool = True

    @cached_property
    def simulator(self) -> em.Simulator:
        """FEM of the cube. From rest 4 steps of Newton's method do; with stress iterates 7."""
        scene = cube.scene(self.number, self.sizes, self.cells)
        options = em.fem.NewtonOptions(stress_iterates=False)
        if not self.sloping:  # slopes are those of an equilibrium; forces alone need a step less
            options = replace(options, tolerance=_TOLERANCE)
        return em.Simulator(scene, options)

    @property
    def body(self) -> em.Scene:
        """The scene."""
        return self.simulator.scene

    @property
    def unknowns(self) -> int:
        """Material parameters and angles, p; the rest of theta are the amounts."""
        return len(self.body.parameters) - len(cube.AMOUNTS)

    def thetas(self, x: jax.Array, mode: int, amounts: jax.Array) -> jax.Array:
        """Theta (k, p + 3) at the position ``x`` (p,) and ``amounts`` (k,) of a mode."""
        rest = jnp.full(len(cube.AMOUNTS), 0.5)
        theta = self.body.from_unit(jnp.concatenate([0.5 * (x + 1.0), rest]))
        column = self.unknowns + mode
        return jnp.tile(theta, (len(amounts), 1)).at[:, column].set(amounts)

    def runs(self, x: np.ndarray, modes: Sequence[int] = range(3)) -> Runs:
        """FEM at positions (r, p) of these modes, as many at once as there are cores."""
        if not len(x):
            j = self.amounts[list(modes)].size
            return Runs(x, np.empty((0, j)), np.empty((0, j, self.unknowns)))
        run = partial(self._run, modes)
        first = run(jnp.asarray(x[0]))  # compiles what the others use
        with ThreadPoolExecutor(cores()) as pool:
            each = [first, *pool.map(lambda row: run(jnp.asarray(row)), x[1:])]
        return Runs(x, *(np.stack(part) for part in zip(*each, strict=True)))

    def _run(self, modes: Sequence[int], x: jax.Array) -> list[np.ndarray]:
        parts = []
        for mode in modes:
            curve = self.curves[mode]
            half = len(curve.amount) // 2
            below = [p[::-1] for p in self._half(x, mode, curve.amount[:half][::-1])]
            parts += [below, self._half(x, mode, curve.amount[half:])]
        return [np.concatenate(p) for p in zip(*parts, strict=True)]

    def _half(self, x: jax.Array, mode: int, amounts: np.ndarray) -> list[np.ndarray]:
        """Forces and their slopes on the way from rest to the last of ``amounts``."""
        thetas = self.thetas(x, mode, jnp.asarray(amounts))
        found = self.simulator.path(thetas)
        # Behind a point that did not converge the path is lost.
        sound = np.logical_and.accumulate(np.asarray(found.converged))
        rates = 0.5 * np.asarray(self.body.space.rates(thetas)[:, : self.unknowns])
        force, slopes = np.full(len(amounts), np.nan), np.full(rates.shape, np.nan)
        for k in np.flatnonzero(sound):
            value, rising = self._forces[mode](found.displacement[k], thetas[k])
            force[k] = value
            slopes[k] = rising[: self.unknowns] * rates[k]
        return [force, slopes]

    @cached_property
    def _forces(self) -> list[Callable[[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]]:
        """Of each mode, the force along its motion in N with its gradient (p + 3,) in theta."""

        def along(axis: str) -> Callable[[jax.Array, jax.Array], jax.Array]:
            force = cal.Reaction(self.body, "right", axis)
            return lambda u, theta: force.evaluate(u[force.nodes], theta)

        each = [along(axis) for axis in _AXES]
        if self.sloping:
            return [self.simulator.gradient_of(quantity) for quantity in each]
        nothing = jnp.full(len(self.body.parameters), jnp.nan)
        return [jax.jit(lambda u, theta, of=of: (of(u, theta), nothing)) for of in each]

    @property
    def amounts(self) -> np.ndarray:
        """Of the three modes, (3, j)."""
        return np.stack([curve.amount for curve in self.curves])

    @property
    def area(self) -> float:
        """Of a plate, mm2."""
        return float(self.sizes[0] * self.sizes[1])


def cubes(heart: Heart, cells: int = cube.CELLS, *, sloping: bool = True) -> list[Cube]:
    """The three cubes of a heart."""
    return [Cube(k, heart.sizes[k], heart.of_cube(k), cells, sloping) for k in range(3)]


class Emulated(NamedTuple):
    """The emulator of a heart's forces, arrays only, so that one program serves all hearts.

    process : of each cube, arrays with a first axis of 3. finer : (3, k) by which a finer mesh's
    forces differ, a factor. amounts : (3, 3, j). H, C : as of
    :func:`.cube.homogeneous`. area : (3,) mm2.
    """

    process: Process
    finer: jax.Array
    amounts: jax.Array
    H: jax.Array
    C: jax.Array
    area: jax.Array


def forces(emulated: Emulated, x: jax.Array) -> jax.Array:
    """Forces (3, k) in N of a heart's cubes at positions (3, p)."""
    phi = jnp.stack([process.features(k, x[k], H) for k, H in enumerate(emulated.H)])
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

    def left(self, number: int, x: np.ndarray) -> np.ndarray:
        """Correlation that a cube's runs leave of q and its slopes at positions (m, p)."""
        points, _ = process.values_and_slopes(number, x, self.emulated.H[number])
        return process.left(self.known[number], self.lengths[number], points)

    def unknown(self, number: int, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Share (m,) of q's variance that a cube's runs leave at positions (m, p), and B (k, k)."""
        points = process.values(number, x, self.emulated.H[number])
        return process.shares(self.known[number], self.lengths[number], points)


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
    known = [_known(k, each, H, C, area) for k, each in enumerate(runs)]
    rows = process.room(max(told.runs for told in known))
    starts = [None] * len(known) if before is None else list(before.lengths)

    def made_of(told: Known, start: np.ndarray | None) -> Process:
        return process.conditioned(told, process.likeliest(told, start), rows)

    # Two factorisations on a core each take half of the time of two on both, one after the other.
    with threadpool_limits(1), ThreadPoolExecutor(cores()) as pool:
        made = list(pool.map(made_of, known, starts))
    one = jax.tree.map(lambda *each: jnp.stack(each), *made)
    rest = (jnp.asarray(amounts), H, C, area)
    return Fit(Emulated(one, jnp.ones(one.mean.shape), *rest), known)


def _known(k: int, runs: Runs, H: jax.Array, C: jax.Array, area: jax.Array) -> Known:
    """What one cube's runs say of its q."""
    told = []
    for row in runs.x:
        value, slopes = _formula_and_slopes(jnp.tile(jnp.asarray(row), (len(H), 1)), H, C, area)
        told.append((np.asarray(value)[k], np.asarray(slopes)[k]))
    formula, rising = (np.stack(part) for part in zip(*told, strict=True))
    ratio = runs.force / formula
    sound = (np.isfinite(ratio) & (ratio > 0.0)).all(axis=1)
    if not sound.sum() > 0.5 * len(sound):
        raise em.SolverError(f"{(~sound).sum()} of {len(sound)} runs of cube {k + 1} failed")
    slopes = (runs.slopes / runs.force[..., None] - rising / formula[..., None])[sound]
    return process.known(k, runs.x[sound], np.log(ratio[sound]), slopes, H[k])
