r"""The inverse problem of a run: its scene, observations, data, and their statistical model.

:func:`read_problem` builds the scene and parses the data file, :func:`with_data` makes synthetic
data by FEM, and :func:`build_model` returns the model
:math:`y = \mathcal{O}\,u(\theta) + \varepsilon`, with the run's forward map :math:`u(\theta)`, its
observations :math:`\mathcal{O}` and its noise and errors :math:`\varepsilon`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from calibrate.measurements import Observations, parse_observation
from calibrate.measurements.data import read_measurements
from calibrate.measurements.usual_noise import size_in, usual_noise
from calibrate.priors import prior_of
from calibrate.project.run import Run
from calibrate.project.stated_priors import check_bounded, without_box, without_known
from calibrate.state_names import split
from calibrate.statistical_model import Model
from calibrate.statistical_model.errors import with_described_errors
from calibrate.statistical_model.load_states import boxed, known_thetas, load_states
from calibrate.statistical_model.model import model
from emulator.catalogue import find_problem
from emulator.core.errors import InputError
from emulator.core.kept import kept
from emulator.core.rooms import offered
from emulator.fem import NewtonOptions, Simulator
from emulator.fem.solution import EquilibriumSolver
from emulator.scenes.forward_problem import ForwardProblem
from emulator.scenes.scene import Scene
from emulator.surrogates import registry
from emulator.surrogates.fem import by_solver
from emulator.surrogates.protocol import ForwardMap, Ingredients


def simulator_of(
    scene: ForwardProblem, load_steps: int = 1, executor: Executor | str = "threads"
) -> EquilibriumSolver:
    """Return the solver of ``scene``, which the scene keeps: a scene's is FEM's simulator.

    Synthetic data, forward map, certificate and report share it and what it compiles. Of 581 hard
    cases that converge 576 take fewer iterations than its most; one that does not takes minutes.
    """
    return _simulator(scene, load_steps, executor)


@kept
def _simulator(
    scene: ForwardProblem, load_steps: int, executor: Executor | str
) -> EquilibriumSolver:
    if isinstance(scene, Scene):
        return Simulator(scene, NewtonOptions.load_steps(load_steps, most=100), executor)
    if load_steps != 1:
        raise InputError(f"'{scene.name}' has steps of its own; omit --load-steps {load_steps}")
    (made,) = offered(*scene.solved_by.split(":"))
    solver: EquilibriumSolver = made(scene, executor=executor)
    return solver


@dataclass(frozen=True, eq=False)
class Problem:
    """A run, and the objects that its words name. :func:`read_problem` makes it.

    run : the run, with every noise by the observation's name, and with the parameters that its
        data files know.
    data : the data by the observation's name, NaN where a value is missing; None for synthetic
        data that has not been made (:func:`with_data`).
    executor : what does many FEM solves in place of the run's engine.
    """

    run: Run
    scene: ForwardProblem
    observe: Observations
    data: Mapping[str, np.ndarray] | None
    executor: Executor | None = None

    @property
    def simulator(self) -> EquilibriumSolver:
        """FEM of the scene, in the run's load steps, or the solver of the specimen."""
        return simulator_of(self.scene, self.run.load_steps, self.executor or self.run.engine)

    def change(self, **entries: Any) -> Problem:
        """Return the problem with other entries of its run, of the same scene and data."""
        return replace(self, run=replace(self.run, **entries).named(self.observe, self.scene))

    @property
    def scaled_noise(self) -> list[str]:
        """Sentences on the default noises that are smaller than the usual because the body is."""
        noise, parts = self.run.noise, {split(n)[0]: p for n, p in self.observe.parts.items()}
        assert isinstance(noise, Mapping)
        return [
            f"{name} has the default noise of so small a body ({size_in(part, self.scene):.2g} "
            f"{part.unit}), sd {noise[name]:g} {part.unit}: give your data's, --noise {name}=SD"
            for name, part in parts.items()
            if noise.get(name) != part.usual_sd is not None
            and noise.get(name) == usual_noise(part, self.scene).upper_sd
        ]


