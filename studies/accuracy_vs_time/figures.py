"""The study's figures: errors against time, a row a body, and the posterior's error."""

from pathlib import Path
from typing import Any

import numpy as np
from studies.common.figures import pyplot
from studies.common.output import Case, save

# Colours and shapes that differ for every reader (Okabe and Ito 2008).
STYLES = {
    "FEM": ("#009E73", "s"),
    "FEniCSx": ("#000000", "x"),
    "polished": ("#56B4E9", "D"),
    "emulator": ("#0072B2", "o"),
    "series": ("#E69F00", "^"),
    "network": ("#CC79A7", "P"),
    "POD + GP": ("#D55E00", "v"),
}
DECADE = 10.0
LEAST = 1e-12  # mm; a smaller error is drawn here
SOONEST = 1.0  # s; what needs nothing before is drawn here
KINDS = {
    "polished": "+ Newton steps",
    "emulator": "series + discrepancy",
    "network": "graph network",
}
LABELS = {"own_mm": "from FEM on the same mesh", "truth_mm": "from a much finer mesh"}


def front(points: np.ndarray) -> np.ndarray:
    """Pareto front: the rows (time, error) that no other row beats in both, by time."""
    best = [row for row in points if not ((points <= row).all(1) & (points < row).any(1)).any()]
    return np.array(sorted(map(tuple, best)))


def draw(cases: list[Case], path: Path) -> None:
    """Error against the time of a value with gradient; a row a body, a column an error."""
    bodies = list(dict.fromkeys(case["body"] for case in cases))
    figure, panels = pyplot().subplots(
        len(bodies), 2, figsize=(7.2, 2.4 * len(bodies) + 1.0), layout="constrained", squeeze=False
    )
    for row, body in zip(panels, bodies, strict=True):
        found = [case for case in cases if case["body"] == body]
        for axes, key in zip(row, LABELS, strict=True):
            known = [case for case in found if case[key]]
            _panel(axes, known, key) if known else axes.set_axis_off()
        nodes = next(case["nodes"] for case in found if case["own_mm"])
        row[0].set_ylabel(f"{body}, {nodes} nodes\nerror (mm)")
    for axes, label in zip(panels[0], LABELS.values(), strict=True):
        axes.set_title(label, fontsize=10)
    for axes in panels[-1]:
        axes.set_xlabel("value and gradient (ms)")
    shown = {
        label: handle
        for axes in panels.flat
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    figure.legend(
        shown.values(), shown, loc="outside lower center", ncols=4, frameon=False, fontsize=9
    )
    save(figure, path, dpi=160)


def _panel(axes: Any, cases: list[Case], key: str) -> None:
    points = np.array([(1e3 * c["gradient_s"], max(c[key]["median"], LEAST)) for c in cases])
    best = front(points)
    axes.step(best[:, 0], best[:, 1], where="post", color="0.6", lw=1, label="Pareto front")
    for kind, (colour, mark) in STYLES.items():
        for narrow in (False, True):
            rows = [
                k
                for k, case in enumerate(cases)
                if case["kind"] == kind and case["rung"].endswith("float32") == narrow
            ]
            if rows:
                fill = {"mfc": colour, "ms": 4} if narrow else {"mfc": "none", "ms": 6}
                label = f"{kind}, float32" if narrow else kind
                axes.plot(*points[rows].T, mark, color=colour, ls="", label=label, **fill)
    axes.set(xscale="log", yscale="log")
    low, high = points[:, 1].min(), points[:, 1].max()
    if high < DECADE * low:  # what differs by less is the same, and looks so
        axes.set_ylim(low / DECADE**0.5, high * DECADE**0.5)
    axes.grid(color="0.92")
    axes.spines[["top", "right"]].set_visible(False)


def draw_training(cases: list[Case], path: Path) -> None:
    """Error on the mesh against what comes before the first value; a panel a body."""
    bodies = list(dict.fromkeys(case["body"] for case in cases))
    figure, panels = pyplot().subplots(
        2, (len(bodies) + 1) // 2, figsize=(8.6, 7.0), layout="constrained", squeeze=False
    )
    for axes, body in zip(panels.flat, bodies, strict=False):
        wide = [case for case in cases if not case["rung"].endswith("float32")]
        shown = [case for case in wide if case["body"] == body and case["own_mm"]]
        mesh = next(case["truth_mm"]["median"] for case in shown if case["truth_mm"])
        axes.axhline(mesh, color="0.6", lw=1, ls="--", label="the mesh's error")
        for kind, (colour, mark) in STYLES.items():
            for runs in (True, False):
                rows = [
                    (max(case["offline_s"], SOONEST), max(case["own_mm"]["median"], LEAST))
                    for case in shown
                    if case["kind"] == kind and bool(case["fem_runs"]) == runs
                ]
                if rows:
                    free = kind in ("network", "polished") and not runs
                    label = f"{KINDS.get(kind, kind)}{', no simulation' if free else ''}"
                    fill = colour if free else "none"
                    axes.plot(*np.array(rows).T, mark, color=colour, mfc=fill, ls="", label=label)
        axes.set(xscale="log", yscale="log", title=body, xlim=(0.6 * SOONEST, None))
        axes.grid(color="0.92")
        axes.spines[["top", "right"]].set_visible(False)
    for axes in panels[-1]:
        axes.set_xlabel(f"seconds before the first value (none: at {SOONEST:g})")
    for axes in panels[:, 0]:
        axes.set_ylabel("error on the same mesh (mm)")
    legend = {
        label: handle
        for axes in panels.flat
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    figure.legend(
        legend.values(), legend, loc="outside lower center", ncols=4, frameon=False, fontsize=9
    )
    save(figure, path, dpi=160)


def draw_posteriors(cases: list[Case], path: Path) -> None:
    """Largest shift of a mean, and largest change of an sd, against the whole time."""
    figure, panels = pyplot().subplots(1, 2, figsize=(11, 5.2), layout="constrained")
    for number, case in enumerate(cases, start=1):
        colour, mark = STYLES[case["kind"]]
        total = case["offline_s"] + case["sampling_s"] + case.get("certifying_s", 0.0)
        sampler = case["posterior"].rpartition(", ")[2]
        fill = "none" if sampler == "NUTS" else colour
        for axes, value in zip(
            panels, (case["largest_shift"], np.expm1(case["largest_log_sd"])), strict=True
        ):
            label = f"{number}  {case['posterior']}"
            axes.plot(total, value, mark, color=colour, mfc=fill, ms=8, ls="", label=label)
            axes.annotate(str(number), (total, value), xytext=(6, 4), textcoords="offset points")
    panels[0].set_ylabel("largest shift of a mean (posterior sd)")
    panels[1].set_ylabel("largest relative change of an sd")
    for axes in panels:
        # Monte Carlo error of a thousand effective draws.
        axes.axhspan(0, 2.0 / np.sqrt(1000), color="0.93")
        axes.set(
            xscale="log",
            yscale="log",
            xlabel="seconds from mesh and data to draws, or to their certificate",
        )
        axes.grid(color="0.92")
        axes.spines[["top", "right"]].set_visible(False)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2, frameon=False, fontsize=9)
    save(figure, path)
