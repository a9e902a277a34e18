"""Times and errors of every method on larger meshes."""

from typing import Any

import numpy as np
from studies.few_runs.accuracy import Court, design, scene_of, seconds
from studies.few_runs.methods import clock, fit_rival, our_campaign

from emulator.surrogates.discrepancy import fit_discrepancy


def mesh_case(shape: tuple[int, int, int], runs: int, tests: int, order: int) -> dict[str, Any]:
    """Times and errors of the left ventricle on one mesh."""
    scene = scene_of("left_ventricle", shape)
    thetas = design(scene, runs)
    series, ours, expanded, elapsed = our_campaign(scene, thetas, order)
    court = Court(scene, tests, series)
    base = court.predict(series)
    begin = clock()
    fitted = fit_discrepancy(scene, ours, series, series)
    fit_s = clock() - begin
    begin = clock()
    alone = fit_discrepancy(scene, ours, series)
    alone_s = clock() - begin
    rival = fit_rival(scene, ours)
    with_sensitivities = np.median(np.diff(elapsed[1:], axis=0), axis=0)  # the first two compile
    case = {
        "name": f"left_ventricle, {len(scene.mesh.nodes)} nodes",
        "status": "done",
        "kind": "mesh",
        "shape": list(shape),
        "nodes": len(scene.mesh.nodes),
        "tetrahedra": len(scene.mesh.elements),
        "runs": runs,
        "tests": tests,
        "series_s": seconds(expanded),
        "campaign_s": seconds(elapsed[-1]),
        "compile_fem_s": seconds(court.compile_s),
        "run_s": seconds(court.run_s),
        "run_with_slopes_s": seconds(with_sensitivities),
        "fit_s": seconds(fit_s),
        "fit_no_mean_s": seconds(alone_s),
        "series": court.errors(base),
        "residual over the series": court.errors(base + court.predict(fitted)),
        "residual, no mean": court.errors(court.predict(alone)),
        "POD + GP": court.errors(court.predict(lambda x: rival(scene.from_unit(x)))),
    }
    print(
        f"{case['name']:40s} run {case['run_s']['processor']:.2f} s  with slopes "
        f"{case['run_with_slopes_s']['processor']:.2f} s  series "
        f"{case['series_s']['processor']:.1f} s, err_u {case['series']['err_u_mm']['median']:.1e}",
        flush=True,
    )
    return case
