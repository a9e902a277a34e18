import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import calibrate as cal
from calibrate.measurements import (
    OBSERVATIONS,
    observations,
    observations_from_json,
    spread_landmarks,
    spread_nodes,
)
from calibrate.noise import NOISES, usage_of
from emulator.core.errors import InputError

NO_THETA = jnp.zeros(0)


def test_nodes(beam):
    u = np.random.default_rng(0).normal(size=beam.mesh.nodes.shape)
    for what, index in (
        ("all", np.arange(45)),
        ("right", beam.mesh.node_set("right")),
        ([4, 2], [4, 2]),
    ):
        observe = cal.nodal_displacements(beam, what)
        np.testing.assert_array_equal(observe(jnp.asarray(u[observe.nodes]), NO_THETA), u[index])
        np.testing.assert_array_equal(observe.points, beam.mesh.nodes[index])


def test_landmarks_are_exact_for_linear_fields(beam):
    H = np.random.default_rng(0).normal(size=(3, 3))
    points = spread_landmarks(beam, 30, seed=1)
    observe = cal.landmarks(beam, points)
    u = beam.mesh.nodes @ H.T + [1.0, 2.0, 3.0]
    np.testing.assert_allclose(
        observe(jnp.asarray(u[observe.nodes]), NO_THETA), points @ H.T + [1, 2, 3], atol=1e-10
    )
    np.testing.assert_allclose(observe.weights.sum(axis=1), 1.0)
    assert observe.weights.min() > -1e-12
    np.testing.assert_array_equal(np.unique(observe.nodes), observe.nodes)


def test_a_landmark_on_a_node_is_that_node(beam):
    observe = cal.landmarks(beam, beam.mesh.nodes[[7]])
    u = np.random.default_rng(0).normal(size=beam.mesh.nodes.shape)
    np.testing.assert_allclose(observe(jnp.asarray(u[observe.nodes]), NO_THETA), u[[7]], atol=1e-9)


def test_measured_surface_points_are_on_the_surface_give_or_take(beam):
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(0, 100, 50), rng.uniform(0, 10, 50), np.full(50, 10.0)])
    noisy = points + rng.normal(0, 0.01, points.shape)
    noisy[:, 2] = np.abs(noisy[:, 2] - 10.0) + 10.0  # all outside, by a hundredth of a millimetre
    noisy[:, :2] = np.clip(noisy[:, :2], 0.0, [100.0, 10.0])
    observe = cal.landmarks(beam, noisy)
    np.testing.assert_allclose(
        (beam.mesh.nodes[observe.nodes][observe.members] * observe.weights[:, :, None]).sum(1),
        noisy,
        atol=0.06,
    )
    with pytest.raises(InputError, match="outside the body, about 1 mm away"):
        cal.landmarks(beam, [[50.0, 5.0, 11.0]])


def test_descriptions_make_the_same_operator(beam):
    for observe in (cal.nodal_displacements(beam, [3, 9]), cal.landmarks(beam, [[10.0, 5.0, 5.0]])):
        described = observations({"d": observe}).to_json()
        again = observations_from_json(beam, described).parts["d"]
        np.testing.assert_array_equal(again.nodes, observe.nodes)
        np.testing.assert_array_equal(again.points, observe.points)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda s: cal.nodal_displacements(s, [3, 99]),
            "node 99 is unknown; scene .* has nodes 0 to 44",
        ),
        (lambda s: cal.nodal_displacements(s, [-1]), "node -1 is unknown"),
        (lambda s: cal.nodal_displacements(s, [3, 3]), "node 3 is observed twice"),
        (lambda s: cal.nodal_displacements(s, [0.5]), "nodes must be whole numbers"),
        (lambda s: cal.nodal_displacements(s, []), "must be a list of whole numbers, not empty"),
        (lambda s: cal.nodal_displacements(s, "apex"), "node set 'apex' is not in the mesh"),
        (lambda s: cal.landmarks(s, [[1, 1, 1], [500.0, 0, 0]]), "landmark 1 at .* lies outside"),
        (lambda s: cal.landmarks(s, [[np.nan, 1, 1]]), "expected .*finite"),
        (lambda s: spread_nodes(s, 1000, 0), "cannot observe 1000 nodes"),
        (
            lambda s: observations_from_json(s, {"nose": {"kind": "smell"}}),
            "observation kind 'smell' is unknown",
        ),
    ],
)
def test_what_cannot_be_observed(beam, make, message):
    with pytest.raises(InputError, match=message):
        make(beam)


def test_spread_nodes_are_free_and_repeatable(beam):
    nodes = spread_nodes(beam, 20, seed=3)
    assert not beam.held[nodes].any()
    np.testing.assert_array_equal(nodes, spread_nodes(beam, 20, seed=3))
    assert len(set(nodes)) == 20


