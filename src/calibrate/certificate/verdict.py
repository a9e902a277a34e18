"""The certificate and its verdict: every figure with its error, every finding with what to do.

A figure counts as within its limit where its distance from it exceeds twice its Monte Carlo error,
as beyond it likewise, and as undecided in between; so more FEM runs may decide what few leave open,
but do not turn one verdict into the other.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from calibrate.certificate.evidence import Evidence, Figure, MeshChange, Physics, Sampling
from calibrate.posterior.fit import SMALLEST_P, Misfit
from calibrate.samplers.stopping import REFUSE_ABOVE_R_HAT, REFUSE_BELOW_ESS
from emulator.core.representation import TableRepr

Verdict = Literal["accepted", "reweight", "not certified", "undecided"]

LARGEST_DIVERGENT = 0.002
LARGEST_FAILED = 0.02
SMALLEST_P_WORST = 0.001
# Spread of the log ratio of FEM's likelihood over the corrected map's, above which the two are too
# different whatever the tail; at 1.5 a tenth of the FEM runs would count.
LARGEST_SPREAD = 1.5
SMALLEST_POOL = 200.0  # effective points under the corrected map
_MORE = "more FEM runs (--until decided)"
_MANY = 20.0  # times as many runs; beyond, it is not known how many would decide
_WIDEN = "or allow for it in the likelihood (--mesh-error)"
_QUADRATIC = f"make the elements quadratic (order = 2), {_WIDEN}"
_REFINE = f"emulate the finer mesh (calibrate train finer:SCENE --recipe two_meshes), {_WIDEN}"


class Finding(NamedTuple):
    """What was found, and what to do about it where something is to be done."""

    what: str
    remedy: str = ""

    def __str__(self) -> str:
        """Both, as they are told."""
        return f"{self.what}: {self.remedy}" if self.remedy else self.what


@dataclass(frozen=True, repr=False)
class Certificate(TableRepr):
    """Outcome of a check against FEM.

    verdict : ``accepted`` (use the posterior as it is), ``reweight`` (use the reweighted one),
        ``undecided`` (give more FEM runs), or ``not certified``.
    reason : what decides, in words. findings : all that was found, each with what to do.
    evidence : the figures.
    """

    verdict: Verdict
    reason: str
    findings: tuple[str, ...]
    evidence: Evidence

    def __str__(self) -> str:
        """Verdict, every finding, and what they cost."""
        return f"{self.verdict}: {'; '.join(self.findings)} ({self.evidence.physics.runs} FEM runs)"

    def summary_rows(self) -> tuple[str, list[tuple[str, str]]]:
        """Verdict, findings, and what they cost."""
        rows = [("verdict", str(self.verdict)), *(("finding", each) for each in self.findings)]
        return "Certificate", [*rows, ("FEM runs", str(self.evidence.physics.runs))]

    @property
    def k_hat(self) -> float:
        """Pareto shape of the weights of the FEM runs."""
        return self.evidence.tail.k_hat

    @property
    def shift(self) -> dict[str, float]:
        """Per parameter, mean under FEM less mean of the draws, in posterior sd."""
        return {name: figure.value for name, figure in self.evidence.draws.shift.items()}

    def to_json(self) -> dict[str, Any]:
        """Plain JSON: figures by name, each error beside its figure."""
        e = self.evidence
        return {
            "verdict": self.verdict,
            "reason": self.reason,
            "findings": list(self.findings),
            "k_hat": e.tail.k_hat,
            "k_threshold": e.tail.k_threshold,
            "ess": e.tail.ess,
            "draws": e.physics.runs,
            "failed": e.physics.failed,
            **_columns("shift", e.draws.shift),
            **_columns("log_sd_change", e.draws.log_sd),
            **_columns("correlation_change", e.draws.correlation),
            "mass_change": {
                f"{level:g}": _columns("below", figures) for level, figures in e.draws.mass.items()
            },
            **_columns("mean_fem", e.mean),
            **_columns("sd_fem", e.sd),
            "mesh": {
                **_columns("shift", e.mesh.shift),
                **_columns("log_sd_change", e.mesh.log_sd),
                "nodes": e.mesh.nodes,
                "runs": e.mesh.runs,
                "failed": e.mesh.failed,
                "not_asked": e.mesh.why,
            },
            "misfit": {name: asdict(m) for name, m in e.misfit.items()},
            "sampling": asdict(e.sampling),
            "physics": asdict(e.physics),
            "tail": asdict(e.tail),
        }


def shifts(certificate: Mapping[str, Any]) -> dict[str, dict[str, float]]:
    """How far FEM, and a finer mesh, would move each mean, in sd: of a certificate's JSON."""
    found = {"FEM": certificate.get("shift"), "mesh": certificate.get("mesh", {}).get("shift")}
    return {what: shift for what, shift in found.items() if shift}


