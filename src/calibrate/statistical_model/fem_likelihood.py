"""FEM's log likelihood at draws of a posterior, beside the cheap map's.

It is the only place that solves FEM for a draw.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from calibrate.statistical_model.model import Data, Model
from emulator.core.errors import InputError
from emulator.fem import Simulator
from emulator.fem.campaign import Field, Neighbours, Runs, Solver, Task, many_solves
from emulator.fem.energy import volume_ratio
from emulator.fem.solution import EquilibriumSolver
from emulator.scenes.scene import Scene

_KEPT_BITS = 40  # bits of theta that tell solutions apart, relative to its size
_KEPT_TO = 2.0**_KEPT_BITS
_MOST_BYTES = 1e9  # of solutions that are kept unasked


class Likelihoods(NamedTuple):
    """Log likelihoods of the data at one draw.

    fem : the log likelihood with FEM's displacement; ``-inf`` where FEM did not converge in a load
        state.
    cheap : the log likelihood with the model's forward map; ``-inf`` where it has no answer.
    converged : whether FEM converged in every load state.
    smallest_J : smallest volume ratio det F in the body, by FEM; NaN where it did not converge.
    means : FEM's data without noise, by the observation's name; empty where it did not converge.
    stable : whether FEM's equilibrium is a minimum of the energy; ``None`` where this was not
        examined, FEM did not converge or the scene has no energy.
    slopes : derivatives (m, S, p) of the flat means in theta of every load state, each in the
        datum's unit over the parameter's; ``None`` where they were not computed or do not exist.
    """

    fem: float
    cheap: float
    converged: bool
    smallest_J: float
    means: Mapping[str, jax.Array] = MappingProxyType({})
    stable: bool | None = None
    slopes: np.ndarray | None = None


def _key(theta: np.ndarray) -> bytes:
    """Return ``theta`` (p,) to 40 bits, as bytes: equal for one draw, whoever transformed it."""
    mantissa, exponent = np.frexp(theta)
    return np.ldexp(np.round(mantissa * _KEPT_TO), exponent - _KEPT_BITS).tobytes()


class FEMLikelihood:
    """FEM's log likelihood under ``model``.

    Solves start from the cheap map's prediction, from the nearest solution that was kept, or from
    the draw's solution in a lower load state.

    model : the statistical model.
    simulator : the simulator of the model's scene, or of its specimen.
    kept : the solutions at which nothing is solved again, with their sensitivities, by the bytes of
        their theta to 40 bits; those of every solve are added. By default the most recent are kept,
        up to 1 GB.

    :class:`InputError` where the simulator is for another scene.
    """

    def __init__(
        self,
        model: Model,
        simulator: EquilibriumSolver,
        *,
        kept: dict[bytes, Field] | None = None,
    ) -> None:
        if simulator.scene.fingerprint != model.forward.scene.fingerprint:
            raise InputError("the simulator's scene is not the posterior's")
        self.model, self.simulator = model, simulator
        self.kept, self._keeps_all = {} if kept is None else kept, kept is not None
        self._solved_before = False
        self._start, self._cheap = jax.jit(model.full), jax.jit(model.map_log_likelihood)
        self._fem, self._derivatives = jax.jit(self._by_fem), jax.jit(self._slopes_of_means)

    def __call__(
        self, draw: Mapping[str, Any], data: Data, *, stability: bool = False
    ) -> Likelihoods:
        """Return the log likelihoods at ``draw``, a number for each of the model's ``names``.

        ``stability`` asks for ``stable`` as well, at the cost of one more factorisation a state.
        """
        return next(self.many([draw], data, stability=(0,) if stability else ()))[1]

    def many(
        self,
        draws: Sequence[Mapping[str, Any]],
        data: Data,
        *,
        stability: Collection[int] = (),
        slopes: bool = False,
    ) -> Iterator[tuple[int, Likelihoods]]:
        """Yield numbers of ``draws`` and their log likelihoods, as they are finished.

        stability : numbers of the draws for which ``stable`` is asked, too.
        slopes : whether ``slopes`` are asked for every draw, at a tenth of the time of a solve.
        """
        for number, solved in self.equilibria(draws, slopes=slopes):
            draw, thetas = draws[number], self.model.states.thetas(draws[number])
            cheap = float(self._cheap(dict(draw), data))
            if solved is None:
                yield number, Likelihoods(-np.inf, cheap, converged=False, smallest_J=np.nan)
                continue
            fields = [field.displacement for field in solved]
            fem, means, smallest_J = self._fem(jnp.stack(fields), thetas, dict(draw), data)
            stable = self._stable(fields, thetas) if number in stability else None
            derivatives = self._slopes(solved, thetas) if slopes else None
            values = (float(fem), cheap, True, float(smallest_J), means, stable, derivatives)
            yield number, Likelihoods(*values)

    def equilibria(
        self, draws: Sequence[Mapping[str, Any]], *, slopes: bool = False
    ) -> Iterator[tuple[int, list[Field] | None]]:
        """Yield numbers of ``draws`` and their solutions, as they are finished.

        They are FEM's in each load state; ``None`` stands for a draw at which FEM did not converge
        in one of the states.

        slopes : whether the solutions have their sensitivities.
        """
        thetas = jnp.concatenate([self.model.states.thetas(draw) for draw in draws])
        states, keys = len(self.model.states.states), [_key(row) for row in np.asarray(thetas)]
        kept = {k: f for k, f in self.kept.items() if f.sensitivities is not None or not slopes}
        unsolved = dict[int, _Draw]()
        for number in range(len(draws)):
            rows = range(number * states, (number + 1) * states)
            known = {row: kept[keys[row]] for row in rows if keys[row] in kept}
            if len(known) == states:
                yield number, [known[row] for row in rows]
            else:
                unsolved[number] = _Draw(number, rows, known, {})
        nearest, near = self._kept_beside(thetas)

        def begun(draw: _Draw) -> _Draw:
            """Return the draw with the starts that are known when its solves begin."""
            starts = dict[int, tuple[jax.Array, ...]]()
            for row in (row for row in draw.rows if row not in draw.known):
                by_map, beside = self._start(thetas[row]), nearest(row)
                # The solver takes the last start of an imaged body. Where the caller keeps all
                # solutions, they teach a map that predicts nothing yet, so theirs comes last.
                starts[row] = (by_map, *beside) if self._keeps_all else (*beside, by_map)
            return draw._replace(starts=starts)

        solver = _DrawSolver(Solver(self.simulator, sensitivities=slopes), thetas)
        # Not under jit: there the solver cannot use CHOLMOD, which is faster.
        alone, self._solved_before = int(not self._solved_before), True
        tasks = map(begun, unsolved.values())
        for draw in many_solves(self.simulator, solver, tasks, alone=alone):
            for row in sorted(draw.starts.keys() & draw.known.keys()):
                self._keep(keys[row], draw.known[row])
                near[row] = draw.known[row]
            solved = len(draw.known) == states
            yield draw.number, [draw.known[row] for row in draw.rows] if solved else None

    def _keep(self, key: bytes, field: Field) -> None:
        self.kept[key] = field
        size = sum(np.asarray(array).nbytes for array in field if array is not None)
        while not self._keeps_all and len(self.kept) * size > _MOST_BYTES:
            del self.kept[next(iter(self.kept))]

    def _kept_beside(
        self, thetas: jax.Array
    ) -> tuple[Callable[[int], list[jax.Array]], dict[int, Field]]:
        """Return the starts of each of ``thetas`` (c, p) by its number, and what they come from.

        They come from kept solutions, and from those that are added by the numbers of ``thetas``.
        """
        if not isinstance(self.simulator, Simulator):  # a specimen has one start
            return lambda _: [], {}
        count, width = thetas.shape
        known = np.array([np.frombuffer(key) for key in self.kept]).reshape(-1, width)
        fields = {count + k: field for k, field in enumerate(self.kept.values())}
        every = jnp.concatenate([thetas, known])
        return Neighbours(self.simulator.scene, every, fields), fields

    def _stable(self, fields: list[jax.Array], thetas: jax.Array) -> bool | None:
        """Return whether every state's equilibrium is a minimum of the energy, if there is one."""
        scene = self.simulator.scene
        if not isinstance(scene, Scene):
            has_energy = True
        elif scene.loaded_by:  # without a system of its own: one at rest for each theta
            has_energy = all(load.has_potential for load in scene.loads)
        else:
            has_energy = not cast(Simulator, self.simulator).system.forces
        if not has_energy:
            return None
        states = zip(fields, thetas, strict=True)
        stable = [self.simulator.is_stable(u, theta) for u, theta in states]
        return None if None in stable else all(stable)

    def _slopes(self, solved: list[Field], thetas: jax.Array) -> np.ndarray | None:
        """Return derivatives (m, S, p) of the flat means, by those of the equilibria."""
        nodes = self.model.observe.nodes
        u = jnp.stack([jnp.asarray(field.displacement)[nodes] for field in solved])
        du = jnp.stack([jnp.asarray(field.sensitivities)[:, nodes] for field in solved])
        slopes = np.asarray(self._derivatives(u, du, thetas))
        return slopes if np.isfinite(slopes).all() else None

    def _slopes_of_means(self, u: jax.Array, slopes: jax.Array, thetas: jax.Array) -> jax.Array:
        """Return derivatives (m, S, p), from u (S, k, 3) and du/dtheta (S, p, k, 3) there."""

        def means(shifted: jax.Array) -> jax.Array:
            step = jnp.einsum("sp,sp...->s...", shifted - thetas, slopes)
            return ravel_pytree(self.model.observe(u + step, shifted))[0]

        return jax.jacfwd(means)(thetas)

    def _by_fem(self, fields: jax.Array, thetas: jax.Array, draw: Data, data: Data) -> Any:
        """Return the log likelihood, the means and the smallest volume ratio."""
        means = self.model.observe(fields[:, self.model.observe.nodes], thetas)
        value = self.model.log_likelihood(draw, means, data)
        ratios = [volume_ratio(self.simulator.scene, u) for u in fields]
        return value, means, jnp.min(jnp.stack(ratios))