def test_a_cavity_volume_is_that_of_the_endocardium(ventricle):
    observe = cal.CavityVolume(ventricle)
    assert observe.shape == ()
    np.testing.assert_array_equal(observe.nodes, np.unique(ventricle.mesh.facet_set("endocardium")))
    # A uniform stretch by 1.1 about the centre: volume times 1.1 cubed.
    u = 0.1 * ventricle.mesh.nodes
    rest = observe(jnp.zeros((len(observe.nodes), 3)), NO_THETA)
    assert observe(jnp.asarray(u[observe.nodes]), NO_THETA) == pytest.approx(
        1.1**3 * float(rest), rel=1e-12
    )


def test_several_observations_need_the_union_of_their_nodes(ventricle):
    points = spread_landmarks(ventricle, 4, seed=2)
    parts = {
        "displacement": cal.landmarks(ventricle, points),
        "volume": cal.CavityVolume(ventricle),
    }
    several = observations(parts)
    np.testing.assert_array_equal(
        np.sort(several.nodes), sorted({*parts["displacement"].nodes, *parts["volume"].nodes})
    )
    u = np.random.default_rng(0).normal(size=(2, *ventricle.mesh.nodes.shape))
    seen = several(jnp.asarray(u[:, None, several.nodes]), jnp.zeros((2, 1, 0)))
    for name, part in parts.items():
        np.testing.assert_allclose(
            seen[name], part(jnp.asarray(u[:, part.nodes]), NO_THETA), rtol=1e-13
        )
    again = observations_from_json(ventricle, json.loads(json.dumps(several.to_json())))
    assert list(again.parts) == ["displacement", "volume"]
    np.testing.assert_array_equal(again.nodes, several.nodes)
    # A single one needs no name.
    alone = observations(parts["displacement"])
    assert alone.to_json()["displacement"]["kind"] == "landmarks"
    assert list(observations_from_json(ventricle, alone.to_json()).parts) == ["displacement"]


def test_the_largest_part_is_a_slice_of_the_union(ventricle):
    """Its derivative needs no scatter; the others find their nodes wherever they are."""
    points = spread_landmarks(ventricle, 6, seed=0)
    parts = {
        "displacement": cal.landmarks(ventricle, points),
        "volume": cal.CavityVolume(ventricle),
    }
    both = observations(parts)
    largest = parts["volume"].nodes
    np.testing.assert_array_equal(both.nodes[: len(largest)], largest)
    assert len(np.unique(both.nodes)) == len(both.nodes) > len(largest)
    fields = jnp.asarray(np.random.default_rng(4).normal(size=(2, *ventricle.mesh.nodes.shape)))

    def through(seen):
        return sum((jnp.sum(value**2) for value in seen.values()), jnp.zeros(()))

    of_both = lambda u: through(both(u[None, both.nodes], NO_THETA[None]))
    of_parts = lambda u: through({k: part(u[part.nodes], NO_THETA) for k, part in parts.items()})
    together = jax.jit(jax.vmap(jax.grad(of_both)))(fields)
    alone = np.stack([jax.jit(jax.grad(of_parts))(u) for u in fields])
    np.testing.assert_allclose(together, alone, rtol=1e-12, atol=1e-12)
    alone_rows = observations(parts["volume"])._rows["volume"]
    assert alone_rows == slice(len(largest))


def test_names_of_observations_are_checked(ventricle):
    with pytest.raises(InputError, match="nothing is observed"):
        observations({})
    with pytest.raises(InputError, match="is called 'a/b'; use a name without '/'"):
        observations({"a/b": cal.CavityVolume(ventricle)})
    several = observations({"v": cal.CavityVolume(ventricle), "w": cal.CavityVolume(ventricle)})
    with pytest.raises(InputError, match="noise: give one for each of v, w, by name"):
        several.name(1.0, "noise")
    with pytest.raises(InputError, match="data: nothing for 'w'; observed: v, w"):
        several.name({"v": 1.0}, "data")
    with pytest.raises(InputError, match="data: 'x' is not observed; observed: v, w"):
        several.name({"x": 1.0}, "data")
    with pytest.raises(InputError, match="facet set 'atrium' is not in the mesh"):
        cal.CavityVolume(ventricle, "atrium")


def test_the_guide_names_every_kind():
    text = (Path(__file__).parents[3] / "docs" / "observations.md").read_text(encoding="utf-8")
    for kind in (*OBSERVATIONS.values(), *NOISES.values()):
        assert f"`{kind.kind}" in text, kind.kind
    for kind in NOISES.values():
        for option in usage_of(kind).partition(" of ")[2].split(", "):
            assert f"`{option}`" in text, option
