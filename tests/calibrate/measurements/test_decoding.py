"""Linear observations decoded at once: the same data and slopes as by way of the nodes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import calibrate as cal
import emulator as em
from calibrate.measurements.collection import observations
from emulator.surrogates import Emulator
from emulator.surrogates.taylor import expand
from linear_support import linear_forward
from scene_support import between_plates

STATES = ("a", "b", "c")
KNOWN = {f"shear@{s}": 0.1 * k + 0.1 for k, s in enumerate(STATES)} | {
    f"stretch@{s}": 0.05 for s in STATES
}


@pytest.fixture(scope="module")
def forward():
    scene = between_plates()
    return Emulator(scene, taylor=expand(em.Simulator(scene), order=2)).cache()


def observed(scene):
    """Nodes, some of them on the plate that moves, points, a surface, and a force."""
    rng = np.random.default_rng(0)
    inside = rng.uniform(0.5, 3.5, (5, 3))
    outside = np.column_stack([np.full(4, 4.0), rng.uniform(0.5, 3.5, (4, 2))])
    top = scene.mesh.node_set("top")[:3]
    kinds = {
        "displacement": cal.landmarks(scene, inside),
        "surface:right": cal.surface_points(scene, "right", outside),
        "reaction:bottom:x": cal.Reaction(scene, "bottom", "x"),
    }
    parts = {f"{name}@{s}": part for name, part in kinds.items() for s in STATES}
    nodes = cal.nodal_displacements(scene, np.unique([*top.tolist(), 20, 21, 30, 31])[:5])
    return observations({**parts, "displacement@b": nodes})


@pytest.fixture(scope="module")
def model(forward):
    observe = observed(forward.scene)
    noise = {name: cal.GaussianNoise(sd=0.1) for name in observe.bases}
    whole = cal.model(forward, observe, noise, known=KNOWN, check_scale=False)
    rng = np.random.default_rng(1)
    data = {n: rng.normal(size=shape) for n, shape in whole.observe.shapes.items()}
    data["displacement@a"][:, 2] = np.nan  # a camera sees the plane
    data["displacement@c"][1] = np.nan
    data["displacement@c"][:, 2] = np.nan
    data["surface:right@b"][2] = np.nan
    return whole.given(data)[0]


def test_data_and_slopes_are_those_by_way_of_the_nodes(model):
    thetas = model.states.thetas({"mu": jnp.asarray(3.0)})
    by_nodes = lambda t: model.means(t, model.evaluate(t))[0]
    at_once = lambda t: model.means(t)[0]
    both = lambda f: jax.jit(lambda t: (f(t), jax.jacfwd(f)(t)))(thetas)
    for found, expected in zip(both(at_once), both(by_nodes), strict=True):
        assert found.keys() == expected.keys()
        for name in expected:
            np.testing.assert_allclose(found[name], expected[name], atol=1e-12, err_msg=name)
    assert model.observe.shapes["displacement@a"] == (10,)
    assert model.observe.shapes["displacement@c"] == (8,)


def test_only_what_is_seen_is_decoded(model):
    matrix, rows, others = model.observe.decoding
    assert set(others.parts) == {f"reaction:bottom:x@{s}" for s in STATES}
    linear = 10 + 15 + 4  # in-plane points, nodes, and the surface, each once for all states
    assert matrix.shape[0] == linear + 3 * len(others.nodes)
    assert len(rows) == 6


def test_outside_of_the_box_it_is_not_valid(model):
    thetas = model.states.thetas({"mu": jnp.asarray(30.0)})
    means, valid = jax.jit(model.means)(thetas)
    assert not valid
    assert all(bool((values == 0.0).all()) for n, values in means.items() if "reaction" not in n)


def test_maps_that_are_no_sum_of_modes_predict_as_before(forward):
    scene = forward.scene
    observe = observed(scene)
    noise = {name: cal.GaussianNoise(sd=0.1) for name in observe.bases}
    model = cal.model(linear_forward(scene), observe, noise, known=KNOWN, check_scale=False)
    thetas = model.states.thetas({"mu": jnp.asarray(3.0)})
    found, expected = model.means(thetas)[0], model.means(thetas, model.evaluate(thetas))[0]
    for name in expected:
        np.testing.assert_array_equal(found[name], expected[name])
