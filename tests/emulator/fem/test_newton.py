"""The line search, and what its loops read in their conditions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.fem.fallbacks import find_equilibrium
from emulator.fem.newton import largest_admissible


def conditions(jaxpr):
    """The conditions of all loops in a jaxpr, inner ones included."""
    for equation in jaxpr.eqns:
        if equation.primitive.name == "while":
            yield equation.params["cond_jaxpr"].jaxpr
        for value in jax.tree.leaves(list(equation.params.values())):
            inner = getattr(value, "jaxpr", value)
            if hasattr(inner, "eqns"):
                yield from conditions(inner)


@pytest.mark.parametrize("name", ["beam", "ventricle"])
def test_conditions_of_loops_read_flags_only(name, request):
    """Under vmap a condition that evaluates the potential hung on a ventricle."""
    scene = request.getfixturevalue(name)
    system = em.Simulator(scene).system
    solve = lambda theta, start: find_equilibrium(system, em.fem.NewtonOptions(), theta, start)
    arguments = scene.centre, jnp.zeros(scene.held.shape)
    found = list(conditions(jax.make_jaxpr(solve)(*arguments).jaxpr))
    assert len(found) >= 3  # the iteration and two of the line search
    for condition in found:
        assert len(condition.eqns) <= 8
        assert all(v.aval.size <= 1 for each in condition.eqns for v in each.outvars)


@pytest.mark.parametrize(("limit", "expected"), [(2.0, 1.0), (0.6, 0.5), (0.1, 0.0625), (0.0, 0.0)])
def test_the_largest_admissible_fraction(limit, expected):
    find = lambda limit: largest_admissible(lambda fraction: fraction <= limit, 2.0**-4)
    assert find(limit) == expected
    together = jax.jit(jax.vmap(find))(jnp.array([limit, 0.3]))
    np.testing.assert_array_equal(together, [expected, 0.25])
