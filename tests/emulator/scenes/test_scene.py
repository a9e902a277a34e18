from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.catalogue import find_scene, scene_from_origin
from emulator.core.errors import InputError
from emulator.geometry.generators.box import box
from emulator.geometry.mesh import Mesh
from emulator.mechanics.laws import find_law
from emulator.scenes import BUILT_IN, Parameter, Support
from emulator.scenes.loads import FollowerPressure, Gravity
from scene_support import block


@pytest.mark.parametrize("name", sorted(BUILT_IN))
def test_built_in_scenes_are_made_again_by_their_recipe(name):
    scene = find_scene(name)
    assert scene.name == name
    assert scene_from_origin(scene.origin).fingerprint == scene.fingerprint


def test_any_resolution():
    assert len(em.scenes.twisting_cube(cells=9, order=1).mesh.nodes) == 1000
    assert len(em.scenes.once_clamped_beam(cells=(3, 1, 2), order=1).mesh.elements) == 36


def test_the_centre_and_the_corners_of_a_log_box():
    scene = em.scenes.once_clamped_beam(cells=(1, 1, 1), order=1)
    np.testing.assert_allclose(scene.centre, np.sqrt(50.0 * 100.0))
    corners = scene.from_unit(jnp.array([[0.0, 1.0], [1.0, 0.0]]))
    np.testing.assert_allclose(corners, [[50.0, 100.0], [100.0, 50.0]])
    theta = jnp.array([57.0, 83.0])
    np.testing.assert_allclose(scene.from_unit(scene.to_unit(theta)), theta)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"mu": 60.0}, "no value for parameter 'lam'"),
        ({"mu": 60.0, "lam": 60.0, "nu": 0.3}, "has no parameter 'nu'; it has mu, lam"),
        ({"mu": 60.0, "lam": 101.0}, "parameter 'lam' is 101 kPa; scene .* covers 50 to 100"),
        ({"mu": float("nan"), "lam": 60.0}, "parameter 'mu' is nan kPa"),
        ({"mu": -60.0, "lam": 60.0}, "parameter 'mu' is -60 kPa"),
    ],
)
def test_bad_theta(beam, values, message):
    with pytest.raises(InputError, match=message):
        beam.theta(**values)


def test_supports_that_contradict_each_other():
    moved = Support("bottom", np.array([0.0, 0.0, 1.0]))
    with pytest.raises(InputError, match="support on 'bottom' contradicts another one"):
        block(supports=(Support("left"), moved))
    block(supports=(Support("left"), Support("bottom")))  # agreeing is fine


def one_line_held():
    mesh = block().mesh
    line = np.flatnonzero((mesh.nodes[:, 0] == 0.0) & (mesh.nodes[:, 1] == 0.0))
    return replace(mesh, node_sets={"line": line})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"supports": ()}, "no support, the body could move freely"),
        ({"parameters": (Parameter("mu", "kPa", 1.0, 2.0),)}, "law 'neo_hookean' needs 'lam'"),
        ({"constants": {"mu": 1.0}}, "parameter 'mu' is given twice"),
        ({"constants": {"kappa": 1.0}}, "parameter 'kappa' is not one of law 'neo_hookean'"),
        ({"parameters": (), "constants": {"mu": 1.0, "lam": 1.0}}, "no parameter varies"),
        (
            {"parameters": block().parameters[:1], "constants": {"lam": np.nan}},
            "parameter 'lam' is nan kPa; it must be finite",
        ),
        (
            {"supports": (Support("left", np.array([0.0, np.nan, 0.0])),)},
            "displacement is not finite",
        ),
        (
            {"mesh": one_line_held(), "supports": (Support("line"),)},
            "leave 1 of the 6 rigid motions free",
        ),
        ({"supports": (Support("apex"),)}, "node set 'apex' is not in the mesh"),
        ({"supports": (Support("left", np.zeros((2, 3))),)}, r"displacement has shape \(2, 3\)"),
    ],
)
def test_scenes_that_make_no_sense(change, message):
    with pytest.raises(InputError, match=message):
        replace(block(), **change)


@pytest.mark.parametrize("kind", ["fibres", "sheets"])
@pytest.mark.parametrize(("order", "shapes"), [(1, "(6, 3)"), (2, "(6, 3) or (6, 4, 3)")])
def test_directions_of_another_shape(kind, order, shapes):
    """Of elements or of their points; a linear element has one, so that both are the same."""
    sheeted = find_law("holzapfel_ogden_orthotropic")
    constants = dict.fromkeys(sheeted.parameters[1:], 1.0)
    free = (Parameter(sheeted.parameters[0], "kPa", 1.0, 2.0),)
    points = 1 if order == 1 else 4
    right = {
        name: np.broadcast_to(np.eye(3)[k], (6, points, 3))
        for k, name in enumerate(("fibres", "sheets"))
    }
    scene = replace(
        block(), mesh=box((1.0, 1.0, 1.0), (1, 1, 1), order), law=sheeted, parameters=free,
        constants=constants, **right,
    )  # fmt: skip
    of_elements = replace(scene, fibres=right["fibres"][:, 0], sheets=right["sheets"][:, 0])
    assert (scene.fingerprint == of_elements.fingerprint) == (order == 1)
    for each in (scene, of_elements):
        np.testing.assert_array_equal(each.fibres_at_points, right["fibres"])
        assert each.tissue_at(each.centre).directions.shape == (6, points, 2, 3)
    for shape in ((5, 3), (6, 2), (6, 3, 3), (6, points, 3, 1), (24, 3)):
        with pytest.raises(InputError) as caught:
            replace(scene, **{kind: np.ones(shape)})
        said = str(caught.value)
        assert f"{kind} have shape {shape}; expected {shapes}" in said
        assert "\n" not in said


