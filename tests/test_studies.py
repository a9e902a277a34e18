"""Studies run from a clean clone with one command; here on a few cases.

A new study is its folder and a line in ``QUICK``; ``CHECKS`` may say more of its results.
"""

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

STUDIES = Path(__file__).parents[1] / "studies"
QUICK = {
    "accuracy_vs_time": "--quick",
    "beam_coverage": "PUBLISHED --cases 2",
    "campaign": "--quick",
    "certificate": "--quick",
    "decoder_speed": "--quick",
    "effects": "--quick",
    "error_bar": "--scenes once_clamped_beam --cases 3 --outside 1",
    "fem_posterior": "--quick",
    # No dolfin here: compiling its forms alone takes longer than all the rest.
    "fem_speed": "--quick --fenics-python ABSENT",
    "few_runs": "--parts left_ventricle --mesh 4 8 1 --runs 1 5 --tests 3 --order 1",
    "inverse_benchmark": "--quick",
    "large_meshes": "--quick",
    "many_solves": "--solves 3",
    "mesh_to_certificate": "--ventricles 1 --mesh 5 10 1",
    "networks_alone": "--quick",
    "new_ventricle": "--ventricles 1 --runs 8 --tests 3",
    "objectives": "--quick",
    "poor_emulators": "--quick",
    "published_pressure": "--quick",
    "released_networks": "--quick --published PUBLISHED",
    "sbc": "--replicates 20 --only map",
    "sensitivity": "--quick",
    "stability": "--workers 1 --cases theta_zero_inside_jit theta_too_short pushed_through_itself "
    "squeezed_to_half laplace_two_modes float32_once_clamped_beam "
    "outside_by_half_once_clamped_beam",
    "ventricle_family": "--quick",
    "verification": "--quick",
    "transfer": "--quick --one --family 2 --pretrain 6 --steps 3 --longest 4 --runs 3 --tests 2",
}
FAST: tuple[str, ...] = ()


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


def accuracy_vs_time(results):  # the study asserts its fronts
    cases = {case["rung"]: case for case in results["cases"]}
    names = ("network alone", "emulator, full field", "emulator + 1 Newton step")
    network, emulator, polished = (cases[name]["own_mm"]["median"] for name in names)
    assert polished < 0.01 * emulator < 1e-4 * network


def certificate(results):
    verdicts = {case["name"]: case["status"] for case in results["cases"]}
    assert verdicts["five, constant 0, seed 0"] == "accepted"
    assert verdicts["five, constant 1, seed 0"] == "reweight"
    assert verdicts["modes, stuck 1, seed 0"] != "accepted"


def decoder_speed(results):  # the study asserts equal gradients
    cases = {case["name"]: case for case in results["cases"]}
    assert 20 < cases["emulator"]["observed_nodes"] < cases["emulator"]["nodes"]
    assert cases["twisting cube, 27 nodes"]["landmark_nodes"] <= 27
    assert results["summary"]["times_faster_than_fem"] > 1.0


def effects(results):
    cases = {case["effect"]: case for case in results["cases"]}
    assert set(cases) == {"", "gravity", "quadratic elements"}
    assert cases[""]["changes"]["displacement"] == 0.0
    assert 0.0 < cases["gravity"]["changes"]["displacement"] < 1.0


def error_bar(results):
    cases = {case["name"]: case for case in results["cases"]}
    inside = cases["once_clamped_beam, shipped 'once_clamped_beam', inside"]
    assert inside["effectivity"]["error bar"]["within_factor_2"] == 1.0
    assert cases["once_clamped_beam, reduced, 5 FEM runs, 50 % outside"]["theta"] == 4


def fem_posterior(results):
    (case,) = results["cases"]
    runs = {run["method"]: run for run in case["runs"]}
    assert case["largest_shift"][0] < 1e-5
    assert runs["emulator + certificate"]["fem_solves"] == 30
    # Two chains: their starts, discarded draws, and at most four rounds.
    assert runs["delayed acceptance"]["fem_solves"] <= 2 * (1 + 20 + 4 * 20)
    # Gradients are counted in warm-up, too.
    tuned = runs["FEM-NUTS, tuned by the emulator"]
    assert tuned["fem_solves"] > tuned["kept_fem_solves"] > 20


