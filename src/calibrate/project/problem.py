r"""The inverse problem of a run: its scene, what is observed, its data, and the model of them.

.. code-block:: python

    problem = read_problem(run)        # the scene is built and the data file parsed, once
    problem = with_data(problem)       # synthetic data is made by FEM, if the run asks for it
    model, data = build_model(problem)

The model is :math:`y = \mathcal{O}\,u(\theta) + \varepsilon`, with the run's forward map
:math:`u(\theta)`, its observations :math:`\mathcal{O}` and its noise and errors
:math:`\varepsilon`.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from calibrate.measurements import Observations, parse_observation
from calibrate.measurements.data import read_measurements
from calibrate.priors import prior_of
from calibrate.project.run import Run
from calibrate.state_names import split
from calibrate.statistical_model import Model, with_error
from calibrate.statistical_model.errors import with_described_errors
from calibrate.statistical_model.load_states import known_thetas, load_states
from calibrate.statistical_model.model import model
from emulator.catalogue import find_scene
from emulator.core.errors import InputError
from emulator.fem import NewtonOptions, Simulator
from emulator.scenes.scene import Scene
from emulator.surrogates import registry
from emulator.surrogates.fem import fem_forward
from emulator.surrogates.protocol import ForwardMap, Ingredients


class Simulators:
    """FEM simulators of this process, each compiled once, found by the scene's fingerprint.

    A simulator compiles its programs when it first solves, which takes longer than the solve.
    Synthetic data, the forward map, the certificate and the report of a run therefore share one
    simulator, even where each of them has built the scene anew.

    Parameters
    ----------
    size : the number of simulators that are kept; the one used longest ago goes first. Each holds
        a scene's mesh and the compiled programs.
    """

    def __init__(self, size: int) -> None:
        self._size = size
        self._simulators: OrderedDict[tuple[str, int], Simulator] = OrderedDict()

    def of(self, scene: Scene, load_steps: int) -> Simulator:
        """Return the simulator of ``scene`` whose solves take ``load_steps`` load steps."""
        key = (scene.fingerprint, load_steps)
        simulator = self._simulators.pop(key, None)
        if simulator is None:
            simulator = Simulator(scene, NewtonOptions.load_steps(load_steps))
        self._simulators[key] = simulator
        while len(self._simulators) > self._size:
            self._simulators.popitem(last=False)
        return simulator


_SIMULATORS = Simulators(size=2)


def simulator_of(scene: Scene, load_steps: int = 1) -> Simulator:
    """Return the simulator of a scene, compiled once a process (:class:`Simulators`)."""
    return _SIMULATORS.of(scene, load_steps)


@dataclass(frozen=True, eq=False)
class Problem:
    """A run, and what its words name. :func:`read_problem` makes it.

    run : the run, with every noise by the observation's name, and with the parameters that its
        data files know.
    scene : the scene.
    observe : the observations.
    data : the data by the observation's name, NaN where a value is missing; None for synthetic
        data that has not been made (:func:`with_data`).
    """

    run: Run
    scene: Scene
    observe: Observations
    data: Mapping[str, np.ndarray] | None

    @property
    def simulator(self) -> Simulator:
        """FEM of the scene, in the run's load steps."""
        return simulator_of(self.scene, self.run.load_steps)

    def change(self, **entries: Any) -> Problem:
        """Return the problem with other entries of its run, of the same scene and data."""
        return replace(self, run=replace(self.run, **entries).named(self.observe))


def read_problem(run: Run | Problem, where: str = "") -> Problem:
    """Build the scene of a run, parse its data, and check that its names fit them.

    The forward map is not built and nothing is solved: a mistake is reported before long work.

    Parameters
    ----------
    run : the run; a problem is returned as it is.
    where : the file that the run is from; messages begin with it.

    Raises
    ------
    InputError
        The scene or the data file is missing or malformed; the run names an observation, a
        parameter, a load state or an option of the sampler that does not exist; the run and its
        data files know different values of a parameter.
    """
    if isinstance(run, Problem):
        return run
    with naming(where):
        run.sampling()
        scene = find_scene(run.scene, run.root)
        if run.is_synthetic:
            observe, data = _synthetic_observations(run, scene), None
        else:
            observe, data, known = read_measurements(scene, run.data)
            run = replace(run, known=_agreed(run.known, known))
        run.noises(observe)
        load_states(scene, observe.states, prior_of(run.prior, scene), run.known)
        for name, description in run.systematic.items():
            words = dict.fromkeys(str(description["of"]).split("+"))
            observe.expand(words, f"systematic '{name}': of")
        return Problem(run.named(observe), scene, observe, data)


