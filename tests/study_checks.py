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


def fem_speed(results):
    cases = {case["name"]: case for case in results["cases"]}
    assert cases["scikit-fem + SciPy, cold"]["difference"] <= 1e-6
    assert cases["ten increments"]["gradient_error"] < 1e-6
    assert cases["cube, 4 cells an edge"]["nodes"] == 125


def inverse_benchmark(results):  # the study feeds its scorer wrong draws
    entries = {case["entry"]: case for case in results["cases"] if "entry" in case}
    assert {"emulator, NUTS", "emulator, emcee", "emulator, Laplace"} <= set(entries)


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
        fem_speed,
        inverse_benchmark,
        released_networks,
        sbc,
        stability,
        silicone_beam,
        verification,
    )
}