def test_a_scene_without_fibres_has_none_at_its_points():
    with pytest.raises(InputError, match="scene 'block' has no fibres"):
        _ = block().fibres_at_points


MU, LAM = block().parameters


def engineering(*nu: float) -> dict:
    young = Parameter("E", "kPa", 1.0, 2.0)
    return {"law": find_law("neo_hookean_E_nu"), "parameters": (young, Parameter("nu", "", *nu))}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"parameters": (Parameter("mu", "Pa", 1e3, 2e3), LAM)},
            "parameter 'mu' is in Pa; law 'neo_hookean' takes kPa",
        ),
        (
            {"parameters": (Parameter("mu", "", 1.0, 2.0), LAM)},
            "parameter 'mu' is given no unit; law 'neo_hookean' takes kPa",
        ),
        (
            {"parameters": (Parameter("mu", "kPa", -3.0, 2.0), LAM)},
            "parameter 'mu' ranges down to -3 kPa; it must stay above 0",
        ),
        (
            {"parameters": (Parameter("mu", "kPa", 0.0, 2.0), LAM)},
            "parameter 'mu' ranges down to 0 kPa; it must stay above 0",
        ),
        (
            {"parameters": (MU,), "constants": {"lam": -1.0}},
            "parameter 'lam' is -1 kPa; it must be above 0",
        ),
        (engineering(0.1, 0.5), "parameter 'nu' ranges up to 0.5; it must stay below 0.5"),
        (engineering(-1.5, 0.4), "parameter 'nu' ranges down to -1.5; it must stay above -1"),
        (
            {"parameters": (Parameter("E", "kPa", 1.0, 2.0),), "constants": {"nu": 0.5}},
            "parameter 'nu' is 0.5; it must be below 0.5",
        ),
        (
            {
                "parameters": (MU, LAM, Parameter("pressure", "mmHg", 4.0, 10.0)),
                "loads": (FollowerPressure("right"),),
            },
            r"parameter 'pressure' is in mmHg; load FollowerPressure takes kPa "
            r"\(1 mmHg = 0.133322 kPa\)",
        ),
    ],
)
def test_units_and_values_that_law_or_load_cannot_take(change, message):
    if "nu" in change.get("constants", {}):
        change = {**change, "law": find_law("neo_hookean_E_nu")}
    with pytest.raises(InputError, match=message) as caught:
        replace(block(), **change)
    assert "\n" not in str(caught.value)


def test_suction_and_dimensionless_parameters_are_welcome():
    suction = Parameter("pressure", "kPa", -1.0, 1.0)
    replace(block(), parameters=(MU, LAM, suction), loads=(FollowerPressure("right"),))
    replace(block(), **engineering(-0.5, 0.499))


@pytest.mark.parametrize(
    ("low", "high", "scale", "message"),
    [
        (2.0, 1.0, "uniform", "range .* is empty"),
        (0.0, np.inf, "uniform", "is empty or not finite"),
        (0.0, 1.0, "log", "a log scale needs a lower bound above 0"),
        (1.0, 2.0, "cubic", "scale 'cubic'; use log or uniform"),
    ],
)
def test_bad_parameters(low, high, scale, message):
    with pytest.raises(InputError, match=message):
        Parameter("mu", "kPa", low, high, scale)


def test_the_fingerprint_sees_every_part():
    scene = block(loads=(Gravity(),))
    changed = [
        block(),
        block(loads=(Gravity(density=1.1),)),
        block(loads=(Gravity(),), cells=(2, 2, 3)),
        replace(scene, supports=(Support("right"),)),
        replace(scene, parameters=(Parameter("mu", "kPa", 1.0, 11.0, "log"), scene.parameters[1])),
    ]
    prints = [scene.fingerprint, *(other.fingerprint for other in changed)]
    assert len(set(prints)) == len(prints)
    # However it is written, the same scene.
    same = Gravity(density=1, direction=(0, 0, -2))
    assert block(loads=(same,)).fingerprint == scene.fingerprint


def test_constants_take_the_place_of_parameters():
    scene = replace(block(), parameters=block().parameters[:1], constants={"lam": 4.0})
    whole = block()
    u = 0.01 * jnp.asarray(np.random.default_rng(0).normal(size=scene.held.shape))
    assert em.fem.potential_energy(scene)(u, jnp.array([3.0])) == pytest.approx(
        float(em.fem.potential_energy(whole)(u, jnp.array([3.0, 4.0])))
    )


def test_a_load_cannot_share_the_name_of_a_parameter_of_the_law(beam):
    load = FollowerPressure("right", parameter="mu")
    with pytest.raises(InputError, match="load FollowerPressure and law 'neo_hookean' both have"):
        replace(beam, loads=(load,))


def test_a_part_without_a_support_is_named():
    """Two blocks apart, one clamped: what would be a singular tangent is one line."""
    block = box((10.0, 10.0, 10.0), (1, 1, 1))
    count = len(block.nodes)
    nodes = np.concatenate([block.nodes, block.nodes + [30.0, 0.0, 0.0]])
    elements = np.concatenate([block.elements, block.elements + count])
    mesh = Mesh(nodes, elements, {"left": block.node_set("left")})
    whole = em.scenes.once_clamped_beam((1, 1, 1), order=1)
    with pytest.raises(
        InputError, match=r"2 parts, and supports leave the one of 8 nodes about \(35"
    ):
        replace(whole, mesh=mesh)
