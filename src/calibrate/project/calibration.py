"""One calibration from start to end: read, model, sample, save; then certify and report."""

from __future__ import annotations

import json
from concurrent.futures import Executor
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from calibrate.certificate import Certificate, examine
from calibrate.certificate.reweighting import can_reweight, reweighted
from calibrate.measurements.labels import missing_places
from calibrate.posterior import Posterior, sample
from calibrate.posterior.diagnosis import MAP_ERRORS, MAP_MOVES, ROUNDS_RECORD, SCALED_NOISE
from calibrate.project.problem import Problem, build_model, read_problem, simulator_of, with_data
from calibrate.project.results import (
    CERTIFICATE,
    SAMPLING,
    SOLUTIONS,
    remove_pages,
    reserved,
    save_results,
    save_reweighted,
)
from calibrate.project.rounds import account_of, by_rounds, keep_for_later, taught_map
from calibrate.project.run import Run
from calibrate.project.stated_priors import stated_priors
from calibrate.provenance import as_attributes
from calibrate.state_names import split
from calibrate.statistical_model.errors import NOT_ASKED, map_errors
from emulator.core.display import Stages
from emulator.core.errors import InputError
from emulator.core.rooms import offered
from emulator.core.store import write_json
from emulator.fem import Simulator
from emulator.scenes.scene import Scene
from emulator.surrogates.fem import FEMForward

NOT_CERTIFIED = "not certified"
SECONDS = "seconds"  # attribute of a posterior: the seconds of each stage, as JSON


def infer(
    run: Run | Problem,
    folder: str | Path | None = None,
    *,
    force: bool = False,
    check_map: bool = True,
    executor: Executor | None = None,
    deadline: float = np.inf,
    progress: bool = False,
) -> Posterior:
    """Sample the posterior of a run.

    Parameters
    ----------
    run : the run, or the problem that it was read as.
    folder : the folder to write run, data and posterior to (:mod:`calibrate.project.results`). A
        run into a folder that was killed while sampling continues there.
    force : replace the results of an earlier run in ``folder``.
    check_map : whether a few Newton steps tell how far the forward map is from what is observed;
        a certificate says so, too, and better.
    executor : the executor that does FEM (:mod:`emulator.core.engine`), or the run's ``engine``.
    deadline : the value of ``time.perf_counter`` by which rounds of FEM runs that teach a map end,
        whether or not they foresee FEM.

    Raises
    ------
    InputError
        ``folder`` has the results of an earlier run, or another process is writing to it; the run
        does not fit its scene or its data.
    """
    if not isinstance(run, Run | Problem):
        raise InputError(
            f"infer: {type(run).__name__} is not one run; calibrate infer FILE takes members of a "
            "population, and calibrate.population.hierarchy their models"
        )
    target, stages = None if folder is None else Path(folder), Stages(show=progress)
    checkpoint, solutions = (target and target / name for name in (SAMPLING, SOLUTIONS))
    with nullcontext() if target is None else reserved(target, force=force):
        with stages("scene and data"):
            problem = with_data(replace(by_rounds(read_problem(run)), executor=executor))
        with stages("forward map and model"):
            forward = taught_map(problem, keep=solutions, deadline=deadline, progress=progress)
            model, data = build_model(problem, forward, progress=progress)
        sampler, options = problem.run.sampling()
        with stages("sampling"):
            posterior = sample(
                model,
                data,
                sampler=sampler.name,
                options=options,
                seed=problem.run.seed,
                progress=progress,
                checkpoint=checkpoint,
            )
        errors = NOT_ASKED
        # The states of a specimen, which has no mesh, are solved; rounds have tested their map.
        is_exact = not isinstance(problem.scene, Scene) or isinstance(model.full, FEMForward)
        if check_map and forward is None and not is_exact:
            with stages("check of the map"):
                simulator = cast(Simulator, problem.simulator)
                errors = map_errors(posterior.model, simulator, posterior.draws(), posterior.data)
        attributes = {
            SCALED_NOISE: problem.scaled_noise, MAP_ERRORS: errors.sizes, MAP_MOVES: errors.moves,
            SECONDS: stages.seconds, **account_of(model.full),
        }  # fmt: skip
        posterior.tree.attrs.update(as_attributes(attributes))
        if target is not None:
            save_results(target, problem, posterior)
            keep_for_later(target / SOLUTIONS, posterior)
    return posterior


