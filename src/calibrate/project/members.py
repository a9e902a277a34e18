"""Members of one population: each calibrated by itself and certified, then all together.

The folder of a population has ``members/NAME``, the folder of a run, for each member
(:mod:`calibrate.project.results`); ``run.json``, the :class:`Members`; and ``posterior.nc``, the
hierarchy of them all (:func:`calibrate.population.read_hierarchy`).
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from calibrate.figures import shrinkage
from calibrate.population import Hierarchy, population_model, read_hierarchy, sample_population
from calibrate.posterior import Posterior
from calibrate.priors import log_normal
from calibrate.project.calibration import NOT_CERTIFIED, certify_and_keep, infer
from calibrate.project.problem import Problem, read_problem, with_data
from calibrate.project.results import (
    CERTIFICATE,
    MEMBERS,
    POPULATION,
    POSTERIOR,
    REPORT,
    RUN,
    holds_population,
    is_of,
    read_posterior,
    reserved,
    run_of,
)
from calibrate.project.rounds import by_rounds
from calibrate.project.run import Run
from calibrate.samplers.auto import AUTO
from calibrate.samplers.nuts import NUTS
from calibrate.statistical_model import Model
from emulator.core import schema
from emulator.core.engine import Engine, engine_of
from emulator.core.errors import InputError, SolverError
from emulator.core.store import read_json, write_json

SHRINKAGE = "shrinkage.png"
GROUPS = "groups"  # entry of a population's run.json
FAILED = "failed"  # entry of a population's run.json, and beginning of a verdict
_SAME_MODEL = (
    "scene_fingerprint", "forward_fingerprint", "forward_error", "observe", "noise", "prior",
    "prior_dependence", "load_states",
)  # fmt: skip
"""Attributes of posteriors that agree where members may share one model, which is faster."""


@dataclass(frozen=True)
class Shared:
    """The settings that all members of a :func:`calibrate.population.hierarchy` share.

    shared : unknowns that follow the population; by default all that every member has.
    median : median and relative sd of a log-normal prior of the population's median, by name.
    spread : scale of the half-normal prior of the population's sd, by name.
    eta : concentration of the prior of correlations; 1 is uniform, more prefers none.
    """

    shared: tuple[str, ...] | None = None
    median: dict[str, list[float]] = field(default_factory=dict)
    spread: dict[str, float] = field(default_factory=dict)
    eta: float = 2.0

    def __post_init__(self) -> None:
        for name, numbers in self.median.items():
            if len(numbers) != 2:
                raise InputError(f"median of '{name}' is {numbers}; give median and relative sd")


@dataclass(frozen=True)
class Members:
    """Members of one population.

    members : the run of each by itself, by name.
    population : what they share.
    groups : the group of each member, by name, of members that have one.
    unread : why further members could not be read, by name.
    problems : the members' problems, where their scenes and data have been read.
    """

    members: Mapping[str, Run]
    population: Shared = Shared()
    groups: Mapping[str, str] = field(default_factory=dict)
    unread: Mapping[str, str] = field(default_factory=dict)
    problems: Mapping[str, Problem] = field(default_factory=dict, compare=False, repr=False)

    def __post_init__(self) -> None:
        if len(self.members) < 2:
            raise InputError(
                "members: one is no population; give two tables [members.NAME] or more"
            )
        for name in self.members:
            if not name or set("/@[]") & set(name):
                raise InputError(f"members: '{name}' is no name; leave out /, @ and brackets")

    def problem(self, name: str) -> Problem:
        """Return the problem of one member."""
        known = self.problems.get(name)
        return by_rounds(read_problem(self.members[name]) if known is None else known)

    def only(self, names: Iterable[str]) -> Members:
        """Return some of the members."""
        return replace(self, members={name: self.members[name] for name in names})


def infer_members(
    plan: Members,
    folder: str | Path,
    *,
    certify: bool = True,
    force: bool = False,
    tolerant: bool = False,
    executor: Executor | str | None = None,
    progress: bool = False,
) -> tuple[Hierarchy, dict[str, str]]:
    """Calibrate all members, write everything to ``folder``, and return verdicts by member.

    A calibration that was killed continues where it was: members that are done are not sampled
    again.

    Parameters
    ----------
    plan : the members and what they share.
    certify : check each member's posterior against FEM.
    force : replace the results of an earlier calibration.
    tolerant : leave members out that fail, each with a verdict that says why; the others make the
        population.
    executor : the executor of :mod:`concurrent.futures`, or the words of an engine, by which
        members are calibrated at the same time (:mod:`emulator.core.engine`); by default one is
        after the other, and each has all cores.

    Raises
    ------
    InputError
        ``folder`` has the results of an earlier run and there is no ``force``, a member's data
        or model does not fit, or fewer than two members are left.
    """
    folder = Path(folder)
    with reserved(folder, (POSTERIOR,), force=force):
        for name in (REPORT, POSTERIOR):
            (folder / name).unlink(missing_ok=True)
        _write_plan(folder, plan)
        calibration = _Calibration(plan, folder, certify, force, tolerant, progress=progress)
        posteriors, verdicts = _calibrated(calibration, engine_of(executor))
        plan = _of_members_left(plan, posteriors, verdicts)
        _write_plan(folder, plan, {n: v for n, v in verdicts.items() if n not in posteriors})
        hierarchy = _sample_together(plan, posteriors, progress=progress)
        shrinkage.draw(hierarchy, folder / SHRINKAGE)
        hierarchy.save(folder / POSTERIOR)
    return hierarchy, verdicts


def read_members(folder: str | Path) -> tuple[Members, Hierarchy]:
    """Read the members in ``folder``, and their hierarchy.

    Raises
    ------
    InputError
        The folder holds no population, one that is not sampled to its end, or one of other members.
    """
    folder = Path(folder)
    if not holds_population(folder):
        raise InputError(f"{folder} holds a single run; calibrate.load reads it")
    entries, where = read_json(folder / RUN), folder / RUN
    runs = {
        name: run_of(run, f"{where}, member '{name}'") for name, run in entries[MEMBERS].items()
    }
    shared = schema.read_as(Shared, entries.get(POPULATION, {}), f"{where}, {POPULATION}")
    plan, path = Members(runs, shared, entries.get(GROUPS, {})), folder / POSTERIOR
    if not path.exists():
        sampled = sum((folder / MEMBERS / name / POSTERIOR).exists() for name in runs)
        raise InputError(
            f"{folder} holds a population without {POSTERIOR}: {sampled} of its "
            f"{len(runs)} members are sampled; repeat calibrate infer, which goes on"
        )
    hierarchy = read_hierarchy(path)
    if hierarchy.members != tuple(plan.members):
        raise InputError(
            f"{path} is of members {', '.join(hierarchy.members)}, but {RUN} names "
            f"{', '.join(plan.members)}; infer again"
        )
    return plan, hierarchy


def verdicts_in(plan: Members, folder: str | Path) -> dict[str, str]:
    """Return FEM's verdicts on members in ``folder``, by name; some may have no certificate."""
    return {
        name: verdict
        for name in plan.members
        if (verdict := _written_verdict(Path(folder) / MEMBERS / name)) is not None
    }


