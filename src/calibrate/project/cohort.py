"""Members of one population from start to end: each by itself, certified, then all together.

The folder of a cohort has ``members/NAME``, a folder of :func:`calibrate.project.infer` for each,
and beside it ``posterior.nc``, the hierarchy of them all (:func:`calibrate.read_hierarchy`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import numpyro.distributions as dist

from calibrate.figures import shrinkage
from calibrate.population import (
    Hierarchy,
    population_model,
    read_hierarchy,
    sample_population,
)
from calibrate.population.sample import TARGET_ACCEPT
from calibrate.posterior import Posterior
from calibrate.priors import log_normal
from calibrate.project.experiment import POPULATION, Cohort, Shared
from calibrate.project.restore import is_of
from calibrate.project.run import Run
from calibrate.project.workflow import (
    CERTIFICATE,
    MEMBERS,
    POSTERIOR,
    REPORT,
    RUN,
    SAMPLING,
    certify_and_keep,
    holds_population,
    infer,
    make_data,
    read_posterior,
    with_known,
)
from calibrate.samplers import find_sampler, options_from
from calibrate.samplers.nuts import NUTS
from calibrate.statistical_model import Model
from emulator.catalogue import find_scene
from emulator.core import schema
from emulator.core.errors import InputError
from emulator.core.store import exclusive, read_json, write_json

SHRINKAGE = "shrinkage.png"
NOT_CERTIFIED = "not certified"  # the verdict on a member that FEM has not checked
_SAME = (
    "scene_fingerprint", "forward_fingerprint", "forward_error", "observe", "noise", "prior",
    "prior_dependence", "load_states",
)  # fmt: skip
"""Attributes of posteriors whose members may share one model, which is faster."""


def infer_cohort(
    cohort: Cohort,
    folder: str | Path,
    *,
    certify: bool = True,
    force: bool = False,
    progress: bool = False,
) -> tuple[Hierarchy, dict[str, str]]:
    """Calibrate all members, and keep everything in ``folder``; verdicts by member.

    A cohort that was killed goes on where it was: members that are done are not sampled again.
    Without ``certify`` members get no certificate.

    Raises
    ------
    InputError
        ``folder`` has the results of an earlier run and there is no ``force``, or a member's data
        or model does not fit.
    """
    folder = Path(folder)
    with exclusive(folder / RUN, "run"):
        done = folder / POSTERIOR
        if done.exists() and not force:
            raise InputError(
                f"{folder} has results of an earlier run ({POSTERIOR}); replace them with --force "
                "(in Python: force=True), or name another folder"
            )
        for name in (REPORT, POSTERIOR):
            (folder / name).unlink(missing_ok=True)
        write_json(folder / RUN, asdict(cohort))
        alone: dict[str, Posterior] = {}
        verdicts: dict[str, str] = {}
        for name, run in cohort.members.items():
            at = folder / MEMBERS / name
            alone[name] = _member(run, at, force=force, progress=progress)
            if certify:
                verdicts[name] = _verdict(alone[name], at, run, progress=progress)
        found = _together(cohort, alone, folder / SAMPLING, progress=progress)
        shrinkage.draw(found, folder / SHRINKAGE)
        found.save(done)
    return found, verdicts


def read_cohort(folder: str | Path) -> tuple[Cohort, Hierarchy]:
    """The cohort kept in ``folder``, and the hierarchy of its members.

    Raises
    ------
    InputError
        The folder holds no population, one that is not sampled to its end, or one of other members.
    """
    folder = Path(folder)
    if not holds_population(folder):
        raise InputError(f"{folder} holds a single run; calibrate.load reads it")
    cohort, done = _read_plan(folder / RUN), folder / POSTERIOR
    if not done.exists():
        ready = [name for name in cohort.members if (folder / MEMBERS / name / POSTERIOR).exists()]
        raise InputError(
            f"{folder} holds a population without {POSTERIOR}: {len(ready)} of its "
            f"{len(cohort.members)} members are sampled; repeat calibrate infer, which goes on"
        )
    found = read_hierarchy(done)
    if found.members != tuple(cohort.members):
        raise InputError(
            f"{done} is of members {', '.join(found.members)}, but {RUN} names "
            f"{', '.join(cohort.members)}; infer again"
        )
    return cohort, found


def _read_plan(path: Path) -> Cohort:
    kept = read_json(path)
    members = {
        name: schema.read_as(Run, entries, f"{path}, member '{name}'")
        for name, entries in kept[MEMBERS].items()
    }
    return Cohort(
        members, schema.read_as(Shared, kept.get(POPULATION, {}), f"{path}, {POPULATION}")
    )


def kept_verdicts(cohort: Cohort, folder: str | Path) -> dict[str, str]:
    """What FEM says of members in ``folder``, by name; those without a certificate are missing."""
    found = {
        name: _kept_verdict(run, Path(folder) / MEMBERS / name)
        for name, run in cohort.members.items()
    }
    return {name: verdict for name, verdict in found.items() if verdict is not None}


def _member(run: Run, folder: Path, *, force: bool, progress: bool) -> Posterior:
    """The posterior of a member by itself, kept from before if it is of this run and its data."""
    if (folder / POSTERIOR).exists() and not force:
        kept, posterior = read_posterior(folder)
        observe, data = make_data(run, find_scene(run.scene, run.root))
        if kept == with_known(run).named(observe) and is_of(posterior, observe, data):
            return posterior
        raise InputError(
            f"{folder} is of another run or other data than the experiment's member; replace it "
            "with --force, or name another folder"
        )
    return infer(run, folder, force=force, progress=progress)


def _verdict(posterior: Posterior, folder: Path, run: Run, *, progress: bool) -> str:
    """What FEM says of a member; a certificate that is there is of this posterior."""
    if (kept := _kept_verdict(run, folder)) is not None:
        return kept
    certificate = certify_and_keep(posterior, folder, load_steps=run.load_steps, progress=progress)
    return certificate.verdict


def _kept_verdict(run: Run, folder: Path) -> str | None:
    if find_sampler(run.sampler).solves_fem:
        return "decided by FEM"
    path = folder / CERTIFICATE
    return str(read_json(path)["verdict"]) if path.exists() else None


def _together(
    cohort: Cohort, alone: Mapping[str, Posterior], checkpoint: Path, *, progress: bool
) -> Hierarchy:
    run, given = cohort.first, cohort.population
    own = run.sampler_options if run.sampler == NUTS.name else {}
    options = options_from(
        NUTS,
        {"target_accept": TARGET_ACCEPT, **own},
        warmup=run.warmup,
        draws=run.draws,
        chains=run.chains,
    )
    model = population_model(
        _models(alone),
        shared=given.shared,
        median=_medians(given),
        spread=given.spread,
        eta=given.eta,
    )
    return sample_population(
        model,
        {name: posterior.data for name, posterior in alone.items()},
        options=options,
        alone={name: posterior.draws() for name, posterior in alone.items()},
        seed=run.seed,
        progress=progress,
        checkpoint=checkpoint,
    )


def _models(alone: Mapping[str, Posterior]) -> dict[str, Model]:
    """Each member's model; one object for all that differ in their data only."""
    first: dict[tuple[Any, ...], Model] = {}
    return {
        name: first.setdefault(
            tuple(posterior.tree.attrs.get(key) for key in _SAME), posterior.model
        )
        for name, posterior in alone.items()
    }


def _medians(given: Shared) -> dict[str, dist.Distribution]:
    return {name: log_normal(median, sd) for name, (median, sd) in given.median.items()}


def cohort_report(found: Hierarchy, verdicts: Mapping[str, str]) -> dict[str, Any]:
    """The result as plain JSON: the population, each member alone and among the others."""
    return {
        "population": found.summary(),
        "members": {
            member: {
                "verdict": verdicts.get(member, NOT_CERTIFIED),
                **{name: by[member]._asdict() for name, by in found.shrinkage().items()},
            }
            for member in found.members
        },
        "new_member": {
            name: dict(zip(("low", "median", "high"), _quantiles(draws), strict=True))
            for name, draws in found.new_member().items()
        },
        "warnings": found.warnings(),
    }


def _quantiles(draws: np.ndarray) -> list[float]:
    return [float(value) for value in np.quantile(draws, (0.05, 0.5, 0.95))]
