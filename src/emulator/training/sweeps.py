r"""Recipe ``sweeps``: equilibria over the whole box from residuals alone, without an FEM solution.

The displacement is a polynomial of theta, at first zero. A *sweep* draws new theta, finds at each
of them how far the polynomial is from equilibrium (:mod:`~emulator.training.targets`: one guarded
step, a few substitutions with a factor that eight neighbours share), and fits the polynomial to
where the steps lead (:func:`~emulator.surrogates.polynomial.fit`). So the potential is minimised
over the box at once, with a preconditioner in place of the energy's plain gradient.

The loads rise over the first sweeps, and each new level starts at the extrapolation of the last
two. A level that most steps do not reach is tried again with a smaller rise, and one that is
reached roughly gets more sweeps. At one level the targets of earlier sweeps are kept, each with its
remaining error, and the degree of the polynomial grows with their number as long as the newest
targets, which no fit has seen, say that it should. At a theta not seen before the step is the
polynomial's own error to first order, so that every sweep gives an honest error bar, and the sweeps
end where that is round-off.

The sweeps begin at rest, or under the whole load at a series about the centre of the box, which is
one FEM solution, or where the network of a family says. Where that is too rough for a tangent to be
positive definite anywhere, so that no step can be taken, they begin again at the network with the
same solution and slopes at the centre as FEM. On a finer mesh they can stand on a map of the
coarser one: the polynomial is then what that map leaves, which is small and smooth, so that a low
degree and a few sweeps do.

A sweep of c theta costs c/8 factorisations and, for each theta, some six substitutions and
products. Smooth equilibria are followed to round-off in a few parameters; in five, terms run out.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.checkpoint import Checkpoint
from emulator.core.display import counting
from emulator.core.errors import InputError, SolverError
from emulator.fem import Simulator
from emulator.fem.campaign import Runs
from emulator.fem.compiled import compiled
from emulator.fem.energy import potential_energy
from emulator.scenes.scene import Scene
from emulator.surrogates.emulator import Emulator
from emulator.surrogates.polynomial import (
    MOST_TERMS,
    Polynomial,
    PolynomialFit,
    Samples,
    best_degree,
    compressed,
    degrees_up_to,
    fit,
    legendre,
    terms,
)
from emulator.surrogates.taylor import expand
from emulator.training.job import Job, Recipe
from emulator.training.mechanics import anchored, family_on, of_position
from emulator.training.plan import Plan, check_order
from emulator.training.targets import Map, free_fields, targets
from emulator.training.two_meshes import on_finer

_LEVELS = 15  # least number of levels of the loads
# Least fraction of a step that counts as a success, and least share of successes at a level.
_LEAST_FRACTION, _LEAST_SHARE = 0.25, 0.9
# Relative error of the displacement up to which the loads rise, and the most sweeps at a level.
_ROUGH, _PATIENCE = 0.01, 4
_LEAST_RISE = 1.0 / 500.0
_FIRST_DEGREE = 2
_FEWEST = 32  # least number of theta in a sweep
_TARGETS_PER_TERM = 3  # targets kept for each term of the next degree
_CONVERGED = 1e-10  # relative error of the displacement at which the sweeps end
_ROUNDED = 1e-2  # largest error of truncated modes, over the error bar


class SweepState(NamedTuple):
    """The state between two sweeps.

    polynomial : the polynomial of the free displacements.
    before : the polynomial's coefficients at the load level that lies ``gap`` below.
    values : the targets that are kept.
    number, here : the number of sweeps done, and of those at this load level.
    level, rise : the load level, and by how much it rises next.
    gap : the distance to the level of ``before``.
    error, largest_error : the median and the largest step at theta not seen before, mm.
    taken : the part of the last sweep's theta at which a step was taken.
    lost : the number of starts that were left because no step could be taken from them.
    """

    polynomial: PolynomialFit
    before: np.ndarray
    values: Samples
    number: int = 0
    here: int = 0
    level: float = 0.0
    rise: float = 1.0 / _LEVELS
    gap: float = 1.0
    error: float = np.inf
    largest_error: float = np.inf
    taken: float = 0.0
    lost: int = 0

    @property
    def done(self) -> bool:
        """Whether the error bar is round-off."""
        return self.level == 1.0 and self.error <= _CONVERGED * self._size

    @property
    def record(self) -> dict[str, Any]:
        """The entries of an emulator's record."""
        largest = float(self.largest_error)
        entries = {"number": self.number, "error_mm": self.error, "largest_error_mm": largest}
        return entries | ({"starts_left": self.lost} if self.lost else {})

    @property
    def rises(self) -> bool:
        """Whether the next sweep is at a higher load level."""
        accurate = self.error <= _ROUGH * self._size or self.here > _PATIENCE
        return self.level < 1.0 and (self.level == 0.0 or accurate)

    @property
    def _size(self) -> float:
        """The root mean square displacement of the free nodes, mm."""
        return float(np.sqrt(3.0 * np.mean(self.polynomial.coefficients[0] ** 2)))


