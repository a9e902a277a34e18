r"""Equilibria over the whole box from residuals alone, without one FEM solution.

The displacement is a polynomial of theta, at first zero. A *sweep* draws theta anew, asks at each
how far the polynomial is from equilibrium (:mod:`~emulator.training.targets`: one guarded step, a
few substitutions with a factor that eight neighbours share), and fits the polynomial to where the
steps lead (:mod:`~emulator.training.regression`). So the potential is minimised over the box at
once, with a preconditioner in place of the energy's plain gradient.

The loads rise over the first sweeps, to where the last two levels point; a level that most steps
do not reach is tried again nearer, and one that is reached roughly gets more sweeps. At one level
the targets of earlier sweeps are kept, each with what it may still be off, and their number lets
the degree of the polynomial grow, as long as the newest targets, which no fit has seen, say that
it should. At a theta not seen before the step is the polynomial's own error to first order, so
that every sweep tells an honest error bar, and the sweeps end where that is round-off.

On a finer mesh the sweeps can stand on a map of the coarser one, carried over: the polynomial is
then what that leaves, which is small and smooth, so that a low degree and a few sweeps do.

A sweep of c theta costs c/8 factorisations and, for each theta, some six substitutions and
products. Smooth equilibria are followed to round-off in a few parameters; in five, terms run out.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError, SolverError
from emulator.core.progress import counting
from emulator.core.store import read_arrays, save_arrays
from emulator.fem import Simulator
from emulator.fem.campaign import Runs
from emulator.fem.compiled import compiled
from emulator.fem.energy import potential_energy
from emulator.scenes.scene import Scene
from emulator.surrogates.polynomial import (
    Polynomial,
    compressed,
    degrees_up_to,
    legendre,
    terms,
)
from emulator.training.checkpoint import SWEEPS
from emulator.training.regression import MOST_TERMS, Fitted, Values, best_degree, fit
from emulator.training.targets import targets

_LEVELS = 15  # of the load, at least
_TAKEN, _ENOUGH = 0.25, 0.9  # fraction of a step that will do, and part of the steps that have to
_ROUGH, _PATIENCE = 0.01, 4  # error of the displacement, and sweeps at a level that make it less
_LEAST_RISE = 1.0 / 500.0
_FIRST_DEGREE = 2
_FEWEST = 32  # theta a sweep
_KEPT = 3  # targets a term of the next degree
_DONE = 1e-10  # of the displacement, that the error bar ends at
_ROUNDED = 1e-2  # of the error bar, that modes may be left out for
_WRITE_EVERY = 30.0  # seconds
_NUMBERS = ("number", "here", "level", "rise", "ago", "left", "worst", "taken", "lost")

Map = Callable[[jax.Array], jax.Array]


@dataclass(frozen=True, eq=False)
class Swept:
    """Where the sweeps are.

    polynomial : of the free displacements. number : sweeps done, ``here`` of them at this level.
    level, rise : of the loads, and by how much they rise next. before : coefficients at the level
    ``ago`` below. left, worst : mm, median and largest step at theta not seen before. taken : part
    of the last sweep's theta at which a step was. values : targets kept. lost : whether no step
    could be taken from where a start said, so that they went on from rest.
    """

    polynomial: Fitted
    before: np.ndarray
    values: Values
    number: int = 0
    here: int = 0
    level: float = 0.0
    rise: float = 1.0 / _LEVELS
    ago: float = 1.0
    left: float = np.inf
    worst: float = np.inf
    taken: float = 0.0
    lost: bool = False

    @property
    def done(self) -> bool:
        """Whether the error bar is round-off."""
        return self.level == 1.0 and self.left <= _DONE * self._size

    @property
    def record(self) -> dict[str, Any]:
        """What an emulator's record tells of them."""
        told = {"number": self.number, "error_mm": self.left, "largest_error_mm": float(self.worst)}
        return told | ({"start": "left for rest"} if self.lost else {})

    @property
    def rises(self) -> bool:
        """Whether the next sweep is at a higher level."""
        good = self.left <= _ROUGH * self._size or self.here > _PATIENCE
        return self.level < 1.0 and (self.level == 0.0 or good)

    @property
    def _size(self) -> float:
        """Root mean square displacement, mm, of all components of all free nodes."""
        return float(np.sqrt(3.0 * np.mean(self.polynomial.coefficients[0] ** 2)))