def failures_in(folder: str | Path) -> dict[str, str]:
    """Return why members of the population in ``folder`` failed, by name."""
    return dict(read_json(Path(folder) / RUN).get(FAILED, {}))


def _write_plan(folder: Path, plan: Members, failed: Mapping[str, str] = {}) -> None:
    entries: dict[str, Any] = {MEMBERS: {name: asdict(run) for name, run in plan.members.items()}}
    entries[POPULATION] = asdict(plan.population)
    if plan.groups:
        entries[GROUPS] = dict(plan.groups)
    if failed:
        entries[FAILED] = dict(failed)
    write_json(folder / RUN, entries)


def _of_members_left(
    plan: Members, posteriors: Mapping[str, Posterior], verdicts: Mapping[str, str]
) -> Members:
    """Return the members that have a posterior; :class:`InputError` for fewer than two."""
    if len(posteriors) < 2:
        faults = [f"{name} {verdicts[name]}" for name in plan.members if name not in posteriors]
        raise InputError(f"members: {len(posteriors)} of {len(plan.members)} is left; {faults[0]}")
    return plan.only(posteriors)


@dataclass(frozen=True)
class _Calibration:
    """Calibrates one member, in this process or in a worker's.

    folder : the population's. here : whether the posterior is returned, or only written.
    """

    plan: Members
    folder: Path
    certify: bool
    force: bool
    tolerant: bool
    progress: bool
    here: bool = True

    def __call__(self, name: str) -> tuple[Posterior | None, str | None]:
        """Return the posterior and its verdict; of a member that failed neither, and why."""
        at, run = self.folder / MEMBERS / name, self.plan.members[name]
        try:
            posterior = _posterior_of(self.plan.problem(name), at, self.force, self.progress)
            verdict = _written_verdict(at)
            if self.certify and verdict is None:
                verdict = certify_and_keep(
                    posterior, at, load_steps=run.load_steps, executor=run.engine,
                    progress=self.progress,
                ).verdict  # fmt: skip
        except (InputError, SolverError) as error:
            if not self.tolerant:
                raise
            return None, f"{FAILED}: {error}"
        return posterior if self.here else None, verdict if self.certify else None


