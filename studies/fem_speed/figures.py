"""The study's figure and tables."""

from pathlib import Path

from studies.common.figures import pyplot
from studies.common.output import Case, save
from studies.fem_speed.peers import PROGRAMS

OURS = "ours"
PEERS = tuple(PROGRAMS)
COLOURS = dict(zip((OURS, *PEERS), ("tab:blue", "tab:orange", "tab:green"), strict=True))


def draw(cases: list[Case], path: Path) -> None:
    """Times of the pressurised body; of a beam by three codes; and of cubes, with memory."""
    plt = pyplot()
    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(17, 4.6), layout="constrained")
    beams = [case for case in cases if "beam_s" in case]
    for style, of in (("o-", "linear"), ("s--", "quadratic")):
        mine = [case for case in beams if case["name"].startswith(f"beam, {of}")]
        for code, colour in COLOURS.items() if mine else ():
            seconds = [case["beam_s"] if code == OURS else case[code]["seconds"] for case in mine]
            label = f"{code}, {of} tetrahedra"
            middle.plot([c["nodes"] for c in mine], seconds, style, color=colour, label=label)
    middle.set(xscale="log", yscale="log", xlabel="nodes", ylabel="from rest (s)")
    middle.xaxis.set_minor_formatter("")
    middle.set_title("a thick beam under its weight")
    middle.grid(alpha=0.25, which="both")
    if beams:
        middle.legend(frameon=False)
    bars = [case for case in cases if "median_s" in case]
    names = [case["name"] for case in bars]
    colours = ["tab:blue" if name.startswith("ours") else "0.6" for name in names]
    left.barh(names, [case["median_s"] for case in bars], color=colours)
    left.invert_yaxis()
    left.set(xscale="log", xlabel="median time of one call (s)", title=bars[0]["problem"])
    for k, case in enumerate(bars):
        left.annotate(f" {case['median_s']:.3g} s", (case["median_s"], k), va="center", fontsize=9)
    left.margins(x=0.15)
    cubes = [case for case in cases if "cold_s" in case]
    nodes = [case["nodes"] for case in cubes]
    right.plot(nodes, [case["cold_s"] for case in cubes], "o-", label="solve from rest (s)")
    right.plot(nodes, [case["compile_s"] for case in cubes], "^:", label="compilation (s)")
    right.plot(nodes, [case["peak_gb"] for case in cubes], "s--", label="peak memory (GB)")
    right.set(xscale="log", yscale="log", xlabel="nodes", title="twisting cube")
    right.grid(alpha=0.25)
    right.legend(frameon=False)
    save(figure, path)


def table(head: str, rows: list[list[str]]) -> list[str]:
    """Lines of a table, and one below it."""
    columns = head.count("|") - 1
    return [head, "|---" * columns + "|", *("| " + " | ".join(row) + " |" for row in rows), ""]


def tables(cases: list[Case]) -> str:
    """The README's tables."""
    codes = [
        [
            case["name"],
            f"{case['median_s']:.3f} s",
            f"{case['compile_s']:.1f} s" if "compile_s" in case else "none",
            f"{case['iterations']:.0f}" if "iterations" in case else "",
        ]
        for case in cases
        if "median_s" in case
    ]
    solves = [
        [
            case["name"].removesuffix(", from rest"),
            str(case["nodes"]),
            f"{1e3 * case['python_s']:.0f} ms",
            f"{1e3 * case['jit_s']:.0f} ms",
            f"{case['iterations']}, {case['factorisations']}",
            *(f"{100.0 * share:.0f} %" for share in case["shares"].values()),
            f"{100.0 * (1.0 - sum(case['shares'].values())):.0f} %",
        ]
        for case in cases
        if "shares" in case
    ]
    beside = [
        [
            case["name"].removesuffix(", beside FEniCSx"),
            *(f"{1e3 * case[k]:.0f} ms" for k in ("ours_s", "fenicsx_s")),
            f"{case['times_as_long']:.1f}",
            *(f"{1e3 * case[k]:.0f} ms" for k in ("ours_warm_s", "fenicsx_warm_s")),
            f"{case['difference']:.0e}",
            str(case["gave_up"]),
        ]
        for case in cases
        if "fenicsx_s" in case
    ]
    beams = [
        [
            case["name"].removeprefix("beam, "),
            str(case["nodes"]),
            f"{case['beam_s']:.2f} s",
            *(f"{case[c]['seconds']:.2f} s, {case[c]['times_as_long']:.1f}" for c in PEERS),
            f"{case['beam_gradient_s']:.2f} s",
            f"{case['torch-fem']['gradient_s']:.2f} s",
            f"{case['iterations']}, {case['factorisations']}",
            f"{max(case[code]['difference'] for code in PEERS):.0e}",
        ]
        for case in cases
        if "beam_s" in case
    ]
    alike = [
        [
            case["name"].removesuffix(", Python and jit"),
            str(case["thetas"]),
            str(case["same_iterations"]),
            f"{case['largest_difference']:.0e}",
        ]
        for case in cases
        if "thetas" in case
    ]
    cubes = [
        [
            str(case["nodes"]),
            str(case["elements"]),
            f"{case['cold_s']:.2f} s",
            f"{case['compile_s']:.1f} s",
            str(case["iterations"]),
            f"{case['peak_gb']:.2f} GB",
        ]
        for case in cases
        if "cold_s" in case
    ]
    return "\n".join(
        [
            *table("| | median | compilation, once | iterations |", codes),
            *table(
                "| from rest | nodes | Python | inside `jit` | iterations, factorisations | "
                "assembling | factorising | substituting | the rest |",
                solves,
            ),
            *table(
                "| beside FEniCSx | ours | FEniCSx | times as long | ours, warm | FEniCSx, "
                "warm | difference | FEniCSx gave up |",
                beside,
            ),
            *table(
                "| thick beam | nodes | ours | torch-fem, times as long | FElupe, times as long | "
                "gradient, ours | torch-fem | iterations, factorisations | difference |",
                beams,
            ),
            *table("| Python and `jit` | theta | as many iterations | largest difference |", alike),
            *table(
                "| nodes | tetrahedra | from rest | compilation, once | iterations | peak memory |",
                cubes,
            ),
        ]
    )