def sweep_box(
    simulator: Simulator,
    sweeps: int,
    seed: int,
    *,
    start: Map | None = None,
    beneath: Map | None = None,
    folder: Path | None = None,
    deadline: float = np.inf,
    progress: bool = False,
) -> Swept:
    """Sweeps over the box of a scene.

    Parameters
    ----------
    sweeps : altogether; fewer where the error bar is round-off before. seed : of the theta.
    start : position (p,) to displacement (n, 3) mm under the whole load, as another map has it; by
        default they begin at the body at rest, and they do, too, where no step can be taken from
        there: where no tangent is positive definite.
    beneath : position (p,) to displacement (n, 3) mm under the whole load, to which the polynomial
        is added, at first zero.
    folder : where the state is kept, and taken up again.
    deadline : value of ``time.perf_counter`` after which none begins, once the loads are there.

    Raises
    ------
    InputError
        A load of the scene has no potential, or too few sweeps for the loads to rise from rest.
    SolverError
        Equilibria were not followed up to the loads, or not over the whole box.
    """
    check_sweeps(simulator.scene, sweeps, at_rest=start is None and beneath is None)
    state = _restored(folder) or _first(simulator, start, beneath)
    written = time.perf_counter()
    with counting(desc="sweeps", initial=state.number, total=sweeps, disable=not progress) as bar:
        while state.number < sweeps and not state.done:
            if time.perf_counter() > deadline and state.level == 1.0:
                break
            state, told = _sweep(simulator, state, seed, beneath)
            if start is not None and state.level == 1.0 and not np.isfinite(state.left):
                state = replace(_at_rest(simulator), number=state.number, lost=True)
            bar.set_postfix(told)
            bar.update()
            if folder is not None and time.perf_counter() - written > _WRITE_EVERY:
                _keep(folder, state)
                written = time.perf_counter()
    if folder is not None:
        _keep(folder, state)
    if state.level < 1.0:
        lost = "no step could be taken from where the start says, and from rest " * state.lost
        raise SolverError(
            f"scene '{simulator.scene.name}': {lost}{state.number} sweeps followed the equilibria "
            f"to {100 * state.level:.0f} % of the loads; give more of them, or use a recipe with "
            "FEM runs"
        )
    if state.taken < _ENOUGH:
        raise SolverError(
            f"scene '{simulator.scene.name}': {state.number} sweeps know no equilibrium at "
            f"{100 * (1.0 - state.taken):.0f} % of the box; give more of them, or use a recipe "
            "with FEM runs"
        )
    return state


def check_sweeps(scene: Scene, sweeps: int, *, at_rest: bool) -> None:
    """Refuse what cannot be swept, with the :class:`InputError` of :func:`sweep_box`."""
    potential_energy(scene)  # refuses a scene that has none
    if at_rest and sweeps <= _LEVELS:
        raise InputError(
            f"training: {sweeps} sweeps; the loads rise over {_LEVELS}, give {_LEVELS + 1} or more"
        )


def _first(simulator: Simulator, start: Map | None, beneath: Map | None) -> Swept:
    """The state before the first sweep."""
    if beneath is not None:
        return replace(_at_rest(simulator), level=1.0)
    return _at_rest(simulator) if start is None else _at(simulator, start)


def _at_rest(simulator: Simulator) -> Swept:
    parameters, free = len(simulator.scene.parameters), len(simulator.system.free)
    degrees = degrees_up_to(parameters, _first_degree(parameters))
    zero = np.zeros((len(degrees), free))
    none = Values(np.zeros((0, parameters)), np.zeros((0, free)), np.zeros(0))
    return Swept(Fitted(degrees, zero), zero, none)


def _at(simulator: Simulator, start: Map) -> Swept:
    """Under the whole load, where ``start`` says."""
    rest = _at_rest(simulator)
    parameters, degree = rest.values.position.shape[1], rest.polynomial.degree
    if terms(parameters, degree + 1) <= MOST_TERMS:
        degree += 1
    position = np.random.default_rng(0).random((2 * terms(parameters, degree), parameters))
    there = _fields(simulator, start, position)
    if not np.isfinite(there).all():
        return replace(rest, lost=True)
    fitted = fit(Values(position, there, np.zeros(len(position))), degree, 1.0)
    return replace(rest, polynomial=fitted, before=0.0 * fitted.coefficients, level=1.0)


def _fields(simulator: Simulator, of: Map, position: np.ndarray) -> np.ndarray:
    """What a map says at ``position`` (c, p), where free: (c, f) mm."""
    free = lambda x: simulator.system.restrict(of(x))  # noqa: E731
    return np.asarray(jax.lax.map(free, jnp.asarray(position)))


def _first_degree(parameters: int) -> int:
    return _FIRST_DEGREE if terms(parameters, _FIRST_DEGREE) <= MOST_TERMS else 1


