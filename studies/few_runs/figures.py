"""The study's figures."""

from pathlib import Path

from studies.common.output import save
from studies.few_runs.accuracy import OVER, PLAIN, POSITIONS, RIVAL, SERIES, VALUES
from studies.few_runs.tables import WANTED, median, mesh_totals, rows, scenes

from calibrate.figures import pyplot

STYLES = {
    SERIES: ("tab:blue", "*", 13),
    OVER: ("tab:blue", "o", 6),
    PLAIN: ("tab:cyan", "s", 5),
    RIVAL: ("tab:orange", "D", 6),
}
ABLATED = {
    f"{OVER}, {POSITIONS}": ("0.35", "v"),
    f"{OVER}, {VALUES}": ("tab:green", "^"),
    f"{PLAIN}, {POSITIONS}": ("tab:purple", "<"),
    f"{PLAIN}, {VALUES}": ("tab:olive", ">"),
    f"{PLAIN}, {VALUES}, {POSITIONS}": ("tab:red", "x"),
}


def _panels(cases: list[dict]):
    plt = pyplot()
    names = scenes(cases)
    figure, panels = plt.subplots(
        1, len(names), figsize=(5.6 * len(names) + 2.6, 4.8), sharey=True, squeeze=False,
        layout="constrained",
    )  # fmt: skip
    for axes, name in zip(panels[0], names, strict=True):
        axes.set(xscale="log", yscale="log", title=name)
        axes.grid(alpha=0.25, which="both")
    panels[0, 0].set_ylabel("median displacement error (mm)")
    return figure, list(zip(panels[0], names, strict=True))


def _finish(figure, axes, path: Path) -> None:
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    save(figure, path)


def draw_runs(cases: list[dict], path: Path) -> None:
    """Error against the number of FEM runs."""
    figure, panels = _panels(cases)
    for axes, name in panels:
        for method, (colour, marker, size) in STYLES.items():
            found = rows(cases, name, method)
            errors = [median(case) for case in found]
            runs = [case["runs"] for case in found]
            axes.plot(runs, errors, marker=marker, ms=size, color=colour, label=method)
            if method in (OVER, RIVAL):
                mean = [case["err_u_mm"]["mean"] for case in found]
                label = "mean instead of median"
                axes.plot(runs, mean, ":", color=colour, lw=1, label=f"{method}, {label}")
        for method, (colour, marker) in ABLATED.items():
            found = rows(cases, name, method)
            axes.plot(
                [case["runs"] for case in found], [median(case) for case in found], marker,
                ls="--", lw=0.7, ms=5, color=colour, label=method,
            )  # fmt: skip
        axes.set(xlabel="FEM runs, the centre's included")
    _finish(figure, panels[-1][0], path)


def draw_time(cases: list[dict], path: Path) -> None:
    """Error against all time spent."""
    figure, panels = _panels(cases)
    for axes, name in panels:
        for method, (colour, marker, size) in STYLES.items():
            found = rows(cases, name, method)
            seconds = [case["total_s"]["processor"] for case in found]
            errors = [median(case) for case in found]
            axes.plot(seconds, errors, marker=marker, ms=size, color=colour, label=method)
            for case, x, y in zip(found, seconds, errors, strict=True):
                if method in (OVER, RIVAL):
                    axes.annotate(
                        str(case["runs"]), (x, y), xytext=(5, 5), textcoords="offset points",
                        fontsize=8, color=colour,
                    )  # fmt: skip
        axes.set(xlabel="processor time, compilation and fit included (s); numbers: FEM runs")
    _finish(figure, panels[-1][0], path)


def draw_meshes(cases: list[dict], path: Path) -> None:
    """Time to the wanted error against the size of the mesh."""
    plt = pyplot()
    found = mesh_totals(cases)
    figure, axes = plt.subplots(figsize=(6.4, 4.4), layout="constrained")
    nodes = [row["nodes"] for row in found]
    axes.plot(nodes, [row["ours_s"] for row in found], "o-", color="tab:blue", label="ours")
    axes.plot(nodes, [row["rival_s"] for row in found], "D-", color="tab:orange", label=RIVAL)
    axes.set(
        xscale="log", yscale="log", xlabel="nodes",
        ylabel=f"processor time to {WANTED:g} mm, median (s)", title="left_ventricle, by mesh",
    )  # fmt: skip
    axes.grid(alpha=0.25, which="both")
    axes.legend(frameon=False)
    save(figure, path)