def sweep_box(
    simulator: Simulator,
    sweeps: int,
    seed: int,
    *,
    starts: Sequence[Callable[[], Map]] = (),
    beneath: Map | None = None,
    checkpoint: Checkpoint = Checkpoint(),
    deadline: float = np.inf,
    require_time: Callable[[str], None] = lambda _: None,
    progress: bool = False,
) -> SweepState:
    """Sweep over the box of a scene until the error bar is round-off.

    simulator : the simulator of the scene.
    sweeps : the largest number of sweeps.
    seed : the seed from which the theta are drawn.
    starts : makes maps to begin at under the whole load, each where no step could be taken from the
        one before, because no tangent there is positive definite; after the last, and by default,
        sweeps begin at the body at rest.
    beneath : a map under the whole load to which the polynomial, at first zero, is added.
    checkpoint : the file where the state is kept and taken up again.
    deadline : the time, on the performance counter, after which no sweep begins, once the loads are
        at their whole level.
    require_time : raises an error where there is no more time for the loads to rise.
    progress : whether a progress bar is shown.

    Raises :class:`SolverError`: equilibria were not followed up to the loads, or not over the whole
    box.
    """
    state = checkpoint.restore(lambda: _at_rest(simulator))
    if state is None:
        state = _initial_state(simulator, starts, 0, beneath)
    with counting(desc="sweeps", initial=state.number, total=sweeps, disable=not progress) as bar:
        while state.number < sweeps and not state.done:
            if time.perf_counter() > deadline:
                if state.level == 1.0:
                    break
                require_time(f"{state.number} sweeps at {100 * state.level:.0f} % of the loads")
            state, display = _sweep(simulator, state, seed, beneath)
            if state.lost < len(starts) and state.level == 1.0 and not np.isfinite(state.error):
                state = _initial_state(simulator, starts, state.lost + 1)._replace(
                    number=state.number
                )
            bar.set_postfix(display)
            bar.update()
            checkpoint.keep(lambda: state)  # noqa: B023
    checkpoint.write(lambda: state)
    if state.level < 1.0:
        cause = "no step could be taken from where the start says, and then " * bool(state.lost)
        failure = f"followed the equilibria to {100 * state.level:.0f} % of the loads"
    elif state.taken < _LEAST_SHARE:
        cause = ""
        failure = f"know no equilibrium at {100 * (1.0 - state.taken):.0f} % of the box"
    else:
        return state
    raise SolverError(
        f"scene '{simulator.scene.name}': {cause}{state.number} sweeps {failure}; give more of "
        "them, or use a recipe with FEM runs"
    )


def check_sweeps(scene: Scene, sweeps: int, *, at_rest: bool) -> None:
    """Raise :class:`InputError` for a scene that cannot be swept.

    A load of the scene has no potential, or sweeps from rest are too few for the loads to rise.
    """
    potential_energy(scene)  # raises InputError for a scene without one
    if at_rest and sweeps <= _LEVELS:
        raise InputError(
            f"training: {sweeps} sweeps; the loads rise over {_LEVELS}, give {_LEVELS + 1} or more"
        )