def fem_speed(results):
    cases = {case["name"]: case for case in results["cases"]}
    assert cases["scikit-fem + SciPy, cold"]["difference"] <= 1e-6
    assert cases["FEniCS, cold"]["status"].startswith("skipped")
    assert cases["cube, 4 cells an edge"]["nodes"] == 125


def few_runs(results):
    errors = {(c["method"], c["runs"]): c["err_u_mm"]["median"] for c in results["cases"]}
    ratio = results["summary"]["left_ventricle"]["residual over the series / POD + GP"]["5"]
    assert ratio == errors["residual over the series", 5] / errors["POD + GP", 5] < 1.0 / 3.0
    assert 0.0 < errors["Taylor series", 1] < 0.2


def inverse_benchmark(results):  # the study feeds its scorer wrong draws
    entries = {case["entry"]: case for case in results["cases"] if "entry" in case}
    assert {"emulator, NUTS", "emulator, emcee", "emulator, Laplace"} <= set(entries)


def large_meshes(results):
    linear, quadratic = results["cases"]
    assert linear["from_rest"]["status"] == quadratic["from_rest"]["status"] == "converged"
    assert 0.0 < linear["share_of_factorisation"] < 1.0


def many_solves(results):
    assert [case["status"] for case in results["cases"]] == ["converged"] * 3
    assert results["summary"]["solves"] == 3


def new_ventricle(results):
    (case,) = results["cases"]
    assert case["fem_runs"] == 9
    assert case["err_V"]["median"] < 0.1


def objectives(results):
    cases = {case["name"]: case for case in results["cases"]}
    trained = [cases[name] for name in ("simulations", "gradients", "energy", "both")]
    assert {case["steps"] for case in trained} == {60}
    assert [case["fem_runs"] for case in trained] == [17, 17, 1, 17]
    start = cases["the centre's solution"]
    assert cases["gradients"]["err_F"]["median"] < start["err_F"]["median"]


def poor_emulators(results):
    cases = {case["name"]: case for case in results["cases"]}
    taken = cases["coarse, 1 run, 1st order, taken as exact"]
    learned = cases["coarse, 1 run, 1st order, error learned"]
    assert learned["error_runs"] == 24
    assert learned["width_median"] > taken["width_median"]
    assert learned["shift_in_own_sd_rms"] < taken["shift_in_own_sd_rms"]


def published_pressure(results):
    cases = {(case["load"], case["observed"]): case for case in results["cases"]}
    assert len(cases) == 2
    displaced = "24 landmarks and volume at 8 mmHg"
    a = {load: cases[load, displaced]["parameters"]["a"]["mean"] for load in ("exact", "published")}
    assert a["published"] > a["exact"]


def released_networks(results):
    models = {row["model"]: row for row in results["models"]}
    assert len(models) == 3
    assert max(row["off_the_released_code"] for row in models.values()) < 1e-6
    assert models["TwistingBeam"]["err_u_stored_mm"] == pytest.approx(9.4e-5, abs=0.05e-5)
    network, ours = results["cases"]
    shifts = [max(abs(v) for v in row["shift_sd"].values()) for row in (network, ours)]
    assert shifts[0] > shifts[1]


def sbc(results):
    (case,) = results["cases"]
    assert case["status"] == "not calibrated"
    assert case["replicates"] == 20


def sensitivity(results):  # the study asserts known indices and FEM's
    cases = {case["name"]: case for case in results["cases"]}
    assert cases["ventricle, FEM"]["volume"]["evaluations"] == 56


def stability(results):
    status = {case["name"]: case["status"] for case in results["cases"]}
    assert status == {
        "theta_zero_inside_jit": "SINGULAR_TANGENT",
        "theta_too_short": "InputError",
        "pushed_through_itself": "INVERTED_ELEMENT",
        "squeezed_to_half": "CONVERGED",
        "laplace_two_modes": "WARNED",
        "float32_once_clamped_beam": "InputError",
        "float32_once_clamped_beam_pignn": "PREDICTED",
        "outside_by_half_once_clamped_beam": "OUTSIDE",
        "outside_by_half_once_clamped_beam_pignn": "OUTSIDE",
    }
    assert results["summary"]["silent_wrong"] == 0


def transfer(results):
    cases = {case["name"]: case for case in results["cases"]}
    assert len(cases) == 8
    # Before any step, from scratch is the centre's solution and a transfer is not.
    scratch, family = (cases[f"from {name}, 0 steps"] for name in ("scratch", "the family"))
    assert scratch["err_u"]["median"] != family["err_u"]["median"]


