"""Modes by variable projection, then their coefficients."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

import emulator as em
from emulator.core.checkpoint import Checkpoint
from emulator.core.errors import InputError
from emulator.fem.campaign import Runs, run_campaign
from emulator.fem.campaign.designs import design, sobol
from emulator.surrogates.network.pignn import Architecture
from emulator.training import train
from emulator.training.job import Job
from emulator.training.mode_fit import ModeFit, mean_square_gradient, scales_of
from emulator.training.optimiser import orthogonal_steps
from emulator.training.physics import PhysicsPlan, prepare

SMALL = Architecture(
    steps=2, latent=8, hidden=(16, 16), decoder="separable", modes=6, trunk=(16, 40)
)
PLAN = PhysicsPlan(sweeps=0, simulations=12, steps=30, polish=100)


@pytest.fixture(scope="module")
def problem(beam):
    return prepare(PLAN, Job(beam, SMALL))


@pytest.fixture(scope="module")
def mode_fit(problem) -> ModeFit:
    return mode_fit_of(problem)


def mode_fit_of(problem):
    scene, runs = problem.emulator.scene, problem.runs
    return ModeFit(scene, problem.training.network, runs, scales_of(scene, runs))


def field(mode_fit, seed):
    """Displacements (n, 3) in units of the scale, zero where held."""
    values = np.random.default_rng(seed).normal(size=mode_fit.scene.held.shape)
    return jnp.asarray(np.where(mode_fit.scene.held, 0.0, values))


def test_the_product_is_that_of_displacements_and_their_gradients(mode_fit):
    """Its square of a field is that of displacement and gradient, each over its scale."""
    v, scales = field(mode_fit, 0), mode_fit.scales
    mm = scales.displacement * v
    expected = jnp.mean(jnp.sum(v**2, axis=-1))
    expected += mean_square_gradient(mode_fit.scene, mm[None]) / scales.gradient**2
    assert jnp.vdot(v, mode_fit.weighted(v)) == pytest.approx(float(expected), rel=1e-12)


def test_targets_hold_what_the_snapshots_vary_by(mode_fit, problem):
    """A run's displacement, projected on the targets, is it again, up to the modes left out."""
    modes = mode_fit.targets
    flat = modes.reshape(-1, modes.shape[-1])
    weighted = mode_fit.weighted(modes).reshape(flat.shape)
    products = np.asarray(flat.T @ weighted)
    sizes = np.diag(products)
    np.testing.assert_allclose(products, np.diag(sizes), atol=1e-10 * sizes[0])
    assert (np.diff(sizes) <= 0.0).all()
    runs = problem.runs
    deviation = np.asarray(runs.displacement - runs.displacement[0]) / mode_fit.scales.displacement
    for d in deviation.reshape(len(deviation), -1):
        left = d - flat @ ((d @ weighted) / sizes)
        assert np.linalg.norm(left) <= 1e-3 * np.linalg.norm(d) + 1e-12


def test_the_last_layer_is_the_least_squares_solution(mode_fit, problem):
    """Against NumPy's, component by component, in the factor of the product."""
    H = mode_fit._hidden(problem.training.initial(30)[0])
    W, misfit, _ = mode_fit._project(H)
    n, targets = len(H), np.asarray(mode_fit.targets)
    K = np.asarray(jax.vmap(mode_fit.weighted, 1, 1)(jnp.eye(n)))
    root = np.linalg.cholesky(K).T
    left = size = 0.0
    for k in range(3):
        free = ~mode_fit.scene.held[:, k : k + 1]
        # The ridge of the solution, as rows of the least-squares problem.
        A, b = root @ (free * np.asarray(H)), root @ targets[:, k]
        ridge = np.sqrt(1e-9 * np.mean(np.sum(A**2, axis=0))) * np.eye(A.shape[1])
        w = np.linalg.lstsq(
            np.concatenate([A, ridge]), np.concatenate([b, 0.0 * ridge[:, : b.shape[1]]])
        )[0]
        left, size = left + np.sum((A @ w - b) ** 2), size + np.sum(b**2)
        np.testing.assert_allclose(A @ np.asarray(W[:, k]), A @ w, atol=1e-6 * np.sqrt(size))
    assert float(misfit) == pytest.approx(left / size, rel=1e-6)