def _at_rest(simulator: Simulator) -> SweepState:
    parameters, free = len(simulator.scene.parameters), len(simulator.system.free)
    degrees = degrees_up_to(parameters, _first_degree(parameters))
    zero = np.zeros((len(degrees), free))
    none = Samples(np.zeros((0, parameters)), np.zeros((0, free)), np.zeros(0))
    return SweepState(PolynomialFit(degrees, zero), zero, none)


def _first_degree(parameters: int) -> int:
    return _FIRST_DEGREE if terms(parameters, _FIRST_DEGREE) <= MOST_TERMS else 1


def _initial_state(
    simulator: Simulator,
    starts: Sequence[Callable[[], Map]],
    lost: int,
    beneath: Map | None = None,
) -> SweepState:
    """Return the state before the first sweep; its polynomial is fitted to ``lost``, if any.

    A start that is not finite, or that FEM finds no solution for, is left for the next.
    """
    rest = _at_rest(simulator)._replace(lost=lost)
    if beneath is not None:
        return rest._replace(level=1.0)
    if lost == len(starts):
        return rest
    parameters, degree = rest.values.position.shape[1], rest.polynomial.degree
    if terms(parameters, degree + 1) <= MOST_TERMS:
        degree += 1
    position = np.random.default_rng(0).random((2 * terms(parameters, degree), parameters))
    try:
        fields = free_fields(simulator, starts[lost](), position)
    except SolverError:
        return _initial_state(simulator, starts, lost + 1)
    if not np.isfinite(fields).all():
        return _initial_state(simulator, starts, lost + 1)
    polynomial = fit(Samples(position, fields, np.zeros(len(position))), degree, 1.0)
    zeros = 0.0 * polynomial.coefficients
    return rest._replace(polynomial=polynomial, before=zeros, level=1.0)


def _sweep(
    simulator: Simulator, state: SweepState, seed: int, beneath: Map | None
) -> tuple[SweepState, dict[str, Any]]:
    """Return the state after one sweep, and the numbers that the progress bar shows."""
    from scipy.stats import qmc  # slow to import, and only for sweeps

    parameters, count = len(simulator.scene.parameters), _FEWEST
    while count < 2 * terms(parameters, _first_degree(parameters)):
        count *= 2
    rng = np.random.default_rng([seed, state.number])
    position = qmc.Sobol(parameters, rng=rng).random(count)
    level, extrapolation = _next_level(state) if state.rises else (state.level, state.polynomial)
    below = 0.0 if beneath is None else free_fields(simulator, beneath, position)
    steps = targets(
        simulator, below + extrapolation.at(position), position, level, first=state.number == 0
    )
    usable = np.isfinite(steps.error)
    usable_share = float(np.mean(usable & (steps.fraction >= _LEAST_FRACTION)))
    display = {"load": f"{level:.2f}", "taken": f"{usable_share:.2f}"}
    if not usable.any() or (state.rises and usable_share < _LEAST_SHARE):
        if state.rise > _LEAST_RISE:
            after = state._replace(rise=state.rise / 2.0)
        else:  # more sweeps at the level that is known
            after = state._replace(rise=1.0 / _LEVELS, here=0, error=np.inf)
    else:
        new = Samples(position, steps.fields - below, steps.error).take(usable)
        after = _fitted(state, level, new, float(np.median(steps.step[usable])))
        after = after._replace(largest_error=steps.step[usable].max())
        if not state.rises:
            display["energy gap"] = f"{np.median(steps.gap[usable]):.0e}"
    display |= {"degree": f"{after.polynomial.degree}", "error_mm": f"{after.error:.1e}"}
    return after._replace(number=state.number + 1, taken=usable_share), display


def _next_level(state: SweepState) -> tuple[float, PolynomialFit]:
    """Return the level of the next sweep, and the extrapolation of the last two levels to it."""
    level = state.level + state.rise
    level = level if level < 1.0 - _LEAST_RISE else 1.0
    now, before = state.polynomial, state.before
    reach = (level - state.level) / state.gap
    return level, now._replace(coefficients=now.coefficients + reach * (now.coefficients - before))


