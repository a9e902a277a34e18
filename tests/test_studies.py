"""Studies run from a clean clone with one command, which asserts its claims; here on a few cases.

A new study is its folder and a line in ``QUICK``; ``CHECKS`` may say more of its results.
"""

import importlib
import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import emulator as em
from emulator.fem.energy import strain_energy
from study_checks import CHECKS

STUDIES = Path(__file__).parents[1] / "studies"
QUICK = {
    "accuracy_vs_time": "--quick",
    "beam_coverage": "PUBLISHED --cases 2",
    "biaxial": "--quick",
    "blind": "--data MEASURED --quick",
    "blood_clots": "--data MEASURED/blood_clots --quick",
    "cardiac_cycle": "--quick",
    "certificate": "--quick",
    "cohorts": "--data MEASURED --quick",
    "fem_speed": "--quick",
    "filling_rates": "--quick",
    "human_heart": "--data MEASURED/human_heart --quick",
    "human_myocardium": "--data MEASURED/myocardium_tables --quick",
    "imaged_heart": "--quick",
    "inverse_benchmark": "--quick",
    "living_skin": "--data MEASURED/living_skin --quick",
    "mesh_row": "--quick",
    "mesh_to_certificate": "--quick",
    "muscle": "--data MEASURED/muscle --quick",
    "networks_alone": "--quick",
    "no_box": "--quick",
    "released_networks": "--quick --published PUBLISHED",
    "sbc": "--replicates 20 --only map",
    "sheep_myocardium": "--data MEASURED/ovine_myocardium --quick",
    "silicone_beam": "--data MEASURED/silicone_beam --quick",
    "stability": "--workers 1 --cases theta_zero_inside_jit theta_too_short pushed_through_itself "
    "squeezed_to_half elements_10000_to_1 springs_1e12 twist_360_from_rest laplace_two_modes float32_once_clamped_beam "
    "outside_by_half_once_clamped_beam",
    "tables": "--quick",
    "terms": "--quick",
    "any_ventricle": "--quick",
    "verification": "--quick",
}


def run(name: str, *words: object) -> dict:
    out = words[words.index("--out") + 1]
    command = [sys.executable, "-m", f"studies.{name}", *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=STUDIES.parent)
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads((Path(out) / "results.json").read_text())


@pytest.mark.parametrize(
    "folder", sorted(p.parent for p in STUDIES.glob("*/__main__.py")), ids=lambda p: p.name
)
def test_every_study_is_complete(folder):
    results = json.loads((folder / "results.json").read_text())
    assert {"hardware", "versions", "commit", "seed", "cases"} <= set(results)
    assert all({"name", "status"} <= set(case) for case in results["cases"])
    readme = (folder / "README.md").read_text()
    assert list(folder.glob("*.png"))
    for figure in folder.glob("*.png"):
        assert figure.name in readme


def test_every_study_has_a_line():
    assert {path.parent.name for path in STUDIES.glob("*/__main__.py")} == set(QUICK)
    assert set(CHECKS) <= set(QUICK)


# Figures that need more than the few cases.
FULL_ONLY = {
    "accuracy_vs_time": {"posteriors.png", "released.png"},
    "sbc": {"beam.png", "ventricle.png", "specimen.png", "relaxing.png", "noise.png", "prior.png"},
}


PEERS = {"cardiac_cycle": "gmsh", "human_heart": "gmsh"}
"""Packages that a study compares with or meshes by, which a developer need not have."""


def _given(word: str, given: dict[str, str]) -> str:
    """A word of a command with its first folder put in."""
    first, slash, rest = word.partition("/")
    return f"{given.get(first, first)}{slash}{rest}"


@pytest.mark.slow
@pytest.mark.parametrize("name", QUICK)
def test_a_few_cases(name, tmp_path, request):
    if name in PEERS:
        pytest.importorskip(PEERS[name], reason=f"{PEERS[name]} is not installed")
    given = {"ABSENT": str(tmp_path / "absent")}
    for folder in ("PUBLISHED", "MEASURED"):
        if folder in QUICK[name]:
            given[folder] = str(request.getfixturevalue(folder.lower()))
    words = [_given(word, given) for word in QUICK[name].split()]
    results = run(name, *words, "--out", tmp_path)
    CHECKS.get(name, lambda _: None)(results)
    drawn = {path.name for path in (STUDIES / name).glob("*.png")} - FULL_ONLY.get(name, set())
    for figure in drawn:
        assert (tmp_path / figure).stat().st_size > 10_000