def certify_and_keep(
    posterior: Posterior,
    folder: str | Path,
    *,
    load_steps: int = 1,
    executor: Executor | str = "threads",
    reweight_to: str | Path | None = None,
    progress: bool = False,
    **options: Any,
) -> Certificate:
    """Check a posterior against FEM and write ``certificate.json``.

    What FEM says of the map is then said by the posterior's own warnings, too.

    Parameters
    ----------
    folder : the folder of the posterior.
    load_steps, executor : load steps of every solve, and what does the solves, as of :func:`infer`.
    reweight_to : the folder that the reweighted posterior is written to, ready to be certified in
        its turn, where the verdict allows it.
    progress : whether progress bars, and the seconds of each stage, are shown.
    options : the numbers of FEM runs, and where they are solved, as of
        :func:`calibrate.certificate.examine`, with its errors.
    """
    stages, scene = Stages(show=progress), posterior.model.forward.scene
    if not scene.has_solver:
        (examine_rows,) = offered("calibrate.external.by_rows", "examine_rows")
        of_rows: Certificate = examine_rows(posterior, Path(folder))
        write_json(Path(folder) / CERTIFICATE, of_rows.to_json())
        remove_pages(Path(folder).resolve())
        return of_rows
    with stages("simulator"):
        simulator = simulator_of(scene, load_steps, executor)
    check = examine(posterior, simulator, stages=stages, progress=progress, **options)
    write_json(Path(folder) / CERTIFICATE, check.certificate.to_json())
    errors = check.certificate.evidence.map_errors
    seconds = json.loads(posterior.tree.attrs.get(SECONDS, "{}")) | stages.seconds
    # The certificate tells the moves with their errors, so the estimate goes.
    attributes = {MAP_ERRORS: errors, MAP_MOVES: np.nan, SECONDS: seconds}
    posterior.tree.attrs.update(as_attributes(attributes))
    remove_pages(Path(folder).resolve())
    if reweight_to is not None and can_reweight(check.certificate):
        save_reweighted(reweighted(check), Path(folder), Path(reweight_to))
    return check.certificate


def report(run: Run, posterior: Posterior, certificate: Certificate | None) -> dict[str, Any]:
    """Return the result as plain JSON: parameter table, diagnostics, verdict."""
    table = posterior.summary()
    for name, row in table.items() if run.is_synthetic else ():
        if (value := run.truth.get(name, run.truth.get(split(name)[0]))) is not None:
            row["truth"] = value
    for name, owed in posterior.reliance().items():
        table[name] |= owed._asdict()
    result: dict[str, Any] = {
        "scene": run.scene,
        "forward": run.forward,
        "map": posterior.model.full.label,
        "parameters": table,
        "priors": stated_priors(run, posterior.model),
        "divergences": posterior.divergences,
        "verdict": NOT_CERTIFIED,
        "k_hat": None,
        "prior_cut": dict(posterior.model.prior_cut),
        "missing": missing_places(posterior.model.observe),
        "draws": int(posterior.tree["posterior"].sizes["draw"]),
        "chains": int(posterior.tree["posterior"].sizes["chain"]),
        "warnings": posterior.warnings(),
        "seconds": json.loads(posterior.tree.attrs.get(SECONDS, "{}")),
    }
    if ROUNDS_RECORD in posterior.tree.attrs:
        result[ROUNDS_RECORD] = json.loads(posterior.tree.attrs[ROUNDS_RECORD])
    if "log_evidence" in posterior.tree.attrs:
        result["log_evidence"] = posterior.tree.attrs["log_evidence"]
        result["log_evidence_error"] = posterior.tree.attrs.get("log_evidence_error")
    if certificate is not None:
        result.update(verdict=certificate.verdict, k_hat=certificate.k_hat)
        result["certificate"] = certificate.to_json()
    return result
