from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.core.errors import InputError
from emulator.fem.energy import potential_energy
from emulator.geometry.generators.box import box
from emulator.geometry.refinement import corner_parents, to_linear, to_quadratic
from emulator.mechanics.laws import find_law
from emulator.scenes import Parameter
from emulator.scenes.effects import Onto, effects_of, leave_out
from emulator.scenes.loads import CavityPressure, DeadPressure, FollowerPressure, Gravity, Traction
from emulator.scenes.scene import inflated_cavity
from emulator.scenes.supports import ElasticSupport
from scene_support import block


def rich():
    """A block with every effect that a law, load or support can leave out."""
    plain = block(loads=(Gravity(),))
    mesh = to_quadratic(plain.mesh)
    return replace(
        plain,
        mesh=mesh,
        dilatation="mean",
        loads=(FollowerPressure("right"), *plain.loads),
        law=find_law("holzapfel_ogden_dispersed"),
        parameters=(
            Parameter("a", "kPa", 1.0, 2.0),
            Parameter("dispersion", "", 0.1, 0.2),
            Parameter("pressure", "kPa", 0.0, 0.1),
        ),
        constants={"b": 1.0, "a_f": 1.0, "b_f": 1.0, "kappa": 20.0},
        fibres=np.tile([1.0, 0.0, 0.0], (len(mesh.elements), 1)),
        supports=(
            *plain.supports,
            ElasticSupport("top", 0.1),
            ElasticSupport("top", 0.2, "normal"),
        ),
    )


def test_each_effect_goes_with_what_it_alone_needs():
    scene = rich()
    effects = effects_of(scene)
    assert list(effects) == [
        "tension switch",
        "fibre dispersion",
        "fibres",
        "pressure that follows 'right'",
        "gravity",
        "springs on 'top'",
        "normal springs on 'top'",
        "mean dilatation",
        "quadratic elements",
    ]
    without = {name: effect.without for name, effect in effects.items()}
    assert without["fibre dispersion"].parameter_names == ("a", "pressure")
    assert dict(without["fibres"].constants) == {"b": 1.0, "kappa": 20.0}
    assert without["fibres"].fibres is None
    assert without["pressure that follows 'right'"].loads == (DeadPressure("right"), Gravity())
    assert without["gravity"].loads == (FollowerPressure("right"),)
    assert without["springs on 'top'"].supports[1:] == (ElasticSupport("top", 0.2, "normal"),)
    assert without["mean dilatation"].dilatation == "pointwise"
    assert without["quadratic elements"].mesh.order == 1
    assert without["quadratic elements"].dilatation == "pointwise"
    remedies = {name: effect.remedy for name, effect in effects.items()}
    assert remedies["fibres"] == 'law = "holzapfel_ogden_isotropic"'
    assert "'dead_pressure' for 'follower_pressure'" in remedies["pressure that follows 'right'"]
    assert len({effect.without.fingerprint for effect in effects.values()}) == len(effects)


def test_leaving_out_all_and_what_cannot_go():
    simplest = leave_out(rich(), effects_of(rich()))
    assert not effects_of(simplest)
    assert simplest.law.name == "holzapfel_ogden_isotropic"
    # Nothing would move the body, or hold it.
    assert "gravity" not in effects_of(block(loads=(Gravity(),)))
    held_by_springs = block(loads=(Gravity(),), supports=(ElasticSupport("left", 1.0),))
    assert "springs on 'left'" not in effects_of(held_by_springs)
    with pytest.raises(InputError, match="no effect 'magic' that it can do without; it has finite"):
        leave_out(block(loads=(Gravity(),)), ["magic"])


def test_an_effect_that_is_absent_costs_nothing():
    """The energy without gravity has the operations of a scene that never had any."""
    pulled = block(loads=(Traction("right", (1.0, 0.0, 0.0)), Gravity()))

    def operations(scene):
        u = jnp.zeros(scene.held.shape)
        return str(jax.make_jaxpr(jax.grad(potential_energy(scene)))(u, scene.centre))

    never = block(loads=(Traction("right", (1.0, 0.0, 0.0)),))
    assert operations(leave_out(pulled, ["gravity"])) == operations(never)