def _calibrated(
    calibration: _Calibration, engine: Engine | None
) -> tuple[dict[str, Posterior], dict[str, str]]:
    """Return the posteriors of all members that did not fail, and the verdicts, by name."""
    plan, posteriors = calibration.plan, dict[str, Posterior]()
    verdicts = {name: f"{FAILED}: {why}" for name, why in plan.unread.items()}
    names, tells = iter(plan.members), engine is not None and calibration.progress
    if engine is None:
        done: Iterator[Any] = map(calibration, names)
    else:  # whose workers each have a process, and so all of a run's threads
        apart = replace(calibration, progress=False, here=False)
        done = engine.in_order(apart, names, alone=0, ahead=len(plan.members))
    for name, (posterior, verdict) in zip(plan.members, done, strict=True):
        if verdict is not None:
            verdicts[name] = verdict
        if verdict is None or not verdict.startswith(FAILED):
            at = calibration.folder / MEMBERS / name
            posteriors[name] = read_posterior(at)[1] if posterior is None else posterior
        if tells:
            tqdm.write(f"{name}: {verdict or 'done'}", file=sys.stderr)
    return posteriors, verdicts


def _posterior_of(problem: Problem, folder: Path, force: bool, progress: bool) -> Posterior:
    """Return the posterior of one member: the one in ``folder`` if it is of this problem."""
    if (folder / POSTERIOR).exists() and not force:
        run, posterior = read_posterior(folder)
        if run == problem.run and is_of(posterior, with_data(problem)):
            return posterior
        raise InputError(
            f"{folder} is of another run or other data than the experiment's member; replace it "
            "with --force, or name another folder"
        )
    return infer(problem, folder, force=force, progress=progress)


def _written_verdict(folder: Path) -> str | None:
    path = folder / CERTIFICATE
    return str(read_json(path)["verdict"]) if path.exists() else None


def _sample_together(
    plan: Members, posteriors: Mapping[str, Posterior], *, progress: bool
) -> Hierarchy:
    """Sample the population; the first member's run says for how long and with which seed."""
    run, shared = next(iter(plan.members.values())), plan.population
    own_options = run.sampler_options if run.sampler in (AUTO.name, NUTS.name) else {}
    by_nuts = replace(run, sampler=NUTS.name, sampler_options=own_options)
    models: dict[tuple[Any, ...], Model] = {}  # one for all members that differ in their data only
    model = population_model(
        {
            name: models.setdefault(
                tuple(posterior.tree.attrs.get(key) for key in _SAME_MODEL), posterior.model
            )
            for name, posterior in posteriors.items()
        },
        shared=shared.shared,
        median={name: log_normal(median, sd) for name, (median, sd) in shared.median.items()},
        spread=shared.spread,
        eta=shared.eta,
    )
    return sample_population(
        model,
        {name: posterior.data for name, posterior in posteriors.items()},
        options=by_nuts.sampling()[1],
        alone={name: posterior.draws() for name, posterior in posteriors.items()},
        seed=run.seed,
        progress=progress,
    )


def members_report(hierarchy: Hierarchy, verdicts: Mapping[str, str]) -> dict[str, Any]:
    """Return the result as plain JSON: the population, each member alone and with the others."""
    shrinkages = hierarchy.shrinkage()
    return {
        "population": hierarchy.summary(),
        "failed": {name: v for name, v in verdicts.items() if name not in hierarchy.members},
        "members": {
            member: {
                "verdict": verdicts.get(member, NOT_CERTIFIED),
                **{name: by_member[member]._asdict() for name, by_member in shrinkages.items()},
            }
            for member in hierarchy.members
        },
        "new_member": {
            name: dict(zip(("low", "median", "high"), quantiles, strict=True))
            for name, draws in hierarchy.new_member().items()
            for quantiles in [np.quantile(draws, (0.05, 0.5, 0.95)).tolist()]
        },
        "warnings": hierarchy.warnings(),
    }
