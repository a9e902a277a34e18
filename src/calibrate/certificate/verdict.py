"""The verdict that follows from a certificate's evidence, with a finding for each fault."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np

from calibrate.certificate.evidence import (
    NOBODY_SAID,
    Evidence,
    Figure,
    MeshChange,
    Tail,
    all_within,
)
from calibrate.certificate.mesh import finer_of
from calibrate.posterior.box import in_words
from calibrate.posterior.diagnosis import SMALLEST_P, closer_map, map_fault, sampling_faults
from emulator.core.display import TableRepr

Verdict = Literal["accepted", "reweight", "not certified", "undecided"]

# If no weight of an FEM run exceeds this multiple of the mean weight, the tail does not matter:
# proposals cover the prior, so that the ratios are bounded (docs/experiments.md, "When k-hat cries
# wolf").
NO_TAIL = 6.0
LARGEST_FAILED = 0.02
SMALLEST_P_WORST = 0.001
# Spread of the log ratio of FEM's likelihood over the corrected map's, above which the two are too
# different whatever the tail; at 1.5 a tenth of the FEM runs would count.
LARGEST_SPREAD = 1.5
# Spread up to which few tests are enough: FEM's weights are then the corrected map's to a tenth,
# and the pool of these has hundreds of effective points.
_SAME = 0.1
SMALLEST_POOL = 200.0  # effective points under the corrected map
_MANY = 20.0  # factor in the number of runs above which the estimate of that factor is worthless

_MORE = "more FEM runs (--until decided)"
_REFINE = "infer on the finer mesh (calibrate infer finer:SCENE)"
_QUADRATIC = f"make the elements quadratic (order = 2), or {_REFINE}"
_MORE_ROWS = "give a finer mesh, and rows between those of the history, with nothing measured"
_LEARN_GRIPS = (
    "calibrate on the gripped piece (calibrate train SCENE --out grips.safetensors, then learned = "
    '"grips.safetensors" under [grips] of the scene)'
)
_SAY_GRIPS = (
    'clamps make a square 10 to 20 % stiffer; give [grips] in the scene file, or grips = "none" '
    "where they are far from what was measured"
)

Finding = tuple[str, str]
"""A statement about the posterior, and a remedy; empty where there is none."""


@dataclass(frozen=True, repr=False)
class Certificate(TableRepr):
    """Outcome of a check against FEM.

    verdict : ``accepted`` (use the posterior as it is), ``reweight`` (use the reweighted one),
        ``undecided`` (give more FEM runs), or ``not certified``.
    reason : the statement that decides. findings : all statements, each with its remedy.
    evidence : the figures.
    """

    verdict: Verdict
    reason: str
    findings: tuple[str, ...]
    evidence: Evidence

    def __str__(self) -> str:
        """Return verdict, every finding, and the number of FEM runs."""
        return f"{self.verdict}: {'; '.join(self.findings)} ({self.evidence.physics.runs} FEM runs)"

    def summary_rows(self) -> tuple[str, list[tuple[str, str]]]:
        """Return title and rows of the table: verdict, findings, and the number of FEM runs."""
        rows = [("verdict", str(self.verdict)), *(("finding", text) for text in self.findings)]
        return "Certificate", [*rows, ("FEM runs", str(self.evidence.physics.runs))]

    @property
    def k_hat(self) -> float:
        """Pareto shape of the weights of the FEM runs."""
        return self.evidence.tail.k_hat

    @property
    def shift(self) -> dict[str, float]:
        """The mean under FEM less the mean of the draws, in posterior sd, by parameter."""
        return {name: figure.value for name, figure in self.evidence.draws.shift.items()}

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON: figures by name, the error of each beside it."""
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
            **_with_errors("shift", e.draws.shift),
            **_with_errors("log_sd_change", e.draws.log_sd),
            **_with_errors("correlation_change", e.draws.correlation),
            "mass_change": {
                f"{level:g}": _with_errors("below", figures)
                for level, figures in e.draws.mass.items()
            },
            **_with_errors("mean_fem", e.mean),
            **_with_errors("sd_fem", e.sd),
            "mesh": {
                **_with_errors("shift", e.mesh.shift),
                **_with_errors("log_sd_change", e.mesh.log_sd),
                "nodes": e.mesh.nodes,
                "runs": e.mesh.runs,
                "failed": e.mesh.failed,
                "not_asked": e.mesh.why,
                "of": e.mesh.of,
            },
            "box": [asdict(end) for end in e.box],
            "noise": [asdict(noise) for noise in e.noise],
            "misfit": {name: asdict(m) for name, m in e.misfit.items()},
            "map_errors": e.map_errors,
            **{name: asdict(getattr(e, name)) for name in ("sampling", "physics", "tail")},
        }


