"""Programs of a system: compiled once, and put together alike by Python and inside ``jit``."""

import logging
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.fem.compiled import PROGRAMS, compiled, cond, while_loop
from emulator.fem.newton import NewtonOptions


class Spring:
    """A system of equations, as far as programs are concerned."""

    def __init__(self, stiffness):
        self.stiffness, self.programs, self.traced = stiffness, {}, 0

    @compiled
    def force(self, u, load=0.0):
        """stiffness u - load"""
        self.traced += 1
        return self.stiffness * u - load


@pytest.fixture
def counted(caplog):
    """The names of what XLA compiles from now on."""
    jax.config.update("jax_log_compiles", True)

    def names():
        found = [r.getMessage() for r in caplog.records if "XLA compilation" in r.getMessage()]
        return [message.split("of ")[1].split(" in ")[0] for message in found]

    with caplog.at_level(logging.WARNING, logger="jax._src.dispatch"):
        yield names
    jax.config.update("jax_log_compiles", False)


def test_numbers_and_arrays_are_one_program():
    spring = Spring(3.0)
    weak = jax.jit(lambda: 2.0)()
    assert weak.weak_type
    for u in (2.0, np.float64(2.0), np.asarray(2.0), jnp.asarray(2.0, float), weak):
        assert spring.force(u, 1.0) == 5.0
        assert spring.force(u, load=jnp.ones(())) == 5.0
    assert spring.traced == 2  # by position and by name


def test_each_system_has_its_own():
    assert [Spring(k).force(1.0) for k in (1.0, 2.0)] == [1.0, 2.0]


def test_derivatives_and_jit_go_through():
    spring = Spring(3.0)
    assert jax.grad(spring.force)(2.0) == 3.0
    assert jax.jit(jax.grad(spring.force, argnums=1))(2.0, 1.0) == -1.0
    np.testing.assert_array_equal(jax.vmap(spring.force)(jnp.arange(3.0)), [0.0, 3.0, 6.0])


def test_what_a_function_closes_over_is_not_in_its_program(monkeypatch):
    """Nor what a program inside it does: a mesh's arrays would be kept on disk with it."""
    table = np.random.default_rng(0).normal(size=(4, 1000))
    inner = compiled(lambda x: x * table[0] + jnp.asarray(table[1]))

    def outer(x, *, shift=0.0):
        return inner(x) + jnp.where(x > 0.0, table[2], shift)

    x = jnp.linspace(-1.0, 1.0, 1000)
    texts = []
    monkeypatch.setattr(PROGRAMS, "same_as", lambda text, program: texts.append(text) or program)
    compiled(outer)(x, shift=2.0)
    assert len(texts[-1]) < len(jax.jit(outer).lower(x, shift=2.0).as_text()) / 10
    # not equal: a fused multiply and add rounds once
    np.testing.assert_allclose(compiled(outer)(x, shift=2.0), outer(x, shift=2.0), atol=1e-14)


def test_transformations_go_through_and_shapes_have_programs_of_their_own(counted):
    table = jnp.arange(6.0)
    double = compiled(lambda x: {"twice": jnp.vdot(table[: len(x)], x**2), "len": len(x)})

    def total(x):
        return double(x)["twice"]

    x = jnp.ones(3)
    assert total(x) == total(2.0 * x) / 4.0 == 3.0
    assert counted().count("jit(<lambda>)") == 1
    assert total(jnp.ones(6)) == 15.0
    assert double(x)["len"] == 3
    np.testing.assert_array_equal(jax.grad(total)(x), 2.0 * table[:3])
    np.testing.assert_array_equal(jax.jit(jax.hessian(total))(x), np.diag(2.0 * table[:3]))
    np.testing.assert_array_equal(jax.vmap(total)(jnp.stack([x, 2.0 * x])), [3.0, 12.0])


def test_bodies_that_differ_in_numbers_share_a_program(counted):
    def program(table, factor=2.0):
        return compiled(lambda x: factor * jnp.vdot(table, x))

    one, ramp = np.ones(7), np.arange(7.0)
    first, second = program(one), program(ramp)
    assert (first(one), second(one)) == (14.0, 42.0)
    assert counted().count("jit(<lambda>)") == 1
    # A number in the program's text is another program; so is what a trace goes through.
    assert program(ramp, 3.0)(one) == 63.0
    assert counted().count("jit(<lambda>)") == 2
    np.testing.assert_array_equal(jax.grad(second)(one), 2.0 * ramp)
    del first  # the program stays for the second
    assert second(ramp) == 182.0