def test_the_derivative_in_the_hidden_layer_needs_none_of_the_solution(mode_fit, problem):
    """Of few features, so that the misfit is far above what the ridge costs."""
    H = mode_fit._hidden(problem.training.initial(30)[0])[:, :8]
    _, _, pull = mode_fit._project(H)
    along = jnp.asarray(np.random.default_rng(1).normal(size=H.shape))
    h = 1e-6
    ends = [float(mode_fit._project(H + sign * h * along)[1]) for sign in (1.0, -1.0)]
    assert jnp.vdot(pull, along) == pytest.approx((ends[0] - ends[1]) / (2.0 * h), rel=2e-3)


def test_orthogonal_steps_are_as_long_in_every_direction():
    """Of a kernel, whatever its gradient's singular values; of a bias each number, as by Adam."""
    rng = np.random.default_rng(0)
    gradient = {"kernel": jnp.asarray(rng.normal(size=(6, 3)) @ np.diag([1.0, 0.1, 0.01])),
                "bias": jnp.asarray([2.0, -0.5, 1e-3]),
                "branch": {"kernel": jnp.asarray([[2.0, -0.5], [1e-3, 4.0]])}}  # fmt: skip
    optimiser = orthogonal_steps()
    weights = jax.tree.map(jnp.zeros_like, gradient)
    updates, _ = optimiser.update(gradient, optimiser.init(weights), weights)
    kernel = np.asarray(updates["kernel"])
    lengths = np.linalg.svd(kernel)[1]
    # Newton and Schulz's iteration, five steps of it, leaves singular values within a third of one.
    length = 1.6 * np.sqrt(6.0)
    assert np.all((0.6 * length < lengths) & (lengths < 1.4 * length))
    assert jnp.vdot(kernel, gradient["kernel"]) > 0.0  # which is subtracted
    bias = updates["bias"] * jnp.sign(gradient["bias"])
    assert jnp.all(bias > 0.0)
    np.testing.assert_allclose(bias, bias[0], rtol=1e-3)
    step, g = (part["branch"]["kernel"] for part in (updates, gradient))
    np.testing.assert_allclose(step, jnp.sign(g), rtol=1e-3)  # the first of Adam's


def test_the_branch_s_last_layer_is_the_least_squares_solution(mode_fit, problem):
    """Against NumPy's; values and slopes are those of the network as it answers."""
    network, scene = mode_fit.network, mode_fit.scene
    weights = jax.jit(mode_fit._with_solved_layer)(problem.training.initial(30)[0])
    targets = mode_fit.branch_targets(weights)
    B, misfit = mode_fit._fit_branch(weights, targets)
    x = scene.to_unit(problem.runs.theta)
    square = lambda e: float(jnp.sum((e @ targets.products) * e))

    def misfit_of(weights):
        """Of the network as it answers, and what it is divided by."""
        branch = nnx.merge(network.definition, weights).decoder.branch
        answer = lambda x: branch(network.normalise(x)).astype(float)
        left = jax.vmap(answer)(x) - targets.values
        along = jnp.swapaxes(jax.vmap(jax.jacfwd(answer))(x), 1, 2) - targets.slopes
        size = square(targets.values) + mode_fit.slopes * square(targets.slopes)
        return square(left) + mode_fit.slopes * square(along), size

    own, size = misfit_of(mode_fit._with_last_layer(weights, B, branch=True))
    assert float(misfit) == pytest.approx(own / size, rel=1e-3)
    branch = nnx.merge(network.definition, weights).decoder.branch
    h = lambda x: jnp.append(branch.hidden(network.normalise(x)), 1.0).astype(float)
    along = jnp.swapaxes(jax.vmap(jax.jacfwd(h))(x), 1, 2).reshape(-1, len(B))
    root = np.sqrt(mode_fit.slopes)
    rows = np.concatenate([jax.vmap(h)(x), root * along])
    wanted = np.concatenate([targets.values, root * targets.slopes.reshape(-1, B.shape[1])])
    # The ridge of the solution, as rows of the least-squares problem.
    ridge = np.sqrt(1e-9 * np.mean(np.sum(rows**2, axis=0))) * np.eye(len(B))
    padded = np.concatenate([wanted, np.zeros((len(B), B.shape[1]))])
    least = np.linalg.lstsq(np.concatenate([rows, ridge]), padded)[0]
    np.testing.assert_allclose(rows @ np.asarray(B), rows @ least, atol=1e-5 * np.abs(wanted).max())