@contextmanager
def naming(where: str) -> Iterator[None]:
    """Begin the message of every :class:`InputError` with the file it is about."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{where}: {error}" if where else str(error)) from error


def _agreed(known: Mapping[str, float], in_files: Mapping[str, float]) -> dict[str, float]:
    """Return the known parameters of a run and of its data files."""
    for name, value in in_files.items():
        if known.get(name, value) != value:
            raise InputError(
                f"known: '{name}' is {value} in the data file and {known[name]} beside it; "
                "say it once"
            )
    return {**in_files, **known}


def _synthetic_observations(run: Run, scene: Scene) -> Observations:
    """Return the observations of synthetic data in every load state of truth and known."""
    states = dict.fromkeys(state for _, state in map(split, {**run.known, **run.truth}) if state)
    return parse_observation(scene, run.observe, run.seed, tuple(states) or ("",))


def with_data(problem: Problem) -> Problem:
    """Return the problem with its data; FEM at the truth plus noise if the data is synthetic.

    Raises
    ------
    InputError
        The truth names no such parameter, lacks one, or is outside the scene's range.
    """
    if problem.data is not None:
        return problem
    run, observe = problem.run, problem.observe
    thetas = known_thetas(problem.scene, observe.states, {**run.known, **run.truth})
    noises = run.synthetic_noise(observe)
    simulator = simulator_of(problem.scene, run.load_steps)
    fields = [simulator(theta)[observe.nodes] for theta in thetas]
    exact = jax.jit(observe)(jnp.stack(fields), thetas)
    rng = np.random.default_rng([run.seed, 1])
    data = {
        name: np.asarray(exact[name]) + noises[name].simulate(rng, part.shape)
        for name, part in observe.parts.items()
    }
    return replace(problem, data=data)


def make_data(run: Run, scene: Scene) -> tuple[Observations, dict[str, np.ndarray]]:
    """Return the observations and the data of a run, in ``scene`` instead of the run's own."""
    if not run.is_synthetic:
        observe, data, _ = read_measurements(scene, run.data)
        return observe, data
    problem = with_data(Problem(run, scene, _synthetic_observations(run, scene), None))
    assert problem.data is not None
    return problem.observe, dict(problem.data)


def build_forward(problem: Problem, *, progress: bool = False) -> ForwardMap:
    """Return the forward map of a problem, over all nodes."""
    ingredients = _ingredients(problem.run, problem.scene, progress=progress)
    return registry.build_forward(problem.run.forward, ingredients, problem.run.forward_options)


def restore_forward(run: Run, scene: Scene, path: Path) -> ForwardMap:
    """Return the forward map that was written to ``path`` with the results of ``run``."""
    return registry.restore_forward(
        run.forward, _ingredients(run, scene), run.forward_options, path
    )


def _ingredients(run: Run, scene: Scene, *, progress: bool = False) -> Ingredients:
    simulator = simulator_of(scene, run.load_steps)
    return Ingredients(scene, simulator, run.emulator, run.seed, progress=progress)


def model_of(
    run: Run, forward: ForwardMap, observe: Observations, *, check_scale: bool = True
) -> Model:
    """Return the statistical model of a run, without the errors that depend on its data."""
    noises, prior = run.noises(observe), prior_of(run.prior, forward.scene)
    return model(forward, observe, noises, prior, known=run.known, check_scale=check_scale)


def model_before_data(run: Run | Problem, *, progress: bool = False) -> Model:
    """Return the statistical model of a run that needs no data yet."""
    problem = read_problem(run)
    run = problem.run
    forward = build_forward(problem, progress=progress)
    run_model = model_of(run, forward, problem.observe, check_scale=run.check_scale)
    if not run.systematic:
        return run_model
    # Some of these errors depend on the deformed body, which is taken at a draw of the prior.
    draw = {
        name: each[0] for name, each in run_model.prior_draws(jax.random.key(run.seed), 1).items()
    }
    means = {name: np.asarray(mean) for name, mean in run_model.predict(draw)[0].items()}
    return with_described_errors(run_model, means, run.systematic)[0]


def build_model(problem: Problem, *, progress: bool = False) -> tuple[Model, Mapping[str, Any]]:
    """Return the statistical model of a problem with data, and the data that it is sampled with."""
    run = problem.run
    assert problem.data is not None, "with_data comes first"
    data: Mapping[str, Any] = problem.data
    forward = build_forward(problem, progress=progress)
    run_model = model_of(run, forward, problem.observe, check_scale=run.check_scale)
    if run.systematic:
        run_model, data = with_described_errors(run_model, data, run.systematic)
    if runs := run.error_runs or run.mesh_error_runs:
        run_model, data = run_model.given(data)
        run_model = with_error(
            replace(run_model, check_scale=False),  # the data has been checked
            problem.simulator,
            runs,
            of_mesh=bool(run.mesh_error_runs),
            seed=run.seed,
            progress=progress,
        )
    return run_model, data


def by_fem(model: Model, load_steps: int = 1) -> Model:
    """Return ``model`` with FEM as its forward map, to make data for checks of the model."""
    whole = fem_forward(simulator_of(model.forward.scene, load_steps), model.full)
    error = model.error if model.error is not None and model.error.of_fem else None
    return replace(model, full=whole, forward=whole.at(model.observe.nodes), error=error)
