"""Effects a scene does not have cost nothing; one that is added adds its own terms and no others."""

from collections import Counter
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.mechanics.kinematics import Strain
from emulator.mechanics.laws import find_law
from emulator.mechanics.laws.law import Law, logarithmic, modulus, quadratic
from emulator.scenes.loads import CavityPressure, Gravity, Traction
from scene_support import block

SHAPE = Law("shape only", (modulus("mu"),), lambda strain, mu: 0.5 * mu * strain.I1_minus_3)


def with_volume(volumetric):
    energy = lambda strain, mu, kappa: 0.5 * mu * strain.I1_minus_3 + volumetric(strain, kappa)
    return Law("with volume", (modulus("mu"), modulus("kappa")), energy)


def operations(jaxpr) -> Counter:
    """Primitives of a jaxpr and of all it calls."""
    count = Counter()
    for equation in jaxpr.eqns:
        inner = [v for v in jax.tree.leaves(list(equation.params.values())) if hasattr(v, "jaxpr")]
        if inner:
            for closed in inner:
                count += operations(closed.jaxpr)
        else:
            count[equation.primitive.name] += 1
    return count


def cost(scene):
    """Operations of the energy's value and gradient, and what the compiler makes of them."""
    function = jax.value_and_grad(em.fem.potential_energy(scene))
    arguments = (jnp.zeros(scene.held.shape), scene.centre)
    flops = jax.jit(function).lower(*arguments).compile().cost_analysis()["flops"]
    return operations(jax.make_jaxpr(function)(*arguments).jaxpr), flops


def scene_of(law, constants=None, **changes):
    return replace(
        block(cells=(3, 3, 3)),
        law=law,
        parameters=(em.Parameter("mu", "kPa", 1.0, 10.0),),
        constants=constants or {},
        **changes,
    )


def test_without_a_volumetric_part_there_is_no_J():
    bare, bare_flops = cost(scene_of(SHAPE))
    square, square_flops = cost(scene_of(with_volume(quadratic), {"kappa": 5.0}))
    log, log_flops = cost(scene_of(with_volume(logarithmic), {"kappa": 5.0}))
    assert not {"log1p", "log", "exp", "expm1"} & set(bare)
    assert not {"log1p", "log", "exp", "expm1"} & set(square)
    assert log["log1p"] == 1
    assert bare_flops < min(square_flops, log_flops)


@pytest.mark.parametrize(
    "load", [Gravity(), Traction("right", (1.0, 0.0, 0.0))], ids=["gravity", "traction"]
)
def test_a_dead_load_adds_one_product_however_many_there_are(load):
    bare, bare_flops = cost(scene_of(SHAPE))
    one, one_flops = cost(scene_of(SHAPE, loads=(load,)))
    two, two_flops = cost(scene_of(SHAPE, loads=(load, load)))
    assert one["dot_general"] == bare["dot_general"] + 2  # in the value and in its gradient
    assert one == two
    assert bare_flops < one_flops == two_flops
    # A product with every displacement in value and gradient, not an integral over the body.
    assert one_flops - bare_flops <= 6 * 3 * 64


def test_a_pressure_costs_its_facets_and_not_the_body():
    sides = tuple(em.Support(name) for name in ("left", "right", "front", "back"))
    bare, bare_flops = cost(scene_of(SHAPE, supports=sides))
    pressed, flops = cost(scene_of(SHAPE, supports=sides, loads=(CavityPressure("top", 1.0),)))
    facets = 18
    assert sum(pressed.values()) > sum(bare.values())
    assert flops - bare_flops <= 400 * facets


def test_without_fibres_no_direction_is_looked_up():
    law = find_law("holzapfel_ogden")
    matrix = Law(
        "matrix only",
        (modulus("mu"),),
        lambda strain, mu: 0.5 * mu * jnp.expm1(strain.isochoric_I1_minus_3),
    )
    bare, bare_flops = cost(scene_of(matrix))
    fibres = np.tile([1.0, 0.0, 0.0], (len(block(cells=(3, 3, 3)).mesh.elements), 1))
    with_fibres = replace(
        scene_of(SHAPE),
        law=law,
        parameters=(em.Parameter("a", "kPa", 1.0, 2.0),),
        constants={"b": 1.0, "a_f": 1.0, "b_f": 1.0, "kappa": 10.0},
        fibres=fibres,
    )
    one, flops = cost(with_fibres)
    assert "max" not in bare  # the fibres' tension switch
    assert one["max"] >= 1
    assert flops > bare_flops


def test_without_regions_the_law_is_evaluated_and_no_more():
    scene = scene_of(SHAPE)
    grid, theta = scene.discretisation, scene.centre

    def by_hand(u, theta):
        H = jnp.einsum("mai,mqaj->mqij", u[grid.connectivity], grid.gradients)
        points = H.reshape(-1, 3, 3)  # all of them one batch
        W = jax.vmap(lambda h: 0.5 * theta[0] * Strain(h).I1_minus_3)(points)
        return jnp.sum(grid.weights * W.reshape(grid.weights.shape))

    arguments = (jnp.zeros(scene.held.shape), theta)
    expected = operations(jax.make_jaxpr(jax.value_and_grad(by_hand))(*arguments).jaxpr)
    assert cost(scene)[0] == expected


def test_regions_add_one_look_up_and_one_product_a_modulus():
    law = replace(SHAPE, shape_moduli=("mu",))
    bare, bare_flops = cost(scene_of(law))
    elements = len(block(cells=(3, 3, 3)).mesh.elements)
    regions = np.arange(elements) % 4
    factors = {f"stiffness_{label}": 1.0 + label for label in range(4)}
    one, flops = cost(scene_of(law, factors, regions=regions))
    assert one["gather"] == bare["gather"] + 1
    assert one["mul"] == bare["mul"] + 1  # of the modulus; its transpose is not asked for
    assert set(one) - set(bare) == {"stack"}  # the factors; numbers of regions are known
    assert 0 < flops - bare_flops <= 8 * elements
