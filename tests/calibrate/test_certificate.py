from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import calibrate as cal
import emulator as em
from calibrate.certificate import judge, pareto_threshold
from calibrate.posterior import Posterior
from emulator.errors import InputError
from emulator.fem.solution import Solution, Status
from linear_support import linear_forward


def gaussian_case(true_mean, true_sd, used_mean=0.0, used_sd=1.0, count=400):
    """Draws of a Gaussian and their log ratios to another one."""
    x = used_mean + used_sd * np.random.default_rng(0).normal(size=count)
    log = lambda m, s: -0.5 * ((x - m) / s) ** 2 - np.log(s)
    return log(true_mean, true_sd) - log(used_mean, used_sd), {"x": x}


def test_the_right_posterior_is_accepted():
    certificate = judge(*gaussian_case(0.0, 1.0))
    assert certificate.verdict == "accepted"
    assert certificate.ess == pytest.approx(400)
    assert certificate.shift["x"] == pytest.approx(0.0, abs=1e-12)


def test_a_slightly_shifted_one_is_accepted_and_its_shift_measured():
    certificate = judge(*gaussian_case(0.1, 1.0))
    assert certificate.verdict == "accepted"
    assert certificate.shift["x"] == pytest.approx(0.1, abs=0.02)


def test_a_shifted_one_is_to_be_reweighted():
    certificate = judge(*gaussian_case(0.5, 1.0))
    assert certificate.verdict == "reweight"
    assert certificate.mean_fem["x"] == pytest.approx(0.5, abs=0.1)


@pytest.mark.parametrize(("mean", "sd"), [(6.0, 1.0), (0.0, 4.0)])
def test_a_far_or_too_narrow_one_is_not_certified(mean, sd):
    certificate = judge(*gaussian_case(mean, sd))
    assert certificate.verdict == "not certified"
    assert certificate.k_hat > certificate.k_threshold


def test_failed_fem_runs_count():
    ratios, draws = gaussian_case(0.0, 1.0)
    ratios[:20] = -np.inf
    certificate = judge(ratios, draws)
    assert certificate.failed == 20
    assert certificate.verdict == "not certified"
    ratios[:] = -np.inf
    assert judge(ratios, draws).verdict == "not certified"
    ratios[:] = np.nan
    assert judge(ratios, draws).verdict == "not certified"


def test_a_stuck_sampler_is_not_accepted():
    stuck = judge(np.zeros(100), {"x": np.ones(100)})
    assert (stuck.verdict, stuck.reason) == (
        "not certified",
        "the draws of a parameter do not vary",
    )
    apart = judge(*gaussian_case(0.0, 1.0), r_hat=1.2)
    assert (apart.verdict, apart.reason) == ("not certified", "the chains disagree, R-hat 1.200")
    unknown = judge(*gaussian_case(0.0, 1.0), r_hat=float("nan"))
    assert unknown.verdict == "not certified"
    assert "R-hat is not a number" in unknown.reason


def test_threshold():
    # 1 - 1 / log10(100) = 0.5; capped at 0.7 from about 2200 draws on.
    assert pareto_threshold(100) == pytest.approx(0.5)
    assert pareto_threshold(10_000) == 0.7


class LinearSimulator:
    """Stands for FEM: a linear map that converges everywhere."""

    def __init__(self, forward):
        self.forward, self.scene = forward, forward.scene

    def solve(self, theta, start=None):
        return Solution(self.forward(theta), jnp.array(Status.CONVERGED), *[jnp.array(0.0)] * 4)


@pytest.fixture(scope="module")
def posterior(beam):
    forward = linear_forward(beam)
    observe = cal.nodal_displacements(beam, [3, 11, 20])
    model = cal.model(forward, observe, cal.GaussianNoise(sd=0.1))
    data = np.asarray(forward.at(observe.nodes)(jnp.array([72.0, 68.0])))
    return cal.sample(model, data, options=cal.NUTSOptions(200, 200))


def test_certify_sees_the_error_of_the_forward_map(posterior, beam):
    forward = posterior.model.full
    same = cal.certify(posterior, LinearSimulator(forward))
    assert same.verdict == "accepted"
    assert same.k_hat == 0.0
    near = replace(forward, matrix=forward.matrix * 1.001)
    assert cal.certify(posterior, LinearSimulator(near)).verdict == "accepted"
    far = replace(forward, shift=forward.shift + 1.0)  # ten noise sd
    assert cal.certify(posterior, LinearSimulator(far)).verdict == "not certified"


@pytest.mark.parametrize("name", ["mu", "lam"])
def test_one_r_hat_that_is_not_a_number_is_enough(posterior, name, monkeypatch):
    """Python's max would drop a NaN that does not come first."""
    table = posterior.summary()
    table[name]["r_hat"] = float("nan")
    monkeypatch.setattr(Posterior, "summary", lambda _: table)
    certificate = cal.certify(posterior, LinearSimulator(posterior.model.full))
    assert certificate.verdict == "not certified"


def test_one_chain_with_a_finite_r_hat_is_certified(posterior, monkeypatch):
    one = replace(posterior, tree=posterior.tree.isel(chain=slice(1)))
    table = {name: {**row, "r_hat": 1.01} for name, row in posterior.summary().items()}
    monkeypatch.setattr(Posterior, "summary", lambda _: table)
    assert cal.certify(one, LinearSimulator(one.model.full)).verdict == "accepted"


def test_certify_with_an_inferred_noise(beam):
    forward = linear_forward(beam)
    model = cal.model(
        forward, cal.nodal_displacements(beam, "all"), cal.GaussianNoise(sd_scale=1.0)
    )
    noise = 0.3 * np.random.default_rng(1).normal(size=(45, 3))
    data = np.asarray(forward(jnp.array([72.0, 68.0]))) + noise
    posterior = cal.sample(model, data, options=cal.NUTSOptions(200, 300))
    certificate = cal.certify(posterior, LinearSimulator(forward))
    assert certificate.verdict == "accepted"
    assert set(certificate.shift) == {"mu", "lam", "noise_sd"}


def test_certify_refuses_what_makes_no_sense(posterior, cube):
    with pytest.raises(InputError, match="the simulator's scene is not the posterior's"):
        cal.certify(posterior, em.Simulator(cube))
    with pytest.raises(InputError, match="10 draws asked for; give 25 to \\d+"):
        cal.certify(posterior, LinearSimulator(posterior.model.full), draws=10)


def test_a_posterior_survives_the_disk(posterior, tmp_path):
    from calibrate.posterior import read_tree

    posterior.save(tmp_path / "p.nc")
    tree = read_tree(tmp_path / "p.nc")
    assert {"posterior", "sample_stats", "observed_data", "constant_data"} <= set(tree.children)
    back = Posterior(tree, posterior.model, posterior.data)
    for name, values in posterior.draws().items():
        np.testing.assert_array_equal(back.draws()[name], values)
    assert tree.attrs["scene_fingerprint"] == posterior.model.forward.scene.fingerprint
    assert "numpyro" in tree.attrs["versions"]
    assert tree.attrs["seed"] == 0
    (tmp_path / "p.nc").write_bytes((tmp_path / "p.nc").read_bytes()[:5000])
    with pytest.raises(InputError, match="truncated or not netCDF"):
        read_tree(tmp_path / "p.nc")