def verification(results):
    (case,) = results["cases"]
    assert case["sets"] == 10
    assert case["r_hat"]["largest"] < 1.1
    assert 0.0 < case["sd_over_prior"]["mu"] < 0.5


def ventricle_family(results):
    (case,) = results["cases"]
    before, nothing = case["before"]["err_u"], case["one_solution_everywhere"]["err_u"]
    assert before["median"] < nothing["median"]
    assert before["median"] < 0.2 * case["mean_u_mm"]


CHECKS = {
    check.__name__: check
    for check in (
        accuracy_vs_time,
        certificate,
        decoder_speed,
        effects,
        error_bar,
        fem_posterior,
        fem_speed,
        few_runs,
        inverse_benchmark,
        large_meshes,
        many_solves,
        new_ventricle,
        objectives,
        poor_emulators,
        published_pressure,
        released_networks,
        sbc,
        sensitivity,
        stability,
        transfer,
        ventricle_family,
        verification,
    )
}


def test_every_study_has_a_line():
    assert {path.parent.name for path in STUDIES.glob("*/__main__.py")} == set(QUICK)
    assert set(CHECKS) <= set(QUICK)


# Figures that need more than the few cases.
FULL_ONLY = {
    "accuracy_vs_time": {"posteriors.png", "released.png"},
    "few_runs": {"meshes.png"},
    "sensitivity": {"segments.png"},
    "sbc": {"beam.png", "ventricle.png", "noise.png", "prior.png"},
}


@pytest.mark.parametrize(
    "name", [n if n in FAST else pytest.param(n, marks=pytest.mark.slow) for n in QUICK]
)
def test_a_few_cases(name, tmp_path, request):
    given = {"ABSENT": str(tmp_path / "absent")}
    if "PUBLISHED" in QUICK[name]:
        given["PUBLISHED"] = str(request.getfixturevalue("published"))
    words = [given.get(word, word) for word in QUICK[name].split()]
    results = run(name, *words, "--out", tmp_path)
    CHECKS.get(name, lambda _: None)(results)
    drawn = {path.name for path in (STUDIES / name).glob("*.png")} - FULL_ONLY.get(name, set())
    for figure in drawn:
        assert (tmp_path / figure).stat().st_size > 10_000


def test_a_hang_in_stability_is_recorded_and_loses_nothing(tmp_path):
    out = ("--workers", 1, "--limit", 0.01, "--out", tmp_path)
    with pytest.raises(AssertionError, match="hangs or exceptions"):
        run("stability", "--cases", "theta_too", *out)
    cases = json.loads((tmp_path / "results.json").read_text())["cases"]
    assert [case["status"] for case in cases] == ["hang", "hang"]


def test_the_judge_of_stability_finds_wrong_answers(beam, simulator):
    spec = importlib.util.spec_from_file_location("judge", STUDIES / "stability" / "judge.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    u = np.asarray(simulator(beam.centre))
    theta = np.asarray(beam.centre)
    right = module.judge(beam, u, theta)
    assert right.wrong == ""
    assert right.independent
    assert right.residual < 1e-8
    assert "residual" in module.judge(beam, 1.001 * u, theta).wrong
    assert "residual" in module.judge(beam, u, 1.001 * theta).wrong
    assert "support" in module.judge(beam, u + 1e-15, theta).wrong
    assert "J = " in module.judge(beam, -2.0 * beam.mesh.nodes, theta).wrong
    assert "finite" in module.judge(beam, np.nan * u, theta).wrong
    assert module.judge(beam, u, theta, "a claim that fails").wrong == "a claim that fails"


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


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["accuracy_vs_time", "decoder_speed", "error_bar", "few_runs", "stability"]
)
def test_in_full(name, tmp_path):
    run(name, "--out", tmp_path)  # asserts its own claims


@pytest.mark.slow
def test_fem_speed_in_full(tmp_path, published):
    run("fem_speed", "--published", published, "--out", tmp_path)  # asserts its own claims


@pytest.mark.slow
def test_beam_coverage_in_full(tmp_path, published):
    results = run("beam_coverage", published, "--out", tmp_path)
    assert results["summary"]["accepted"] >= 48
    assert all(40 <= hits <= 50 for hits in results["summary"]["covered"].values())
