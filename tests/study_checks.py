"""What the results of each study's few cases must say, beside what the study asserts."""

import pytest


def accuracy_vs_time(results):  # the study asserts its fronts
    cases = {case["rung"]: case for case in results["cases"]}
    for name, field in (("emulator", "emulator, full field"), ("graph network", "graph network")):
        emulator, polished = (
            cases[rung]["own_mm"]["median"] for rung in (field, f"{name} + 1 Newton step")
        )
        assert polished < 0.01 * emulator
        assert emulator < 1e-3
    # Without its cache a network predicts the same.
    uncached = cases["graph network, processor in every call"]["own_mm"]["median"]
    assert abs(uncached / cases["graph network"]["own_mm"]["median"] - 1.0) < 0.05


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
    # Gradients are counted in warm-up, too.
    tuned = runs["FEM-NUTS, tuned by the emulator"]
    assert tuned["fem_solves"] > tuned["kept_fem_solves"] > 20


def fem_speed(results):
    cases = {case["name"]: case for case in results["cases"]}
    assert cases["scikit-fem + SciPy, cold"]["difference"] <= 1e-6
    assert cases["ten increments"]["gradient_error"] < 1e-6
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
    linear, quadratic, *solvers = results["cases"]
    assert {case["solver"] for case in solvers} >= {"CHOLMOD"}
    assert all(case["residual"] < 1e-5 for case in solvers)
    assert linear["from_rest"]["status"] == quadratic["from_rest"]["status"] == "converged"
    assert linear["share_of_factorisation"] > 0.0  # above 1 only by the noise of so small a mesh


def many_solves(results):
    assert [case["status"] for case in results["cases"]] == ["converged"] * 3
    assert results["summary"]["solves"] == 3


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
        "elements_10000_to_1": "CONVERGED",
        "springs_1e12": "CONVERGED",
        "twist_360_from_rest": "CONVERGED",
        "laplace_two_modes": "WARNED",
        "float32_once_clamped_beam_series": "InputError",
        "float32_once_clamped_beam": "PREDICTED",
        "outside_by_half_once_clamped_beam_series": "OUTSIDE",
        "outside_by_half_once_clamped_beam": "OUTSIDE",
    }
    assert results["summary"]["silent_wrong"] == 0


def silicone_beam(results):
    cases = {case["name"]: case for case in results["cases"]}
    whole, naive = cases["all unknown"], cases["as if nothing were unknown"]
    # Upstream's fit of the same recordings, another program's: mu = 88 kPa.
    assert whole["parameters"]["mu"]["low"] < 88.0 < whole["parameters"]["mu"]["high"]
    assert naive["status"] == "done"
    assert naive["verdict"] == "not certified"
    low, middle, high = cases["prediction"]["markers"]["rig where it was"]
    assert all(a[2] < b[2] < c[2] for a, b, c in zip(low, middle, high, strict=True))


def verification(results):
    (case,) = results["cases"]
    assert case["sets"] == 10
    assert case["r_hat"]["largest"] < 1.1
    assert 0.0 < case["sd_over_prior"]["mu"] < 0.5


def any_ventricle(results):
    (case,) = results["cases"]
    assert case["before"]["err_u"]["median"] < 0.2 * case["mean_u_mm"]
    assert case["largest_difference_mm"] < 1e-5


CHECKS = {
    check.__name__: check
    for check in (
        accuracy_vs_time,
        any_ventricle,
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
        poor_emulators,
        published_pressure,
        released_networks,
        sbc,
        sensitivity,
        stability,
        silicone_beam,
        verification,
    )
}
