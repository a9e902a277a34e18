import jax
import jax.numpy as jnp
import numpy as np
import pytest

from emulator.error.comparison import evaluate
from emulator.errors import InputError
from emulator.fem import run_campaign, sobol
from emulator.surrogates.pod_gp import fit_reduced


@pytest.fixture(scope="module")
def runs(beam, simulator):
    return run_campaign(simulator, sobol(beam, 20, seed=0))


def test_it_interpolates_its_runs(beam, runs):
    reduced = fit_reduced(beam, runs)
    for theta, u in zip(runs.theta, runs.displacement, strict=True):
        np.testing.assert_allclose(reduced(theta), u, atol=1e-4)


def test_error_falls_with_more_runs(beam, simulator, runs):
    tests = run_campaign(simulator, sobol(beam, 8, seed=9))
    errors = []
    for count in (5, 10, 20):
        reduced = fit_reduced(beam, runs.take(slice(count)))
        errors.append(evaluate(reduced, tests.theta, tests.displacement)["err_u"]["median"])
    assert errors[2] < 0.1 * errors[1] < 0.05 * errors[0]


def test_gradient_and_nodes(beam, runs):
    reduced = fit_reduced(beam, runs)
    f = lambda t: jnp.sum(reduced(t) ** 2)
    h = 0.05
    central = [
        (f(beam.centre.at[k].add(h)) - f(beam.centre.at[k].add(-h))) / (2 * h) for k in range(2)
    ]
    np.testing.assert_allclose(jax.grad(f)(beam.centre), central, rtol=1e-4)
    nodes = np.array([9, 4])
    np.testing.assert_allclose(reduced.at(nodes)(beam.centre), reduced(beam.centre)[nodes])
    with pytest.raises(InputError, match="node 5 is not among the 2 this reduced map returns"):
        reduced.at(nodes).at(np.array([5]))
    assert not reduced.evaluate(2.0 * beam.centre).valid


def test_too_few_runs(beam, runs):
    with pytest.raises(InputError, match="needs 3 FEM runs or more; there are 2"):
        fit_reduced(beam, runs.take(slice(2)))