def test_the_branch_s_derivative_goes_through_its_last_layer(mode_fit, problem):
    """Against differences of the misfit, solved for at either end."""
    weights = jax.jit(mode_fit._with_solved_layer)(problem.training.initial(30)[0])
    targets = mode_fit.branch_targets(weights)
    single, rest = nnx.split_state(weights, lambda path, _: "branch" in path, ...)
    leaves, structure = jax.tree.flatten(jax.tree.map(lambda w: w.astype(float), single))
    rng = np.random.default_rng(2)
    # Biases of zero are at a kink of the activation, where the centre of the box is.
    leaves = [w + 0.1 * rng.normal(size=w.shape) for w in leaves]
    along = [jnp.asarray(rng.normal(size=leaf.shape)) for leaf in leaves]

    def misfit(leaves):
        branch = jax.tree.unflatten(structure, leaves)
        return mode_fit._fit_branch(nnx.merge_state(rest, branch), targets)[1]

    slope = sum(jnp.vdot(g, d) for g, d in zip(jax.grad(misfit)(leaves), along, strict=True))
    h = 1e-6
    ends = [
        float(misfit([w + sign * h * d for w, d in zip(leaves, along, strict=True)]))
        for sign in (1.0, -1.0)
    ]
    assert float(slope) == pytest.approx((ends[0] - ends[1]) / (2.0 * h), rel=1e-4)


def test_a_budget_that_is_over_ends_the_branch_s_fit(mode_fit, problem):
    weights = problem.training.initial(30)[0]
    ended = mode_fit.finish(10**6, 0.0, weights, False)
    assert all(jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(ended))


@pytest.mark.slow
def test_coefficients_are_of_values_and_slopes(mode_fit, problem):
    """A branch that gives the coefficients gives displacements and their slopes in theta."""
    scene, runs = mode_fit.scene, problem.runs
    weights = jax.jit(mode_fit._with_solved_layer)(problem.training.initial(30)[0])
    branch = mode_fit.branch_targets(weights)
    s = mode_fit.scales.displacement
    modes = np.asarray(mode_fit.network.prepare(weights)[1], float)
    found = s * np.tensordot(np.asarray(branch.values), modes, axes=1)
    expected = np.asarray(runs.displacement - runs.displacement[0])
    free = ~scene.held
    size = np.sqrt(np.mean(expected[:, free] ** 2))
    assert np.sqrt(np.mean((found - expected)[:, free] ** 2)) < 0.05 * size
    # Slopes along the unit box, against the difference of two runs a little apart.
    theta, h = runs.theta[3], 1e-4
    x = scene.to_unit(theta)
    simulator = em.Simulator(scene)
    for k in range(len(x)):
        ends = [simulator(scene.from_unit(x.at[k].add(sign * h))) for sign in (1.0, -1.0)]
        slope = np.asarray(ends[0] - ends[1]) / (2.0 * h)
        found = s * np.tensordot(np.asarray(branch.slopes[3, k]), modes, axes=1)
        assert np.sqrt(np.mean((found - slope)[free] ** 2)) < 0.1 * np.sqrt(np.mean(slope**2))


@pytest.mark.slow
def test_a_network_alone_learns_a_beam(beam, tmp_path):
    plan = replace(PLAN, simulations=30, steps=150, polish=200)
    emulator = train(beam, plan, tmp_path, architecture=replace(SMALL, hidden=(32, 32)))
    assert list(emulator.parts) == ["taylor", "network"]
    assert emulator.taylor.indices.size == 0  # the centre's solution, no series
    tests = run_campaign(em.Simulator(beam), sobol(beam, 10, 7))
    found = jax.jit(jax.vmap(emulator.cache()))(tests.theta)
    err_u = np.median(np.linalg.norm(found - tests.displacement, axis=-1))
    centre = emulator.taylor.displacement
    untrained = np.median(np.linalg.norm(tests.displacement - centre, axis=-1))
    assert err_u < 1e-2 * untrained


