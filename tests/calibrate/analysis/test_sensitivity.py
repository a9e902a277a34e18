"""Sensitivity of a forward map's observations, in Python and on the command line."""

from __future__ import annotations

import json
from pathlib import Path

import meshio
import numpy as np
import pytest
import xarray as xr

import calibrate as cal
import emulator as em
from calibrate.analysis.sensitivity import FIELD
from calibrate.cli import main
from calibrate.measurements import parse_observation
from calibrate.priors import Population
from emulator.core.errors import InputError
from emulator.surrogates.fem import fem_forward
from emulator.surrogates.protocol import ForwardMap


@pytest.fixture(scope="module")
def forward() -> ForwardMap:
    return em.load("once_clamped_beam").cache()


def tip(forward: ForwardMap):
    return parse_observation(forward.scene, "nodes:4", 0)


@pytest.mark.slow
def test_emulator_and_fem_agree_on_one_design(forward: ForwardMap) -> None:
    by_emulator = cal.sensitivity(forward, tip(forward), samples=8)
    by_fem = cal.sensitivity(fem_forward(em.Simulator(forward.scene)), tip(forward), samples=8)
    one, other = (found["displacement"] for found in (by_emulator, by_fem))
    for name in ("first_together", "total_together"):
        assert np.allclose(one[name], other[name], atol=1e-4)
    assert by_fem.attrs["forward"] == "FEM"
    assert one.attrs["unit"] == "mm"


@pytest.mark.slow
def test_fem_s_slopes_are_those_of_its_factors(forward: ForwardMap) -> None:
    both = (forward, fem_forward(em.Simulator(forward.scene)))
    one, other = (
        cal.sensitivity(map_, tip(forward), method="derivatives", samples=8, field=True)
        for map_ in both
    )
    for name in ("displacement", FIELD):
        bounds = [found[name]["bound_on_total_together"] for found in (one, other)]
        assert np.allclose(*bounds, rtol=1e-6)


def test_the_field_node_by_node(forward: ForwardMap) -> None:
    found = cal.sensitivity(forward, field=True, samples=16)[FIELD]
    scene = forward.scene
    assert found.sizes["output"] == len(scene.mesh.nodes)
    assert np.array_equal(found["output"], np.arange(len(scene.mesh.nodes)))
    held = scene.held.all(axis=1)
    assert np.isnan(found["total"][:, held]).all()
    assert np.isfinite(found["total"][:, ~held]).all()


def test_derivatives_are_those_of_the_map(forward: ForwardMap) -> None:
    """Its bounds hold, and nodes without freedom have slope zero, not NaN."""
    observe = tip(forward)
    total = cal.sensitivity(forward, observe, samples=64)["displacement"]["total_together"]
    found = cal.sensitivity(forward, observe, method="derivatives", samples=64, field=True)
    bound = found["displacement"]["bound_on_total_together"]
    assert (bound.values > total.values).all()
    assert np.isfinite(found[FIELD]["nu"]).all()


def test_what_has_no_indices(forward: ForwardMap) -> None:
    names = forward.scene.parameter_names
    population = Population(
        dict.fromkeys(names, 70.0), dict.fromkeys(names, 0.05), {",".join(names): 0.5}
    )
    from dataclasses import asdict

    from calibrate.priors import prior_of

    prior = prior_of(asdict(population), forward.scene)
    with pytest.raises(InputError, match="the prior correlates mu, lam"):
        cal.sensitivity(forward, tip(forward), prior=prior)
    with pytest.raises(InputError, match="give something to observe"):
        cal.sensitivity(forward)
    several = parse_observation(forward.scene, "nodes:4@a+nodes:4@b", 0)
    with pytest.raises(InputError, match="several load states"):
        cal.sensitivity(forward, several)


def test_on_the_command_line(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    words = ["sensitivity", "once_clamped_beam", "--observe", "nodes:4", "--field"]
    words += ["--samples", "16", "--out", str(tmp_path / "new" / "folder"), "--json"]
    assert main(words) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["displacement"]["evaluations"] == 16 * 4
    assert sum(report["displacement"]["first_together"]) == pytest.approx(1.0, abs=0.2)
    folder = tmp_path / "new" / "folder"
    tree = xr.open_datatree(folder / "sensitivity.nc", engine="h5netcdf")
    assert tree["field"]["total"].shape == (2, 1025)
    written = meshio.read(folder / "sensitivity.vtu")
    assert {"first mu", "total lam"} <= set(written.point_data)
    assert (folder / "sensitivity.png").stat().st_size > 10_000
    assert (folder / "sensitivity_on_body.png").stat().st_size > 10_000


@pytest.mark.parametrize("method", ["morris", "derivatives"])
def test_other_methods_in_words(method: str, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["sensitivity", "once_clamped_beam", "--observe", "nodes:4", "--method", method]
    assert main([*words, "--samples", "8"]) == 0
    out = capsys.readouterr().out
    assert "mu" in out
    assert "displacement (12 numbers, mm)" in out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "give something to observe"),
        (["--observe", "volume"], "has 0 cavities"),
        (["--observe", "nodes:4", "--samples", "10"], "a power of two"),
        (["--observe", "nodes:4", "--group", "mu"], "write NAME=A,B"),
        (["--observe", "nodes:4", "--group", "all=mu,x"], "'x' is none of mu, lam"),
        (["--observe", "nodes:4", "--group", "all=mu,lam"], "'all' has them all, so that nothing"),
        (
            ["--observe", "nodes:4", "--group", "all=mu,lam", "--method", "morris"],
            "'all' has them all, so that nothing",
        ),
    ],
)
def test_bad_words(words: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sensitivity", "once_clamped_beam", *words]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