def judge(evidence: Evidence) -> Certificate:
    """The verdict: the first of not certified, undecided, reweight and accepted with a reason.

    Every comparison is written so that NaN fails it.
    """
    wrong = [*_sampling(evidence.sampling), *_physics(evidence.physics), *_misfit(evidence.misfit)]
    verdict, words = _agreement(evidence)
    fine, mesh = _mesh(evidence.mesh)
    if wrong or fine is False:
        verdict = "not certified"
    elif fine is None and verdict in ("accepted", "reweight"):
        verdict = "undecided"
    if evidence.mesh.why and verdict == "accepted":
        words = [Finding(f"{words[0].what} on this mesh")]
    findings = [*wrong, *words, *mesh] if fine else [*wrong, *mesh, *words]
    return Certificate(verdict, findings[0].what, tuple(map(str, findings)), evidence)


def _mesh(mesh: MeshChange) -> tuple[bool | None, list[Finding]]:
    """Whether a finer mesh leaves the posterior as it is, ``None`` where that is open; findings."""
    if mesh.why:
        return True, [Finding(f"no finer mesh was asked: {mesh.why}")]
    finer = f"on a finer mesh ({mesh.nodes} nodes)"
    if not mesh.shift:
        failed = f"FEM failed at {mesh.failed} of {mesh.runs} points {finer}"
        return None, [Finding(failed, "refine the mesh")]
    within = mesh.within()
    if within:
        worst = max(abs(figure.value) for figure in mesh.shift.values())
        told = f"mesh: {finer} no mean would move by more than {worst:.2f} posterior sd"
        return True, [Finding(f"{told}, which is widened for it" if mesh.widened else told)]
    words = [w for w, figure, limit in mesh.judged() if figure.within(limit) is within]
    if within is None:
        near = f"{finer} the {words[0]}, too close to the limit for its error"
        return None, [Finding(near, "give more runs on the finer mesh (--mesh-runs)")]
    remedy = _QUADRATIC if mesh.linear else _REFINE
    if mesh.widened:
        remedy = "learn the error of the mesh from more runs, or emulate the finer mesh"
    return False, [Finding(f"{finer} the {each}", remedy) for each in words]


