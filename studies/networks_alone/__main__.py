"""Networks alone: how accurate are the shipped ones?

    python -m studies.networks_alone
    python -m studies.networks_alone --quick --out DIR    # the beam, few theta

The shipped networks, which sweeps have taught, and the series shipped beside them are judged by FEM
at theta that none has seen. Writes results.json, after each body, and networks.png beside itself or
under --out; bodies that results.json holds already are not repeated (--again). Asserts what the
README says.
"""

from pathlib import Path
from typing import Any

import numpy as np
from studies.common.figures import BLUE, ORANGE, pyplot
from studies.common.output import Case, Results, parser, save

import emulator as em

HERE = Path(__file__).parent
TEST_SEED = 90_210
SCENES = ("once_clamped_beam", "twisting_cube", "liver", "left_ventricle")
ERRORS = ("err_u", "err_F", "err_Pi", "err_V")
PAPER = {
    "once_clamped_beam": 2.0e-2,
    "twisting_cube": 8.5e-4,
    "liver": 8.8e-3,
    "left_ventricle": 2.8e-2,
}
"""The paper's err_u, mm (of the cube, 8.5e-5 of its edge of 10 mm)."""


def errors_of(emulator: em.Emulator, tests: int) -> Case:
    """Quantiles of the errors against FEM at theta that nothing was trained on."""
    thetas = em.fem.sobol(emulator.scene, tests, TEST_SEED)
    known = em.fem.run_campaign(em.Simulator(emulator.scene), thetas)
    found = em.evaluate(emulator.cache(), known.theta, known.displacement)
    return {key: found[key] for key in ERRORS if key in found}


def alone(name: str, tests: int) -> Case:
    """How accurate the shipped network of scene ``name`` is, and the series shipped beside it."""
    network = em.load(name)
    assert "network" in network.parts
    record = network.record
    return {
        "parts": list(network.parts),
        "command": record["command"],
        "seconds": record["seconds"],
        "sweeps": record["sweeps"]["number"],
        "tests": tests,
        "network": errors_of(network, tests),
        "shipped": errors_of(em.load(name, kind="series"), tests),
    }


def draw(cases: list[Case], path: Path) -> None:
    """Median and largest errors of displacement, the paper's beside them."""
    figure, axes = pyplot().subplots(figsize=(7.0, 3.0), layout="constrained")
    y = np.arange(len(cases))
    for key, label, colour, up in (
        ("network", "network", BLUE, -0.1),
        ("shipped", "series", ORANGE, 0.1),
    ):
        rows: list[Any] = [case[key]["err_u"] for case in cases]
        middle, most = ([row[q] for row in rows] for q in ("median", "max"))
        axes.hlines(y + up, middle, most, color=colour)
        axes.plot(middle, y + up, "o", color=colour, label=f"{label}: median to largest")
    axes.plot(
        [PAPER[case["name"]] for case in cases], y, "|", color="0.3", ms=14, label="the paper's"
    )
    axes.set(xscale="log", xlabel="err_u, mm")
    axes.set_yticks(y, [case["name"].replace("_", " ") for case in cases])
    axes.invert_yaxis()
    axes.legend(frameon=False, fontsize=8)
    axes.spines[["top", "right"]].set_visible(False)
    save(figure, path)


def main() -> None:
    """Run the study."""
    given = parser(__doc__, HERE).parse_args()
    tests = 3 if given.quick else 50
    results = Results(given.out, TEST_SEED, again=given.again)
    for name in SCENES[:1] if given.quick else SCENES:
        results.case(name, lambda name=name: alone(name, tests))
    draw(results.cases, given.out / "networks.png")
    for case in results.cases:
        assert case["network"]["err_u"]["median"] < 0.1 * PAPER[case["name"]]


if __name__ == "__main__":
    main()
