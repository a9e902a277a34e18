"""Data without noise at many draws: those of the model at each, by solves too, and none in vain."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import calibrate as cal
import emulator as em
from calibrate.statistical_model import many_draws
from calibrate.statistical_model.density import density_of, heights
from calibrate.statistical_model.many_draws import BATCH, BLOCK, in_blocks, means_at
from linear_support import linear_forward


@pytest.fixture(scope="module")
def model(beam):
    observe = {
        "tip": cal.nodal_displacements(beam, [40]),
        "far": cal.nodal_displacements(beam, [7]),
    }
    return cal.model(linear_forward(beam), observe, {n: cal.GaussianNoise(sd=0.1) for n in observe})


def draws_of(model, count):
    keys = jax.random.key(0)
    return {name: np.array(v) for name, v in model.prior_draws(keys, count).items()}


@pytest.mark.parametrize("count", [1, BATCH + 1, BLOCK, 2 * BLOCK + 3])
def test_they_are_the_model_s_at_each_draw(model, count):
    draws = draws_of(model, count)
    means, valid = means_at(model, draws)
    expected, also_valid = jax.vmap(model.predict)({n: jnp.asarray(v) for n, v in draws.items()})
    assert valid.shape == (count,)
    np.testing.assert_array_equal(valid, also_valid)
    assert set(means) == {"tip", "far"}
    for name, values in means.items():
        assert values.shape == (count, 1, 3)
        np.testing.assert_allclose(values, expected[name], rtol=1e-13, atol=1e-13)


def test_where_the_map_has_no_answer_data_are_zero_and_the_density_is_too(beam, model):
    limited = cal.model(linear_forward(beam, limit=99.0), model.observe, model.noise)
    draws = {name: np.full(40, 60.0) for name in limited.names}
    draws["mu"][7] = 99.5
    means, valid = means_at(limited, draws)
    assert np.flatnonzero(~valid).tolist() == [7]
    assert all(not values[7].any() and values[8].any() for values in means.values())


def test_heights_are_the_density_s(model):
    density = density_of(model)
    z = np.random.default_rng(0).normal(size=(BLOCK + 5, density.dimension))
    data = model.check_data({n: v[0] for n, v in means_at(model, draws_of(model, 1))[0].items()})
    at = heights(density, z, data)
    whole = jax.vmap(lambda z: density.log_density(z, data))(jnp.asarray(z))
    np.testing.assert_allclose(at.prior + at.likelihood, whole, rtol=1e-10)


@pytest.mark.parametrize("states", [("",), ("a", "b")], ids=["one state", "two states"])
def test_solves_from_python_give_what_a_traced_one_gives(beam, simulator, states):
    observe = {f"end@{s}" if s else "end": cal.nodal_displacements(beam, "right") for s in states}
    model = cal.model(em.fem_forward(simulator), observe, {"end": cal.GaussianNoise(sd=0.2)})
    draws = draws_of(model, 3)
    means, valid = means_at(model, draws)
    assert valid.all()
    by_trace = jax.jit(model.predict)
    for k in range(3):
        expected, _ = by_trace({name: jnp.asarray(v[k]) for name, v in draws.items()})
        for name, values in means.items():
            np.testing.assert_allclose(values[k], expected[name], atol=1e-8)


def test_a_map_that_solves_is_asked_for_no_row_that_nobody_wants(model, monkeypatch):
    monkeypatch.setattr(many_draws, "batches", lambda _: False)
    asked = []
    fresh = cal.model(model.full, {"tip": model.observe.parts["tip"]}, cal.GaussianNoise(sd=0.1))
    predict = type(fresh).predict_stacked

    def counting(self, values):
        jax.debug.callback(lambda: asked.append(1))
        return predict(self, values)

    monkeypatch.setattr(type(fresh), "predict_stacked", counting)
    means_at(fresh, draws_of(fresh, 3))
    jax.effects_barrier()
    assert len(asked) == 3


def test_trees_go_in_blocks_and_come_back_whole():
    x = np.arange(2.0 * BLOCK + 3)
    shapes = []

    def program(tree):
        shapes.append(tree["b"].shape)
        return tree["a"] + tree["b"][:, 1]

    back = in_blocks(program, {"a": x, "b": np.stack([x, 2.0 * x], axis=1)})
    np.testing.assert_array_equal(back, 3.0 * x)
    assert shapes == [(BLOCK, 2)] * 3
