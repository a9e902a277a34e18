"""Noise of a run: from words and JSON to the likelihood and to synthetic data."""

import json
from dataclasses import asdict, astuple, replace

import numpy as np
import pytest

import calibrate as cal
import emulator as em
from calibrate.cli.output import posterior_summary
from calibrate.cli.run_words import noise_scale_words, noise_words
from calibrate.measurements import parse_observation
from calibrate.measurements.data import write_data
from calibrate.noise import StudentTNoise
from calibrate.project import Run, infer, read_posterior, read_problem, report
from data_support import make_data
from emulator.core import schema
from emulator.core.errors import InputError
from emulator.geometry.generators.ellipsoid import HUMAN
from emulator.scenes.built_in import BUILT_IN
from emulator.scenes.scene import cavity_sets
from linear_support import linear_forward

TRUTH = {"mu": 70.0, "lam": 60.0}


def run_of(**options):
    return Run("once_clamped_beam", observe="nodes:9+length:3:14", truth=TRUTH, **options)


ALIKE = {"kind": "correlated", "length": 20.0, "sd": 0.2, "spatial_sd_scale": 0.5}


def test_words_name_noise():
    assert noise_words(["0.3"]) == 0.3
    assert noise_words([]) == {}
    assert noise_words(["0.3", "length:3:14=student_t:dof=4,scale=0.2", "volume=1"]) == {
        "displacement": 0.3,
        "length:3:14": {"kind": "student_t", "dof": 4.0, "scale": 0.2},
        "volume": 1.0,
    }
    assert noise_scale_words(["volume=1"]) == {"volume": 1.0}


def test_a_run_makes_its_noise_from_json(beam, tmp_path):
    given = {"displacement": {"kind": "student_t", "dof": 4, "scale": 0.2}}
    run = run_of(noise=given, noise_scale={"length:3:14": 2.0})
    (tmp_path / "run.json").write_text(json.dumps(asdict(run)))
    run = schema.read_json_as(Run, tmp_path / "run.json")
    observe = parse_observation(beam, run.observe)
    assert run.noises(observe) == {
        "displacement": StudentTNoise(4, 0.2),
        "length:3:14": cal.GaussianNoise(sd_scale=2.0),
    }
    assert run.synthetic_noise(observe)["length:3:14"] == cal.GaussianNoise(sd=0.5)
    unknown = run_of(noise=given, noise_scale={"displacement": 0.4})
    assert unknown.noises(observe)["displacement"] == StudentTNoise(4, prior_scale=0.4)
    assert unknown.synthetic_noise(observe)["displacement"] == StudentTNoise(4, 0.2)


def test_a_discrepancy_is_noise_that_correlates_of_an_sd_that_is_inferred(beam):
    run = run_of(noise={"displacement": ALIKE})
    observe = parse_observation(beam, run.observe)
    model = cal.model(linear_forward(beam), observe, run.noises(observe))
    assert model.names == ("mu", "lam", "spatial_sd_displacement")
    for noise, message in (
        ({"length:3:14": ALIKE}, "has no place of its"),
        ({"displacement": {"kind": "correlated", "sd": 0.2}}, "'length' is miss"),
        ({"displacement": {"kind": "pink"}}, "displacement .mm.: noise 'pink' is"),
    ):
        with pytest.raises(InputError, match=message):
            cal.model(linear_forward(beam), observe, run_of(noise=noise).noises(observe))


def test_synthetic_data_has_the_noise_of_the_run(beam, monkeypatch):
    monkeypatch.setattr(
        "calibrate.project.problem.simulator_of", lambda scene, *_: linear_forward(scene)
    )
    word = {"kind": "correlated", "length": 500.0, "sd": 1e-9, "spatial_sd": 1.0}
    observe, noisy = make_data(run_of(noise={"displacement": word}), beam)
    _, exact = make_data(run_of(noise={"displacement": 1e-12}), beam)
    noise = noisy["displacement"] - exact["displacement"]
    # Over a length far beyond the body the noise is nearly one shift, of its own a component.
    assert np.ptp(noise, axis=0).max() < 0.5 < np.abs(noise).max()
    assert np.ptp(noise[0]) > 0.1
    assert observe.parts["displacement"].shape == (9, 3)