def _fitted(state: SweepState, level: float, new: Samples, error: float) -> SweepState:
    """Return the state after targets ``new``, to which the median step is ``error``.

    level : the level of the targets: a higher one, of which nothing else is known, or the state's.
    """
    if level != state.level:
        known, degree, before = new, state.polynomial.degree, state.polynomial.coefficients
        rise, gap = min(1.5 * state.rise, 1.0 / _LEVELS), level - state.level
        state = state._replace(here=0, level=level, rise=rise, gap=gap)
    else:
        degree = best_degree(state.values, new, state.polynomial.degree, error)
        before = state.before
        most = _TARGETS_PER_TERM * min(terms(new.position.shape[1], degree + 1), MOST_TERMS)
        known = state.values.followed_by(new).take(slice(-max(most, 4 * len(new.position)), None))
    polynomial = fit(known, degree, error)
    padded = np.zeros_like(polynomial.coefficients)  # terms of low degree come first
    shared = min(len(padded), len(before))
    padded[:shared] = before[:shared]
    state = state._replace(polynomial=polynomial, before=padded, values=known)
    return state._replace(here=state.here + 1, error=error)


def polynomial_part(simulator: Simulator, state: SweepState) -> Polynomial:
    """Return the polynomial as a part of an emulator, with as many modes as its error needs."""
    fields = jax.vmap(simulator.system.extend)(jnp.asarray(state.polynomial.coefficients))
    return compressed(state.polynomial.degrees, np.asarray(fields), _ROUNDED * state.error)


def runs_of(simulator: Simulator, state: SweepState, thetas: jax.Array) -> Runs:
    """Return displacements, energies and slopes of the polynomial at ``thetas`` (c, p)."""
    scene, system = simulator.scene, simulator.system
    degrees, coefficients = state.polynomial

    def displacement(theta: jax.Array) -> jax.Array:
        v = legendre(scene.to_unit(theta), degrees) @ coefficients
        return scene.on_supports(system.extend(v), theta)

    def run_at(theta: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        u, slopes = displacement(theta), jax.jacfwd(displacement)(theta)
        return u, system.potential(u, theta)[0], jnp.moveaxis(slopes, -1, 0)

    return Runs(thetas, *compiled(lambda t: jax.lax.map(run_at, t))(thetas))


@dataclass(frozen=True)
class Sweeps(Plan):
    """A polynomial fitted by sweeps over the box.

    sweeps : the largest number of sweeps.
    order : the order of the series at which they begin; 0 for a body at rest, or the network.
    """

    recipe: str = "sweeps"
    sweeps: int = 60
    order: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_at_least(1, "sweeps")
        check_order(self.order)


def train_sweeps(plan: Sweeps, job: Job) -> Emulator:
    """Return the emulator and its record."""
    scene, start, simulator = job.scene, job.start, job.simulator
    check_sweeps(scene, plan.sweeps, at_rest=not plan.order and start is None)
    emulator = Emulator(scene)
    starts: list[Callable[[], Map]] = []
    beneath: Map | None = None
    if start is not None and start.family is not None:
        network = family_on(scene, start)

        def at_the_centre() -> Map:
            return of_position(anchored(network, expand(simulator, order=plan.order or 1)))

        starts = [at_the_centre] if plan.order else [lambda: of_position(network), at_the_centre]
    elif start is not None:
        emulator = on_finer(start, scene, plan)
        if plan.order:
            raise InputError(
                f"recipe '{plan.recipe}': an emulator on the coarser mesh to stand on, and a "
                f"series of order {plan.order} to begin at; give one of them"
            )
        beneath = of_position(emulator)
    elif plan.order:
        starts = [lambda: expand(simulator, order=plan.order)]
    state = sweep_box(
        simulator,
        plan.sweeps,
        plan.seed,
        starts=starts,
        beneath=beneath,
        checkpoint=job.checkpoint("sweeps"),
        deadline=job.deadline(0.99),
        require_time=job.require_time,
        progress=job.progress,
    )
    solved = int(state.lost > 0 or plan.order > 0) if starts else 0
    record = replace(plan, sweeps=state.number).record()
    record["sweeps"] = state.record | {"fem_solutions": solved}
    return replace(emulator, polynomial=polynomial_part(simulator, state), record=record)


SWEEPS = Recipe(Sweeps(), train_sweeps)