def _with_errors(name: str, figures: dict[str, Figure]) -> dict[str, dict[str, float]]:
    return {
        name: {k: f.value for k, f in figures.items()},
        f"{name}_error": {k: f.error for k, f in figures.items()},
    }


def shifts(certificate: Mapping[str, Any]) -> dict[str, dict[str, float]]:
    """Return the shifts of means by FEM and by a finer mesh, in sd, from a certificate's JSON.

    A specimen has ``grips`` in place of ``mesh``, a body in time ``mesh and steps``.
    """
    mesh = certificate.get("mesh", {})
    by_cause = {"FEM": certificate.get("shift"), finer_of(mesh): mesh.get("shift")}
    return {cause: shift for cause, shift in by_cause.items() if shift}


def judge(evidence: Evidence) -> Certificate:
    """Return the certificate: not certified, undecided, reweight or accepted, the first that holds.

    Every comparison is written so that NaN fails it.
    """
    verdict, agreement = _agreement(evidence)
    faults, others = list(sampling_faults(evidence.sampling, evidence.box)), list(_faults(evidence))
    wrong_map = map_fault(evidence.map_errors, forward=evidence.forward)
    agrees = verdict in ("accepted", "reweight")
    mesh_is_fine, mesh = _mesh(evidence.mesh)
    if faults or others or mesh_is_fine is False:
        verdict = "not certified"
    elif mesh_is_fine is None and verdict in ("accepted", "reweight"):
        verdict = "undecided"
    if wrong_map and (faults or not agrees):  # then chains are no fault of the sampler
        faults = [wrong_map, *((words, "mend the map first") for words, _ in faults)]
    elif wrong_map and verdict == "reweight":
        agreement = [*agreement, wrong_map]
    faults += others
    if evidence.mesh.why and verdict == "accepted":
        where = f"if the piece deforms evenly, {evidence.mesh.homogeneous}"
        where = where if evidence.mesh.homogeneous else "on this mesh"
        agreement = [(f"{agreement[0][0]} {where}", "")]
    findings = [*faults, *agreement, *mesh] if mesh_is_fine else [*faults, *mesh, *agreement]
    findings += [(str(noise), noise.remedy) for noise in evidence.noise]
    sentences = tuple(": ".join(filter(None, finding)) for finding in findings)
    return Certificate(verdict, findings[0][0], sentences, evidence)


def _mesh(mesh: MeshChange) -> tuple[bool | None, list[Finding]]:
    """Return whether a finer mesh keeps the posterior, ``None`` if undecided, and findings."""
    if mesh.homogeneous:
        remedy = _SAY_GRIPS if mesh.homogeneous == NOBODY_SAID else ""
        return True, [(f"grips: the piece is taken to deform evenly, {mesh.homogeneous}", remedy)]
    if mesh.why:
        return True, [(f"no finer mesh was asked: {mesh.why}", "")]
    finer = mesh.place
    if not mesh.shift:
        failed = f"FEM failed at {mesh.failed} of {mesh.runs} points {finer}"
        return None, [
            (failed, "check the size of the piece" if mesh.of == "grips" else "refine the mesh")
        ]
    within = all_within(comparisons := mesh.comparisons())
    if within:
        worst = max(abs(figure.value) for figure in mesh.shift.values())
        row = mesh.of
        words = f"{row}: {finer} no mean would move by more than {worst:.2f} posterior sd"
        return True, [(words, "")]
    decisive = [w for w, figure, limit in comparisons if figure.within(limit) is within]
    if within is None:
        close = f"{finer} the {decisive[0]}, too close to the limit for its error"
        return None, [(close, f"give more runs there (--mesh-runs {2 * mesh.runs})")]
    remedy = _QUADRATIC if mesh.linear else _REFINE
    remedy = {"grips": _LEARN_GRIPS, "mesh": remedy}.get(mesh.of, _MORE_ROWS)
    return False, _together([f"{finer} the {decisive[0]}", *decisive[1:]], remedy)


def _together(words: list[str], remedy: str) -> list[Finding]:
    """Return the first of figures with their remedy, and all others in one line."""
    others = [(f"and the {', the '.join(words[1:])}", "")] if words[1:] else []
    return [(words[0], remedy), *others]