def _agreement(evidence: Evidence) -> tuple[Verdict, list[Finding]]:
    """Verdict and findings on draws against FEM."""
    tail, draws, corrected = evidence.tail, evidence.draws, evidence.corrected
    if tail.ess == 0.0:
        return "not certified", [
            Finding("no FEM run supports the posterior", "check map and FEM options")
        ]
    if tail.spread > LARGEST_SPREAD:
        apart = f"the map differs from FEM irregularly, log ratios spread by {tail.spread:.1f}"
        return "not certified", [
            Finding(apart, "train a better map, or put FEM into the likelihood")
        ]
    if np.isnan(tail.k_hat):
        few = "too few FEM runs to judge the tail of their weights"
        return "undecided", [Finding(few, "100 FEM runs or more")]
    if tail.heavy or not tail.pool >= SMALLEST_POOL:
        heavy = "the weights' tail is too heavy to trust their errors"
        if tail.ends:
            places = "one place" if tail.ends == 1 else f"{tail.ends} places"
            away = f"FEM finds the data likely away from the draws, in {places}"
            heavy = f"{away}, and {heavy}"
        return "undecided", [Finding(heavy, _MORE)]
    if tail.missed:
        missed = f"{tail.missed} FEM runs are likely where the corrected map says they are not"
        hidden = f"{missed}, so the map may hide a part of the posterior"
        return "undecided", [Finding(hidden, f"train a better map, or {_MORE}")]
    agree = draws.within()
    beyond = [words for words, f, limit in draws.judged() if f.within(limit) is False]
    if agree:
        worst = max((abs(f.value) for f in draws.shift.values()), default=0.0)
        return "accepted", [Finding(f"no mean moves by more than {worst:.2f} posterior sd")]
    if agree is None:
        near = [each for each in draws.judged() if each[1].within(each[2]) is None]
        close = f"{near[0][0]}, too close to the limit for its error"
        times = max(figure.more(limit) for _, figure, limit in near)
        some = f", some {_rounded(evidence.physics.runs * times)}" if times < _MANY else ""
        return "undecided", [Finding(close, _MORE + some)]
    repaired = corrected.within()
    if repaired:
        return "reweight", [Finding(words, "use the reweighted posterior") for words in beyond]
    verdict: Verdict = "undecided" if repaired is None else "not certified"
    remedy = _MORE if repaired is None else "train a better map"
    still = "and reweighting does not repair it"
    return verdict, [Finding(f"{words}, {still}", remedy) for words in beyond]


def _sampling(s: Sampling) -> Iterator[Finding]:
    if not s.vary:
        yield Finding("the draws of a parameter do not vary", "the sampler is stuck")
    elif not np.isfinite(s.r_hat):
        yield Finding("R-hat is not a number", "draw more")
    elif not s.r_hat <= REFUSE_ABOVE_R_HAT:
        disagree = f"the chains disagree, R-hat {s.r_hat:.3f}"
        yield Finding(disagree, "draw more, or find their modes")
    if not s.divergences <= max(LARGEST_DIVERGENT * s.transitions, 1):
        yield Finding(
            f"{s.divergences} of {s.transitions} transitions diverged",
            "the sampler cannot follow the posterior everywhere; raise target_accept, or narrow a "
            "prior the data leaves open",
        )
    if s.vary and not np.min([s.ess_bulk, s.ess_tail]) >= REFUSE_BELOW_ESS:
        few = f"{s.ess_bulk:.0f} in the bulk and {s.ess_tail:.0f} in the tails"
        remedy = f"draw until both reach {REFUSE_BELOW_ESS:.0f}"
        yield Finding(f"too few effective draws, {few}", remedy)


def _physics(p: Physics) -> Iterator[Finding]:
    if not p.failed_mass <= LARGEST_FAILED:
        yield Finding(
            f"FEM fails on {100 * p.failed_mass:.0f} % of the posterior",
            "raise --load-steps (NewtonOptions.load_steps), or narrow the prior to states that "
            "exist",
        )
    if p.unstable:
        yield Finding(
            f"FEM is at a saddle at {p.unstable} of {p.asked} draws",
            "the body would leave that state; follow the loading path with --load-steps 10 "
            "(NewtonOptions.load_steps)",
        )


def _misfit(observations: dict[str, Misfit]) -> Iterator[Finding]:
    for name, m in observations.items():
        if not (m.p >= SMALLEST_P and m.p_worst >= SMALLEST_P_WORST):
            named = ", ".join(f"{k} by {d:.1f} sd" for k, d in list(m.outlying.items())[:4])
            outlying = f"outlying data ({named}), " if named else ""
            yield Finding(
                f"{name} does not fit, posterior predictive p {min(m.p, m.p_worst):.3f}",
                f"check {outlying}registration, units, law and noise sd",
            )
        elif not m.p <= 1.0 - SMALLEST_P:
            close = f"{name} fits closer than its noise allows, posterior predictive p {m.p:.3f}"
            yield Finding(close, "its noise sd is too large")


def _rounded(number: float) -> int:
    """Up to the next hundred."""
    return int(np.ceil(number / 100.0)) * 100


def _columns(name: str, figures: dict[str, Figure]) -> dict[str, dict[str, float]]:
    return {
        name: {k: f.value for k, f in figures.items()},
        f"{name}_error": {k: f.error for k, f in figures.items()},
    }
