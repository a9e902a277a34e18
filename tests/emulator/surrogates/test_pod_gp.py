from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.accuracy.comparison import evaluate
from emulator.core.errors import InputError
from emulator.core.store import save_arrays
from emulator.fem import run_campaign, sobol
from emulator.surrogates.pod_gp import REDUCED, fit_reduced
from emulator.surrogates.protocol import Ingredients
from emulator.surrogates.registry import keep_forward, restore_forward


@pytest.fixture(scope="module")
def runs(beam, simulator):
    return run_campaign(simulator, sobol(beam, 20, seed=0))


def test_it_interpolates_its_runs(beam, runs):
    reduced = fit_reduced(beam, runs)
    for theta, u in zip(runs.theta, runs.displacement, strict=True):
        np.testing.assert_allclose(reduced(theta), u, atol=1e-4)


@pytest.mark.slow
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


def test_its_arrays_are_the_whole_map(beam, runs, tmp_path):
    reduced = fit_reduced(beam, runs)
    path = tmp_path / "map.safetensors"
    keep_forward(reduced, path)
    back = restore_forward("reduced", Ingredients(beam, None), {}, path)
    assert back.fingerprint == reduced.fingerprint
    np.testing.assert_array_equal(back(beam.centre), reduced(beam.centre))
    assert reduced.label == "POD + GP of 20 FEM runs"
    # Every array counts, and so does the scene.
    arrays = dict(REDUCED.to_arrays(reduced))
    found = {reduced.fingerprint}
    for name, array in arrays.items():
        found.add(REDUCED.from_arrays(beam, {**arrays, name: array + 1}).fingerprint)
    found.add(
        replace(reduced, scene=em.scenes.once_clamped_beam(cells=(4, 2, 3), order=1)).fingerprint
    )
    assert len(found) == 8


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda path: path.unlink(), "the reduced map of the posterior beside it, is missing"),
        (lambda path: path.write_bytes(path.read_bytes()[:-40]), "truncated"),
        (lambda path: save_arrays(path, {"mean": 1.0}), "holds no reduced map"),
        (lambda path: save_arrays(path, {"mean": 1.0}, {"kind": "reduced"}), "'nodes' is missing"),
    ],
)
def test_a_damaged_file_is_named(beam, runs, tmp_path, spoil, message):
    path = tmp_path / "map.safetensors"
    keep_forward(fit_reduced(beam, runs.take(slice(3))), path)
    spoil(path)
    with pytest.raises(InputError, match=message) as raised:
        restore_forward("reduced", Ingredients(beam, None), {}, path)
    assert str(path) in str(raised.value)


def test_too_few_runs(beam, runs):
    with pytest.raises(InputError, match="needs 3 FEM runs or more; there are 2"):
        fit_reduced(beam, runs.take(slice(2)))