def _agreement(evidence: Evidence) -> tuple[Verdict, list[Finding]]:
    """Return verdict and findings on the draws against FEM."""
    draws, closer = evidence.draws, closer_map(evidence.forward)
    if (verdict_of_weights := _weights(evidence.tail, closer)) is not None:
        return verdict_of_weights
    agree = all_within(comparisons := draws.comparisons())
    if agree:
        worst = max((abs(f.value) for f in draws.shift.values()), default=0.0)
        return "accepted", [(f"no mean moves by more than {worst:.2f} posterior sd", "")]
    decisive = [row for row in comparisons if row[1].within(row[2]) is agree]
    if agree is None:
        factor = max(figure.factor_to_decide(limit) for _, figure, limit in decisive)
        runs = evidence.physics.runs * factor
        some = f", some {100 * int(np.ceil(runs / 100.0))}" if factor < _MANY else ""
        close = f"{decisive[0][0]}, too close to the limit for its error"
        return "undecided", [(close, _MORE + some)]
    repaired = all_within(evidence.corrected.comparisons())
    if repaired:
        words = [words for words, _, _ in decisive]
        return "reweight", _together(words, "use the reweighted posterior")
    verdict: Verdict = "undecided" if repaired is None else "not certified"
    remedy = _MORE if repaired is None else closer
    first, *others = (words for words, _, _ in decisive)
    return verdict, _together([f"{first}, and reweighting does not repair it", *others], remedy)


def _weights(tail: Tail, closer: str) -> tuple[Verdict, list[Finding]] | None:
    """Return verdict and finding where the weights of the FEM runs forbid any other figure.

    closer : the remedy where the map is too far from FEM.
    """
    if tail.ess == 0.0:
        return "not certified", [("no FEM run supports the posterior", "check map and FEM options")]
    if tail.spread > LARGEST_SPREAD:
        apart = f"the map differs from FEM irregularly, log ratios spread by {tail.spread:.1f}"
        return "not certified", [(apart, f"{closer}, or put FEM into the likelihood")]
    if np.isnan(tail.k_hat) and not tail.spread <= _SAME:
        few = "too few FEM runs to judge the tail of their weights"
        return "undecided", [(few, "100 FEM runs or more")]
    light = tail.k_hat < tail.k_threshold or tail.largest < NO_TAIL
    if not (light and tail.pool >= SMALLEST_POOL):
        heavy = "the weights' tail is too heavy to trust their errors"
        if tail.ends:
            places = "one place" if tail.ends == 1 else f"{tail.ends} places"
            away = f"FEM finds the data likely away from the draws, in {places}"
            heavy = f"{away}, and {heavy}"
        return "undecided", [(heavy, _MORE)]
    if tail.missed:
        hidden = (
            f"{tail.missed} FEM runs are likely where the corrected map says they are not, so the "
            "map may hide a part of the posterior"
        )
        return "undecided", [(hidden, f"{closer}, or {_MORE}")]
    return None


def _faults(evidence: Evidence) -> Iterator[Finding]:
    """Yield the faults of FEM at the draws and of the data; the figures play no part in them."""
    p = evidence.physics
    if evidence.box:
        yield in_words(evidence.box)
    if not p.failed_mass <= LARGEST_FAILED:
        yield (
            f"FEM fails on {100 * p.failed_mass:.0f} % of the posterior",
            "raise --load-steps (NewtonOptions.load_steps; another program has its own), or narrow "
            "the prior to states that exist",
        )
    if p.unstable:
        yield (
            f"FEM is at a saddle at {p.unstable} of {p.asked} draws",
            "the body would leave that state; follow the loading path with --load-steps 10 "
            "(NewtonOptions.load_steps)",
        )
    for name, m in evidence.misfit.items():
        if not (m.p >= SMALLEST_P and m.p_worst >= SMALLEST_P_WORST):
            named = "; ".join(f"{k} by {d:.1f} sd" for k, d in list(m.outlying.items())[:4])
            outlying = f"outlying data ({named}), " if named else ""
            yield (
                f"{name} does not fit, posterior predictive p {min(m.p, m.p_worst):.3f}",
                f"check {outlying}registration, units, law and noise sd",
            )
        elif not m.p <= 1.0 - SMALLEST_P:
            close = f"{name} fits closer than its noise allows, posterior predictive p {m.p:.3f}"
            yield (close, "its noise sd is too large")