def _sweep(
    simulator: Simulator, state: Swept, seed: int, beneath: Map | None
) -> tuple[Swept, dict[str, Any]]:
    """The state after one sweep, and what is told of it."""
    from scipy.stats import qmc  # half a second, which only this needs

    parameters, count = len(simulator.scene.parameters), _FEWEST
    while count < 2 * terms(parameters, _first_degree(parameters)):
        count *= 2
    rng = np.random.default_rng([seed, state.number])
    position = qmc.Sobol(parameters, rng=rng).random(count)
    level, ahead = _next_level(state) if state.rises else (state.level, state.polynomial)
    below = 0.0 if beneath is None else _fields(simulator, beneath, position)
    found = targets(simulator, below + ahead.at(position), position, level)
    usable = np.isfinite(found.error)
    taken = float(np.mean(usable & (found.fraction >= _TAKEN)))
    told = {"load": f"{level:.2f}", "taken": f"{taken:.2f}"}
    new = Values(position, found.fields - below, found.error).take(usable)
    steps = found.step[usable]
    if not usable.any() or (state.rises and taken < _ENOUGH):
        after = _closer(state)
    elif state.rises:
        after = replace(_risen(state, level, new, float(np.median(steps))), worst=steps.max())
    else:
        after = replace(_learned(state, new, float(np.median(steps))), worst=steps.max())
        told["energy gap"] = f"{np.median(found.gap[usable]):.0e}"
    told |= {"degree": f"{after.polynomial.degree}", "error_mm": f"{after.left:.1e}"}
    return replace(after, number=state.number + 1, taken=taken), told


def _next_level(state: Swept) -> tuple[float, Fitted]:
    """The level of the next sweep, and where the polynomials of the last two levels point to."""
    level = state.level + state.rise
    level = level if level < 1.0 - _LEAST_RISE else 1.0
    now, before = state.polynomial, state.before
    reach = (level - state.level) / state.ago
    return level, now._replace(coefficients=now.coefficients + reach * (now.coefficients - before))


def _closer(state: Swept) -> Swept:
    """The state after a level that was not reached: a lower one next, or better from here."""
    if state.rise > _LEAST_RISE:
        return replace(state, rise=state.rise / 2.0)
    return replace(state, rise=1.0 / _LEVELS, here=0, left=np.inf)


def _risen(state: Swept, level: float, new: Values, left: float) -> Swept:
    """The state at another ``level``, of which the targets ``new`` are all that is known."""
    now = state.polynomial
    fitted = fit(new, now.degree, left)
    rise = min(1.5 * state.rise, 1.0 / _LEVELS)
    ago = level - state.level
    return replace(
        state,
        polynomial=fitted,
        before=_as_long(now.coefficients, fitted),
        values=new,
        here=1,
        level=level,
        rise=rise,
        ago=ago,
        left=left,
    )


def _learned(state: Swept, new: Values, left: float) -> Swept:
    """The state after targets ``new`` at its level; ``left`` is the median step to them."""
    degree = best_degree(state.values, new, state.polynomial.degree, left)
    parameters = new.position.shape[1]
    most = _KEPT * min(terms(parameters, degree + 1), MOST_TERMS)
    known = state.values.followed_by(new).take(slice(-max(most, 4 * len(new.position)), None))
    fitted = fit(known, degree, left)
    return replace(
        state,
        polynomial=fitted,
        before=_as_long(state.before, fitted),
        values=known,
        here=state.here + 1,
        left=left,
    )


def _as_long(coefficients: np.ndarray, fitted: Fitted) -> np.ndarray:
    """``coefficients`` of the terms that ``fitted`` has: those of a lower degree come first."""
    found = np.zeros_like(fitted.coefficients)
    shared = min(len(found), len(coefficients))
    found[:shared] = coefficients[:shared]
    return found


def part_of(simulator: Simulator, swept: Swept) -> Polynomial:
    """What the sweeps found, as a part of an emulator: as many modes as its error calls for."""
    fields = jax.vmap(simulator.system.extend)(jnp.asarray(swept.polynomial.coefficients))
    return compressed(swept.polynomial.degrees, np.asarray(fields), _ROUNDED * swept.left)


def runs_of(simulator: Simulator, swept: Swept, thetas: jax.Array) -> Runs:
    """What the sweeps say at ``thetas`` (c, p), as FEM runs with their slopes would be."""
    scene, system = simulator.scene, simulator.system
    degrees, coefficients = swept.polynomial

    def at(theta: jax.Array) -> jax.Array:
        v = legendre(scene.to_unit(theta), degrees) @ coefficients
        return scene.on_supports(system.extend(v), theta)

    def each(theta: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        u, slopes = at(theta), jax.jacfwd(at)(theta)
        return u, system.potential(u, theta)[0], jnp.moveaxis(slopes, -1, 0)

    displacement, energy, slopes = compiled(lambda t: jax.lax.map(each, t))(thetas)
    return Runs(thetas, displacement, energy, slopes)


def _keep(folder: Path, state: Swept) -> None:
    numbers = {name: np.asarray(getattr(state, name)) for name in _NUMBERS}
    arrays = {**state.polynomial._asdict(), **state.values._asdict(), "before": state.before}
    save_arrays(folder / SWEEPS, {**numbers, **arrays})


def _restored(folder: Path | None) -> Swept | None:
    if folder is None or not (folder / SWEEPS).is_file():
        return None
    arrays, _ = read_arrays(folder / SWEEPS)
    return Swept(
        Fitted(*(arrays[name] for name in Fitted._fields)),
        arrays["before"],
        Values(*(arrays[name] for name in Values._fields)),
        **{name: arrays[name].item() for name in _NUMBERS},
    )