@pytest.mark.slow
def test_a_killed_training_goes_on_to_the_same_weights(beam, tmp_path, monkeypatch):
    whole = train(beam, PLAN, tmp_path / "whole", architecture=SMALL)
    _killed_after(beam, tmp_path / "killed", 10, monkeypatch)
    again = train(beam, PLAN, tmp_path / "killed", resume=True)
    for a, b in zip(*(jax.tree.leaves(e.network.weights) for e in (whole, again)), strict=True):
        np.testing.assert_array_equal(a, b)


def _killed_after(scene, folder, stop, monkeypatch):
    from emulator.training import optimiser as module

    advance = module.NetworkTraining.advance

    def killed(self, state):
        if state.done == stop:
            raise KeyboardInterrupt
        return advance(self, state)

    with monkeypatch.context() as patch:
        patch.setattr(module.NetworkTraining, "advance", killed)
        patch.setattr(Checkpoint, "keep", Checkpoint.write)
        with pytest.raises(KeyboardInterrupt):
            train(scene, PLAN, folder, architecture=SMALL)


@pytest.mark.slow
def test_more_modes_than_snapshots_leave_zeros(beam):
    plan = replace(PLAN, simulations=4)
    runs = run_campaign(em.Simulator(beam), design(beam, 2, 0), sensitivities=True)
    problem = prepare(plan, Job(beam, replace(SMALL, modes=30)))
    few = ModeFit(beam, problem.emulator.network, Runs(*runs), mode_fit_of(problem).scales)
    assert (np.asarray(few.targets)[..., 20:] == 0.0).all()
    assert np.isfinite(few.branch_targets(problem.training.initial(30)[0]).values).all()


def test_a_plan_without_runs_is_refused():
    with pytest.raises(InputError, match="0 simulations; modes need 1 or more"):
        replace(PLAN, simulations=0)


def deformation_gradients(mesh, u):
    """F (m, 3, 3) of linear tetrahedra from their edges before and after, and volumes (m,) mm3."""
    before, after = (
        np.swapaxes(x[mesh.elements[:, 1:]] - x[mesh.elements[:, :1]], 1, 2)
        for x in (mesh.nodes, mesh.nodes + u)
    )
    return after @ np.linalg.inv(before), np.abs(np.linalg.det(before)) / 6.0


def test_gradients_by_an_independent_evaluation():
    """On elements of unequal volume."""
    bent = em.scenes.once_clamped_beam(cells=(4, 2, 2), order=1)
    nodes = bent.mesh.nodes.copy()
    nodes[:, 0] = 100.0 * (nodes[:, 0] / 100.0) ** 2
    graded = replace(bent, mesh=replace(bent.mesh, nodes=nodes), origin={})
    u, v = np.random.default_rng(3).normal(size=(2, 5, len(nodes), 3))
    squares = []
    for one, other in zip(u, v, strict=True):
        F, volume = deformation_gradients(graded.mesh, one)
        error = F - deformation_gradients(graded.mesh, other)[0]
        squares.append(np.average(np.sum(error**2, axis=(1, 2)), weights=volume))
    assert np.ptp(volume) > volume.min()
    found = mean_square_gradient(graded, jnp.asarray(u - v))
    assert float(found) == pytest.approx(np.mean(squares), rel=1e-12)


def test_both_scales_are_one_at_the_centre(problem):
    """Over the runs they were taken from."""
    scene, runs = problem.emulator.scene, problem.runs
    scales, deviation = scales_of(scene, runs), runs.displacement[1:] - runs.displacement[0]
    squares = np.sum(np.asarray(deviation) ** 2, axis=-1)
    assert np.mean(squares) == pytest.approx(scales.displacement**2)
    of_gradients = float(mean_square_gradient(scene, deviation))
    assert of_gradients == pytest.approx(scales.gradient**2)
