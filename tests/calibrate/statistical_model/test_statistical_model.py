"""The combined model against densities written by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpyro import handlers
from numpyro.infer.util import log_density

import calibrate as cal
from calibrate.measurements import spread_landmarks
from emulator.core.errors import InputError
from linear_support import LinearForward, linear_forward

THETA = {"a": 0.3, "b": 2.0, "a_f": 5.0, "b_f": 1.7, "pressure": 1.1}


def normal(x, mean, sd):
    """Log density of independent Gaussians, summed."""
    z = (np.asarray(x) - np.asarray(mean)) / sd
    return float(np.sum(-0.5 * z**2 - np.log(sd) - 0.5 * np.log(2.0 * np.pi)))


def enclosed(x, facets):
    """mL inside facets that point out of the tissue, closed by a fan; x (n, 3) mm, by loops."""
    edges = {(r[i], r[(i + 1) % 3]) for r in facets.tolist() for i in range(3)}
    rim = [(i, j) for i, j in edges if (j, i) not in edges]
    middle = np.mean([x[i] for i, _ in rim], axis=0)
    total = sum(np.linalg.det(x[row]) for row in facets)
    total += sum(np.linalg.det(np.array([x[j], x[i], middle])) for i, j in rim)
    return abs(total) / 6.0 / 1000.0


@pytest.fixture(scope="module")
def parts(ventricle):
    points = spread_landmarks(ventricle, 5, seed=1)
    return {"displacement": cal.landmarks(ventricle, points), "volume": cal.CavityVolume(ventricle)}


@pytest.fixture(scope="module")
def data(parts):
    return {"displacement": np.random.default_rng(3).normal(size=(5, 3)), "volume": 120.0}


def by_hand(ventricle, forward, parts, data, sds):
    """Log likelihood with numpy, from the full field."""
    u = np.asarray(forward(jnp.array(list(THETA.values()))))
    landmarks = parts["displacement"]
    moved = np.array(
        [
            w @ u[landmarks.nodes[c]]
            for c, w in zip(landmarks.members, landmarks.weights, strict=True)
        ]
    )
    volume = enclosed(ventricle.mesh.nodes + u, ventricle.mesh.facet_set("endocardium"))
    return normal(data["displacement"], moved, sds[0]) + normal(data["volume"], volume, sds[1])


def test_the_density_of_two_observations_is_the_one_by_hand(ventricle, parts, data):
    forward = linear_forward(ventricle, size=1.0)
    noise = {"displacement": cal.GaussianNoise(sd=0.5), "volume": cal.GaussianNoise(sd=4.0)}
    model = cal.model(forward, parts, noise)
    assert model.names == ventricle.parameter_names
    checked = model.check_data(data)
    found, _ = log_density(model, (checked,), {}, {n: jnp.asarray(v) for n, v in THETA.items()})
    prior = sum(
        -np.log(THETA[p.name] * np.log(p.high / p.low))
        if p.scale == "log"
        else -np.log(p.high - p.low)
        for p in ventricle.parameters
    )
    likelihood = by_hand(ventricle, forward, parts, data, (0.5, 4.0))
    assert float(found) == pytest.approx(prior + likelihood, rel=1e-10)
    theta = jnp.array([list(THETA.values())])
    seen = model.forward(theta[0])[None]
    found = model.log_density({}, model.observe(seen, theta), checked)
    assert float(found) == pytest.approx(likelihood, rel=1e-10)


def test_each_noise_may_be_known_or_inferred(ventricle, parts, data):
    forward = linear_forward(ventricle, size=1.0)
    noise = {"displacement": cal.GaussianNoise(sd_scale=1.0), "volume": cal.GaussianNoise(sd=4.0)}
    model = cal.model(forward, parts, noise)
    assert model.names == (*ventricle.parameter_names, "noise_sd_displacement")
    both = cal.model(
        forward, parts, {**noise, "volume": cal.GaussianNoise(sd_scale=2.0)}
    )  # fmt: skip
    assert both.names[-2:] == ("noise_sd_displacement", "noise_sd_volume")
    values = {**THETA, "noise_sd_displacement": 0.7, "noise_sd_volume": 3.0}
    values = {name: jnp.asarray(value) for name, value in values.items()}
    checked = model.check_data(data)
    one, _ = log_density(model, (checked,), {}, {n: values[n] for n in model.names})
    two, _ = log_density(both, (checked,), {}, values)
    # What differs: the volume's term, and the half-normal prior of its noise.
    half_normal = np.log(2.0) + normal(3.0, 0.0, 2.0)
    change = by_hand(ventricle, forward, parts, data, (0.7, 3.0)) - by_hand(
        ventricle, forward, parts, data, (0.7, 4.0)
    )
    assert float(two - one) == pytest.approx(change + half_normal, rel=1e-9)


def test_only_the_observed_nodes_are_asked_for(ventricle, parts, data):
    asked = []

    class Watched(LinearForward):
        def at(self, nodes):
            asked.append(np.asarray(nodes))
            return super().at(nodes)

        def __call__(self, theta):
            assert len(self.nodes) < len(ventricle.mesh.nodes), "the whole field was decoded"
            return super().__call__(theta)

    forward = linear_forward(ventricle, size=1.0, of=Watched)
    noise = {"displacement": cal.GaussianNoise(sd=0.5), "volume": cal.GaussianNoise(sd=4.0)}
    model = cal.model(forward, {"displacement": parts["displacement"]}, noise["displacement"])
    np.testing.assert_array_equal(asked[-1], parts["displacement"].nodes)
    model = cal.model(forward, parts, noise)
    union = {*parts["displacement"].nodes.tolist(), *parts["volume"].nodes.tolist()}
    assert asked[-1].tolist() == sorted(union)
    traced = handlers.trace(handlers.seed(model, jax.random.key(0))).get_trace()
    assert traced["observed_displacement"]["value"].shape == (5, 3)
    assert traced["observed_volume"]["value"].shape == ()


def test_a_single_observation_takes_data_and_noise_as_they_are(ventricle, data):
    forward = linear_forward(ventricle, size=1.0)
    volume = cal.CavityVolume(ventricle)
    plain = cal.model(forward, volume, cal.GaussianNoise(sd_scale=4.0))
    assert plain.names[-1] == "noise_sd"
    named = cal.model(forward, {"volume": volume}, {"volume": cal.GaussianNoise(sd_scale=4.0)})
    values = {name: jnp.asarray(v) for name, v in {**THETA, "noise_sd": 2.0}.items()}
    assert float(log_density(plain, (jnp.asarray(130.0),), {}, values)[0]) == float(
        log_density(named, ({"volume": jnp.asarray(130.0)},), {}, values)[0]
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"volume": np.ones(2)}, r"shape \(2,\); the observation expects \(\) \(volume, mL\)"),
        ({"volume": np.nan}, "1 of 1 values of volume are missing"),
        ({"volume": np.inf}, "volume is inf; it must be finite"),
        ({"displacement": np.full((5, 3), np.inf)}, "displacement, row 1 has an infinite value"),
        ({"volume": -3.0}, "volume is -3.0 mL; it must be above 0"),
        ({"displacement": np.ones((4, 3))}, r"expects \(5, 3\) \(displacement, mm\)"),
        ({"pressure": 1.0}, "data: 'pressure' is not observed; observed: displacement, volume"),
    ],
)
def test_data_that_does_not_fit(ventricle, parts, data, change, message):
    noise = dict.fromkeys(parts, cal.GaussianNoise(sd=1.0))
    model = cal.model(linear_forward(ventricle), parts, noise)
    with pytest.raises(InputError, match=message):
        model.check_data({**data, **change})
    with pytest.raises(InputError, match="noise: nothing for 'volume'"):
        cal.model(linear_forward(ventricle), parts, {"displacement": cal.GaussianNoise(sd=1.0)})