def test_what_a_result_does_not_depend_on_tells_programs_apart():
    """The compiler leaves it out, so that the texts are the same."""

    def program(*tables):
        return compiled(lambda x: [x * jnp.asarray(t) for t in (*tables, np.arange(3.0))][-1])

    one, more = program(np.zeros(2)), program(np.zeros(2), np.zeros(4))
    for each in (one, more):
        np.testing.assert_array_equal(each(2.0), [0.0, 2.0, 4.0])
    by_size = {size: compiled(lambda x, last=size - 1: (x[last], 1.0)[1]) for size in (3, 2)}
    assert [last(jnp.ones(size)) for size, last in by_size.items()] == [1.0, 1.0]


def test_a_derivatives_rule_is_its_own_bodys():
    """The same value, so the same program; the rules close over what differs."""

    def program(slope):
        @jax.custom_jvp
        def value(x):
            return 2.0 * x

        value.defjvp(lambda primals, tangents: (value(*primals), slope * tangents[0]))
        return compiled(value)

    first, second = program(2.0), program(5.0)
    assert first(1.0) == second(1.0) == 2.0
    assert (jax.grad(first)(1.0), jax.grad(second)(1.0)) == (2.0, 5.0)


def test_functions_of_python_are_not_shared():
    before = len(PROGRAMS)
    for factor in (2.0, 3.0):
        shape = jax.ShapeDtypeStruct((), float)
        host = compiled(lambda x, k=factor, s=shape: jax.pure_callback(lambda y: k * y, s, x))
        assert host(jnp.asarray(5.0)) == 5.0 * factor
    assert len(PROGRAMS) <= before


def test_a_body_of_another_size_is_solved_by_the_same_program(beam, counted):
    """A beam and one twice as long: other numbers, the same mesh but for them."""
    mesh = beam.mesh
    longer = replace(mesh, nodes=mesh.nodes * np.array([2.0, 1.0, 1.0]))
    alone, other = (em.Simulator(replace(beam, mesh=m)) for m in (mesh, longer))
    u = alone.solve(beam.centre)
    before = counted().count("jit(find_equilibrium)")
    found = other.solve(beam.centre)
    assert counted().count("jit(find_equilibrium)") == before
    assert found.converged
    assert float(jnp.abs(found.displacement - u.displacement).max()) > 0.1
    np.testing.assert_allclose(
        other.system.residual(found.displacement, beam.centre), 0.0, atol=1e-8
    )


@pytest.mark.parametrize("decision", [True, False])
def test_a_decision_known_runs_its_branch_alone(decision):
    run = []

    def branch(name, sign):
        return lambda x: run.append(name) or sign * x

    def decided(decision, x):
        return cond(decision, branch("yes", 1.0), branch("no", -1.0), x)

    expected = 2.0 if decision else -2.0
    assert decided(jnp.array(decision), 2.0) == expected
    assert run == ["yes" if decision else "no"]
    assert jax.jit(decided)(decision, 2.0) == expected
    assert sorted(run[1:]) == ["no", "yes"]


def test_a_loop_is_the_same_in_python_and_inside_jit():
    def halvings(x, most):
        return while_loop(
            lambda state: (state[0] > 1.0) & (state[1] < most),
            lambda state: (0.5 * state[0], state[1] + 1),
            (x, 0),
        )

    x = jnp.asarray(37.0)
    for most, expected in ((99, 6), (2, 2), (0, 0)):
        assert halvings(x, most) == jax.jit(halvings)(x, most)
        assert halvings(x, most)[1] == expected
        # What is traced may be in the condition alone.
        assert jax.jit(lambda most: halvings(37.0, most))(most)[1] == expected


def test_a_solve_is_one_program_compiled_once(beam, counted):
    # Of constants of its own, so that no other test's program is this one.
    simulator = em.Simulator(beam, NewtonOptions(level_iterations=37))
    cold = simulator.solve(beam.centre)
    assert simulator.solve(1.01 * beam.centre).converged
    assert simulator.solve(1.01 * beam.centre, cold.displacement).converged
    assert counted().count("jit(find_equilibrium)") == 1