def test_linear_from_quadratic_and_back():
    linear = box((2.0, 3.0, 4.0), (2, 2, 2))
    quadratic = to_quadratic(linear)
    again = to_linear(quadratic)
    np.testing.assert_array_equal(again.nodes, linear.nodes)
    np.testing.assert_array_equal(again.elements, linear.elements)
    for name, nodes in linear.node_sets.items():
        np.testing.assert_array_equal(again.node_sets[name], np.sort(nodes))
    for name, rows in linear.facet_sets.items():
        np.testing.assert_array_equal(again.facet_sets[name], rows)
    # A field linear in space is the same on both.
    field = linear.nodes @ np.arange(9.0).reshape(3, 3)
    lifted = field[corner_parents(quadratic)].mean(axis=1)
    np.testing.assert_allclose(lifted, quadratic.nodes @ np.arange(9.0).reshape(3, 3), atol=1e-12)
    with pytest.raises(InputError, match="linear already"):
        to_linear(linear)


def test_theta_and_displacement_go_between_the_scenes():
    scene = rich()
    onto = Onto(scene, leave_out(scene, ["fibre dispersion", "quadratic elements"]))
    np.testing.assert_array_equal(onto.theta(jnp.array([1.5, 0.15, 0.05])), [1.5, 0.05])
    u = jnp.asarray(onto.simpler.mesh.nodes * [1.0, 2.0, 3.0])
    np.testing.assert_allclose(onto.field(u), scene.mesh.nodes * [1.0, 2.0, 3.0], atol=1e-12)


@pytest.mark.parametrize("order", [1, 2])
def test_a_dead_pressure_is_the_following_one_to_first_order(order):
    mesh = box((2.0, 3.0, 4.0), (2, 2, 2))
    mesh = to_quadratic(mesh) if order == 2 else mesh
    scene = replace(block(loads=(Gravity(),)), mesh=mesh, loads=(DeadPressure("right", 0.7),))
    (load,) = scene.loads
    force = load.dead_forces(scene.discretisation)[None]
    # Its resultant is -p A N, and its virtual work the following pressure's at rest.
    np.testing.assert_allclose(force.sum(axis=0), [-0.7 * 12.0, 0.0, 0.0], atol=1e-12)
    follower = FollowerPressure("right", 0.7).force(scene.discretisation)
    at_rest = follower.total(jnp.zeros(scene.held.shape), {})
    np.testing.assert_allclose(force, at_rest, atol=1e-12)
    by_name = DeadPressure("right", parameter="p").dead_forces(scene.discretisation)
    np.testing.assert_allclose(0.7 * by_name["p"], force, atol=1e-14)
    assert load.pressed == "right"


def test_a_scene_of_small_strains_is_linear(beam):
    small = em.Simulator(leave_out(beam, ["finite strain"]))
    heavy = replace(small.scene, loads=(replace(beam.loads[0], density=10.0),))
    light = small.solve(beam.centre)
    assert int(light.iterations) <= 2
    tenfold = em.Simulator(heavy).solve(beam.centre)
    np.testing.assert_allclose(tenfold.displacement, 10.0 * light.displacement, rtol=1e-9)


def test_cavities_keep_their_pressure():
    scene = em.scenes.left_ventricle(4, 8, 1, order=1)
    assert effects_of(scene)["pressure that follows 'endocardium'"].without.loads == (
        DeadPressure("endocardium"),
    )
    assert isinstance(scene.loads[0], CavityPressure)


def test_the_inflated_cavity_is_the_one_whose_pressure_varies():
    scene = em.scenes.biventricle(4, 8, (1, 1), order=1)
    assert inflated_cavity(scene) == ("lv_endocardium", "pressure")
    known = {"pressure": 1.0, "kappa": 25.0}
    *material, pressure = scene.parameters
    right = replace(pressure, name="right_pressure")
    other = replace(scene, parameters=(*material, right), constants=known)
    assert inflated_cavity(other) == ("rv_endocardium", "right_pressure")
    fixed = replace(scene, parameters=tuple(material), constants={**known, "right_pressure": 0.3})
    assert inflated_cavity(fixed) is None
    assert inflated_cavity(block(loads=(Gravity(),))) is None