def read_problem(
    run: Run | Problem, where: str = "", *, scene: ForwardProblem | None = None
) -> Problem:
    """Build the scene of a run, parse its data, and check that its names fit them.

    The forward map is not built and nothing is solved: a mistake is reported before long work.

    Parameters
    ----------
    run : the run; a problem is returned as it is.
    where : the file that the run is from; messages begin with it.
    scene : a scene to take in place of the run's own.

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
        table = None
        if scene is None:
            scene = find_problem(run.scene, run.root)
            table = scene.table
        words = run.prior
        run, scene = without_box(run, scene)
        if run.is_synthetic:
            names = {**run.known, **run.truth}
            states = tuple(dict.fromkeys(state for _, state in map(split, names) if state))
            observe, data = parse_observation(scene, run.observe, run.seed, states or ("",)), None
        else:
            observe, data, in_files = read_measurements(scene, run.data, table)
            for name, value in in_files.items():
                if run.known.get(name, value) != value:
                    raise InputError(
                        f"known: '{name}' is {value} in the data file and {run.known[name]} beside "
                        "it; say it once"
                    )
            run = replace(run, known={**in_files, **run.known})
        run = without_known(run, words)
        run = run.named(observe, scene)
        run.noises(observe)
        check_bounded(run, scene)
        prior = prior_of(run.prior, scene)
        boxed(load_states(scene, observe.states, prior, run.known)[0], prior, run.bounded)
        for name, description in run.systematic.items():
            words = dict.fromkeys(str(description["of"]).split("+"))
            observe.expand(words, f"systematic '{name}': of")
        return Problem(run, scene, observe, data)


@contextmanager
def naming(where: str) -> Iterator[None]:
    """Begin the message of every :class:`InputError` with the file it is about."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{where}: {error}" if where else str(error)) from error


def with_data(problem: Problem) -> Problem:
    """Return the problem with its data; FEM at the truth plus noise if the data is synthetic.

    :class:`InputError` for a truth that is incomplete, too long, or outside the scene's range.
    """
    if problem.data is not None:
        return problem
    run, observe = problem.run, problem.observe
    thetas = known_thetas(problem.scene, observe.states, {**run.known, **run.truth})
    noises = run.synthetic_noise(observe)
    fields = [problem.simulator(theta)[observe.nodes] for theta in thetas]
    exact = jax.jit(observe)(jnp.stack(fields), thetas)
    rng = np.random.default_rng([run.seed, 1])
    data = {
        name: np.asarray(exact[name]) + noises[name].simulate(rng, shape)
        for name, shape in observe.shapes.items()
    }
    with naming("synthetic, of too much noise (--noise)"):
        for name, values in data.items():
            observe.check(name, values)
    return replace(problem, data=data)


def ingredients(run: Run, scene: ForwardProblem, *, progress: bool = False) -> Ingredients:
    """Return the ingredients of the forward map of a run."""
    simulator = simulator_of(scene, run.load_steps)
    return Ingredients(scene, simulator, run.emulator, run.seed, progress=progress)


def build_forward(problem: Problem, *, progress: bool = False) -> ForwardMap:
    """Return the forward map of a problem, over all nodes."""
    run, made_of = problem.run, ingredients(problem.run, problem.scene, progress=progress)
    return registry.build_forward(run.forward, made_of, run.forward_options)


def model_of(run: Run, forward: ForwardMap, observe: Observations) -> Model:
    """Return the statistical model of a run, without the errors that depend on its data."""
    noises, prior = run.noises(observe), prior_of(run.prior, forward.scene)
    return model(
        forward,
        observe,
        noises,
        prior,
        known=run.known,
        bounded=run.bounded,
        check_scale=run.check_scale,
    )


def model_before_data(run: Run | Problem, *, progress: bool = False) -> Model:
    """Return the statistical model of a run that needs no data yet."""
    problem = read_problem(run)
    run = problem.run
    run_model = model_of(run, build_forward(problem, progress=progress), problem.observe)
    if not run.systematic:
        return run_model
    # Some of these errors depend on the deformed body, which is taken at a draw of the prior.
    draws = run_model.prior_draws(jax.random.key(run.seed), 1)
    predicted, _ = run_model.predict({name: values[0] for name, values in draws.items()})
    means = {name: np.asarray(mean) for name, mean in predicted.items()}
    return with_described_errors(run_model, means, run.systematic)[0]


def build_model(
    problem: Problem, forward: ForwardMap | None = None, *, progress: bool = False
) -> tuple[Model, Mapping[str, Any]]:
    """Return the statistical model of a problem with data, and the data that it is sampled with.

    forward : a forward map over all nodes; by default the one that the run names.
    """
    run = problem.run
    assert problem.data is not None, "with_data comes first"
    data: Mapping[str, Any] = problem.data
    forward = build_forward(problem, progress=progress) if forward is None else forward
    run_model = model_of(run, forward, problem.observe)
    if run.systematic:
        run_model, data = with_described_errors(run_model, data, run.systematic)
    return run_model, data


def by_fem(model: Model, load_steps: int = 1, executor: Executor | str = "threads") -> Model:
    """Return ``model`` with FEM as its forward map, to make data for checks of the model."""
    whole = by_solver(simulator_of(model.forward.scene, load_steps, executor), model.full)
    forward = whole.at(model.observe.nodes)
    return replace(model, full=whole, forward=forward)
