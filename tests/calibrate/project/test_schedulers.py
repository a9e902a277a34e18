"""FEM on a cluster of two workers gives the numbers of this process."""

import json

import numpy as np
import pytest

import calibrate as cal
import emulator as em
from calibrate.analysis.sbc import sbc
from calibrate.certificate import examine
from calibrate.cli import main
from cli_support import write_block

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def address():
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=":0"
    ) as cluster:
        yield cluster.scheduler_address


@pytest.fixture(scope="module")
def fem(beam, simulator):
    return em.fem_forward(simulator)


@pytest.fixture(scope="module")
def observe(beam):
    return cal.nodal_displacements(beam, [3, 11, 20, 30])


def test_a_certificate(beam, simulator, observe, address):
    posterior = posterior_of(beam, simulator, observe)
    here, there = (
        examine(posterior, simulator, draws=40, scheduler=where) for where in (None, address)
    )
    np.testing.assert_array_equal(here.pool.z, there.pool.z)
    np.testing.assert_allclose(here.tests.runs.fem, there.tests.runs.fem, rtol=1e-9)
    assert here.certificate.verdict == there.certificate.verdict
    for name, shift in here.certificate.to_json()["shift"].items():
        assert there.certificate.to_json()["shift"][name] == pytest.approx(shift, abs=1e-6)


def posterior_of(beam, simulator, observe):
    """From a series about the centre, which FEM corrects a little."""
    from emulator.surrogates.emulator import Emulator
    from emulator.surrogates.taylor import expand

    forward = Emulator(beam, taylor=expand(simulator, order=2)).cache()
    noise = cal.GaussianNoise(sd=0.2)
    truth = np.asarray(simulator(beam.centre))[observe.nodes]
    data = truth + np.random.default_rng(0).normal(0.0, 0.2, truth.shape)
    options = cal.NUTSOptions(warmup=100, draws=150, chains=2, rounds=1)
    return cal.sample(cal.model(forward, observe, noise), data, options=options)


@pytest.mark.parametrize("method", ["sobol", "derivatives"])
def test_sensitivity(fem, observe, address, method):
    here, there = (
        cal.sensitivity(fem, observe, method=method, samples=8, scheduler=where)
        for where in (None, address)
    )
    for name, values in here["displacement"].to_dataset().items():
        np.testing.assert_allclose(there["displacement"][name], values, rtol=1e-6, atol=1e-9)


def test_simulation_based_calibration(fem, observe, address):
    model = cal.model(fem, observe, cal.GaussianNoise(sd=0.2))

    def draw(data, seed):
        rng = np.random.default_rng(seed)
        size = float(np.mean(data["displacement"]))
        return {name: rng.normal(60.0 + size, 5.0, 99) for name in model.names}

    cheap = cal.model(posterior_free(fem.scene), observe, cal.GaussianNoise(sd=0.2))
    here, there = (
        sbc(cheap, 20, truth=model, draw=draw, scheduler=where) for where in (None, address)
    )
    for name, ranks in here.ranks.items():
        np.testing.assert_allclose(there.ranks[name], ranks, atol=1e-9)


def posterior_free(scene):
    from linear_support import linear_forward

    return linear_forward(scene, size=0.05)


def test_on_the_command_line(tmp_path, address, capsys):
    scene = write_block(tmp_path)
    words = ["sensitivity", str(scene), "--observe", "landmarks:3", "--forward", "fem"]
    words += ["--samples", "4", "--json"]
    told = []
    for more in ([], ["--scheduler", address]):
        assert main([*words, *more]) == 0
        told.append(json.loads(capsys.readouterr().out)["displacement"])
    np.testing.assert_allclose(told[0]["total"], told[1]["total"], rtol=1e-6, atol=1e-9)
    run = ["infer", str(scene), "--truth", "mu=9", "--observe", "landmarks:6", "--noise", "0.02"]
    run += ["--forward", "reduced", "--fem-runs", "8", "--warmup", "100", "--draws", "100"]
    assert main([*run, "--no-certify", "--out", str(tmp_path / "r")]) == 0
    capsys.readouterr()
    told = []
    for more in ([], ["--scheduler", address]):
        main(["certify", str(tmp_path / "r"), "--draws", "30", "--json", *more])
        told.append(json.loads(capsys.readouterr().out))
    assert told[0]["verdict"] == told[1]["verdict"]
    assert told[0]["k_hat"] == pytest.approx(told[1]["k_hat"], abs=1e-6)
    check = ["check", "sbc", str(scene), "--observe", "landmarks:3", "--noise", "0.02"]
    check += ["--forward", "reduced", "--fem-runs", "8", "--fem-data", "--replicates", "20"]
    check += ["--warmup", "50", "--draws", "100", "--chains", "1", "--json"]
    told = []
    for name, more in (("here", []), ("there", ["--scheduler", address])):
        main([*check, *more, "--out", str(tmp_path / name)])
        told.append(json.loads(capsys.readouterr().out)["ranks"])
    for name, ranks in told[0].items():
        np.testing.assert_allclose(told[1][name], ranks, atol=0.02)
