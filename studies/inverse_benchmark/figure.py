"""The benchmark's figure: distance from the reference by problem, and against processor time."""

from pathlib import Path

from studies.common.figures import COLOURS, pyplot
from studies.common.output import Case, save
from studies.inverse_benchmark.problems import PROBLEMS

MARKS = "osv^DXP*<>"


def draw(cases: list[Case], path: Path) -> None:
    """Left, every problem's distance; right, the median's against processor time."""
    plt = pyplot()
    figure, (each, time) = plt.subplots(
        1, 2, figsize=(12, 5), layout="constrained", sharey=True, width_ratios=(2, 1)
    )
    names = list(PROBLEMS)
    for k, case in enumerate(sorted(cases, key=lambda case: case["sliced"])):
        style = {"color": COLOURS[k % 7], "marker": MARKS[k % 10], "ls": "none", "mfc": "none"}
        x = [names.index(name) + 0.06 * (k - 4) for name in case["scores"]]
        y = [one["sliced"] for one in case["scores"].values()]
        each.plot(x, y, label=case["entry"], **style)
        if case["processor_s"] is not None:
            time.plot(case["processor_s"], case["sliced"], **style)
    floors = {n: one["floor"] for case in cases for n, one in case["scores"].items()}
    if floors:
        each.plot([names.index(n) for n in floors], list(floors.values()), "_", color="0.3", ms=18,
                  label="floor: as many draws of the reference")  # fmt: skip
    each.set_xticks(
        range(len(names)),
        [name.replace("displacements", "displ.").replace("_", "\n") for name in names],
        fontsize=8,
    )
    each.set(yscale="log", ylabel="sliced Wasserstein distance (posterior sd)")
    time.set(xscale="log", xlabel="processor time a problem (s), median")
    time.set_xticks([3, 10, 30, 100, 300], ["3", "10", "30", "100", "300"], minor=False)
    time.minorticks_off()
    each.set_yticks([0.05, 0.1, 0.2, 0.5], ["0.05", "0.1", "0.2", "0.5"])
    for axes in (each, time):
        axes.grid(color="0.92")
        axes.spines[["top", "right"]].set_visible(False)
    figure.legend(
        *each.get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False
    )
    save(figure, path)