@pytest.mark.slow
def test_a_hang_in_stability_is_recorded_and_loses_nothing(tmp_path):
    out = ("--workers", 1, "--limit", 0.01, "--out", tmp_path)
    with pytest.raises(AssertionError, match="hangs or exceptions"):
        run("stability", "--cases", "theta_too", *out)
    cases = json.loads((tmp_path / "results.json").read_text())["cases"]
    assert [case["status"] for case in cases] == ["hang", "hang"]


def the_judge():
    """The module ``judge`` of the study of stability."""
    spec = importlib.util.spec_from_file_location("judge", STUDIES / "stability" / "judge.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
def test_the_judge_of_stability_finds_wrong_answers(beam, simulator):
    module = the_judge()
    u = np.asarray(simulator(beam.centre))
    theta = np.asarray(beam.centre)
    right = module.judge(beam, u, theta)
    assert right.wrong == ""
    assert right.independent
    assert right.residual < 1e-8
    assert "residual" in module.judge(beam, 1.001 * u, theta).wrong
    assert not module.is_round_off(beam, 1.001 * u, theta)
    assert "residual" in module.judge(beam, u, 1.001 * theta).wrong
    assert "support" in module.judge(beam, u + 1e-15, theta).wrong
    assert "J = " in module.judge(beam, -2.0 * beam.mesh.nodes, theta).wrong
    assert "finite" in module.judge(beam, np.nan * u, theta).wrong
    assert module.judge(beam, u, theta, "a claim that fails").wrong == "a claim that fails"


@pytest.mark.parametrize("order", [1, 2])
def test_the_judge_of_stability_has_fibres_where_the_scene_has_them(order):
    """Its quadrature points are listed in another order than the scene's."""
    judge = the_judge()
    scene = em.scenes.left_ventricle(3, 6, 1, order=order)
    u = 0.1 * np.random.default_rng(0).normal(size=scene.held.shape)
    own = judge.internal_force(scene, u, scene.centre)
    ours = jax.grad(strain_energy(scene))(jnp.asarray(u), scene.centre)
    np.testing.assert_allclose(own, ours, atol=1e-12 * np.abs(ours).max())


def test_the_benchmarks_distance_of_a_shift():
    """Along e a shift d moves all draws by e . d, whose mean size over the circle is 2 |d| / pi."""
    from studies.inverse_benchmark.score import sliced
    from studies.inverse_benchmark.tables import Table

    draws, weights = np.random.default_rng(0).normal(size=(300, 2)), np.arange(1.0, 301.0)
    table = Table(draws, weights / weights.sum())
    assert sliced(table, table) == 0.0
    moved = table._replace(draws=draws + [3.0, 4.0])
    assert sliced(table, moved) == pytest.approx(10.0 / np.pi, rel=0.1)
    twice = Table(np.repeat(draws, np.arange(1, 301), axis=0), np.full(45150, 1 / 45150))
    assert sliced(table, twice) == pytest.approx(0.0, abs=1e-12)


def test_cases_that_are_there_are_not_repeated(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(STUDIES.parent))
    from studies.common.output import Results

    made = []
    case = lambda name: lambda: made.append(name) or {"value": len(made)}
    Results(tmp_path, 0, settings={"n": 1}).case("a", case("a"))
    again = Results(tmp_path, 0, settings={"n": 1})
    assert again.case("a", case("a")) == {"name": "a", "status": "done", "value": 1}
    again.case("b", case("b"))
    assert made == ["a", "b"]
    # Cases of other settings are not these, and one may ask for all of them again.
    Results(tmp_path, 0, settings={"n": 2}).case("a", case("a"))
    Results(tmp_path, 0, settings={"n": 2}, again=True).case("a", case("a"))
    assert made == ["a", "b", "a", "a"]


def test_the_stress_of_a_strip_of_muscle_is_the_slope_of_its_energy():
    measured = importlib.import_module("studies.imaged_heart.measured")
    a, b, a_f, b_f = 0.35, 2.2, 4.5, 2.5

    def energy(stretch):
        """Of a strip that keeps its volume."""
        F = jnp.diag(jnp.array([stretch, stretch**-0.5, stretch**-0.5]))
        C = F.T @ F
        matrix = 0.5 * a / b * jnp.expm1(b * (jnp.trace(C) - 3.0))
        return matrix + 0.5 * a_f / b_f * jnp.expm1(b_f * (C[0, 0] - 1.0) ** 2)

    assert measured.fibre_stress(a, b, a_f, b_f) == pytest.approx(float(jax.grad(energy)(1.1)))