class _Draw(NamedTuple):
    """The load states of one draw.

    number : the number of the draw. rows : the rows of its states in theta.
    known : the solutions by row.
    starts : the displacements (n, 3) mm from which the solve of a row may start, by row.
    """

    number: int
    rows: range
    known: dict[int, Field]
    starts: dict[int, tuple[jax.Array, ...]]


@dataclass(frozen=True)
class _DrawSolver:
    """Solves the load states of a draw, the smallest load first, until one fails.

    A state may start from the one before, and from there along its sensitivities: a soft ventricle
    takes 3 to 5 factorisations so, and 29 from rest.

    thetas : theta (c, p) by row.
    """

    solver: Solver
    thetas: jax.Array

    def __call__(self, draw: _Draw) -> _Draw:
        """Return the draw with its solutions; fewer than its rows where a solve failed."""
        scene, known = self.solver.simulator.scene, dict(draw.known)
        columns = [scene.parameter_names.index(name) for name in scene.load_parameters]
        loads = {row: np.abs(np.asarray(self.thetas[row])[columns]).sum() for row in draw.rows}
        before: int | None = None
        for row in sorted(loads, key=lambda row: loads[row]):
            if row not in known:
                beside = () if before is None else self._starts(row, before, known[before])
                task = Task(row, self.thetas[row], (*beside, *draw.starts[row]))
                result = self.solver(task)
                if not result.converged:
                    break
                known[row] = Field(result.solution.displacement, result.sensitivities)
            before = row
        return draw._replace(known=known)

    def _starts(self, row: int, before: int, field: Field) -> tuple[jax.Array, ...]:
        """Return the starts of a state from the solution of the one before."""
        if not isinstance(self.solver.simulator, Simulator):  # one start, of a specimen
            return ()
        u, step = jnp.asarray(field.displacement), self.thetas[row] - self.thetas[before]
        if field.sensitivities is None:
            return (u,)
        return u, u + jnp.tensordot(step, jnp.asarray(field.sensitivities), axes=1)


def runs_of(kept: Mapping[bytes, Field]) -> Runs:
    """Return solutions that were kept, the last first: where there are too many, the first go."""
    thetas, fields = list(kept)[::-1], list(kept.values())[::-1]
    return Runs(
        jnp.asarray([np.frombuffer(theta) for theta in thetas]),
        jnp.stack([jnp.asarray(field.displacement) for field in fields]),
        jnp.full(len(fields), jnp.nan),
        jnp.stack([jnp.asarray(field.sensitivities) for field in fields]),
    )