@pytest.mark.slow
def test_a_posterior_with_gaps_and_a_discrepancy_is_kept_and_read(tmp_path):
    """By files, as between `infer` and `certify`; the shipped emulator is the forward map."""
    scene = em.scenes.once_clamped_beam()
    observe, data = make_data(Run("once_clamped_beam", truth={"mu": 73.0, "lam": 61.0}), scene)
    values = data["displacement"]
    values[3] = values[5, 1] = np.nan
    write_data(tmp_path / "d.csv", observe, data)
    run = Run(
        "once_clamped_beam", data=str(tmp_path / "d.csv"), warmup=50, draws=50, chains=2,
        noise={"displacement": ALIKE},
    )  # fmt: skip
    posterior = infer(run, tmp_path / "out")
    assert len(report(run, posterior, None)["missing"]["displacement"]) == 2
    assert "points of displacement without a value, left out: 2 (of node " in posterior_summary(
        report(run, posterior, None)
    )
    again, back = read_posterior(tmp_path / "out")
    assert again.noise == {"displacement": ALIKE}
    np.testing.assert_array_equal(back.data["displacement"], values[~np.isnan(values)])
    draw = {name: values[7] for name, values in back.draws().items()}
    assert "spatial_sd" in draw
    thetas = back.model.states.thetas(draw)
    u = back.model.evaluate(thetas).displacement
    densities = [
        float(p.model.log_density(draw, p.model.observe(u, thetas), p.data))
        for p in (posterior, back)
    ]
    assert densities[0] == pytest.approx(densities[1], rel=1e-12)


def test_what_is_said_of_one_state_makes_its_noise_one_of_its_own(beam):
    observe = parse_observation(beam, "nodes:4", 0, ("soft", "stiff"))
    run = run_of(noise=0.3, noise_scale={"displacement@soft": 0.2})
    found = run.noises(observe)
    assert {name: noise.sd for name, noise in found.items()} == {
        "displacement@soft": None,
        "displacement": 0.3,
    }


def test_a_default_is_no_larger_than_the_body_allows_and_said_to_be_that():
    mouse = em.scenes.left_ventricle(
        rings=3, around=8, layers=1, order=1, wall=tuple(0.1 * x for x in astuple(HUMAN))
    )
    truth = dict(zip(mouse.parameter_names, mouse.centre.tolist(), strict=True))
    run = Run("left_ventricle", observe="volume+nodes:5+length:3:14+strain:fibre:2", truth=truth)
    problem = read_problem(run, scene=mouse)
    volume = problem.observe.parts["volume"].cavity.rest
    assert problem.run.noise["volume"] == pytest.approx(0.03 * volume, rel=0.02)
    assert problem.run.noise["length:3:14"] == pytest.approx(0.03 * mouse.mesh.size, rel=0.02)
    assert (problem.run.noise["displacement"], problem.run.noise["strain"]) == (0.2, 0.02)
    first, second = problem.scaled_noise
    assert first.startswith("volume has the default noise of so small a body (0.")
    assert f"sd {problem.run.noise['volume']:g} mL: give your data's, --noise volume=SD" in first
    assert "--noise length:3:14=SD" in second
    given = read_problem(replace(run, noise={"volume": 1.0, "length:3:14": 0.5}), scene=mouse)
    assert given.scaled_noise == []


@pytest.mark.parametrize("name", BUILT_IN)
def test_built_in_bodies_are_large_enough_for_the_usual_noise(name):
    scene = BUILT_IN[name]()
    words = ["nodes:3", "length:3:14", *(f"volume:{wall}" for wall in cavity_sets(scene))]
    problem = read_problem(Run(name, observe="+".join(words)), scene=scene)
    assert set(problem.run.noise.values()) <= {0.2, 0.5, 1.0}
    assert problem.scaled_noise == []


def test_data_that_its_own_noise_makes_impossible_blames_the_noise(ventricle):
    truth = dict(zip(ventricle.parameter_names, ventricle.centre.tolist(), strict=True))
    run = Run("left_ventricle", observe="volume", truth=truth, noise=5000.0, seed=4)
    said = r"synthetic, of too much noise \(--noise\): data: volume is -.* mL; it must be above 0"
    with pytest.raises(InputError, match=said):
        make_data(run, ventricle)
