"""How much of the source a reader goes through between a call and the equation it comes to.

``python -m tests.journeys`` prints each journey in :data:`JOURNEYS`: the frames that are open
where the equation is first evaluated, and the files entered on the way, by a call that has ended or
not. Both count what is in ``src/``; imports do not count.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from types import FrameType
from typing import NamedTuple

SRC = Path(__file__).resolve().parents[1] / "src"


class Frame(NamedTuple):
    """One call of a function of this project: its file in ``src`` and its qualified name."""

    file: str
    function: str


class Reached(Exception):
    """The journey has come to its equation."""


def stack(frame: FrameType | None) -> list[Frame]:
    """Return the frames in ``src`` from the outermost call to ``frame``."""
    frames: list[Frame] = []
    while frame is not None:
        code = frame.f_code
        path = Path(code.co_filename)
        if path.is_relative_to(SRC):
            frames.append(Frame(str(path.relative_to(SRC)), code.co_qualname))
        frame = frame.f_back
    return frames[::-1]


class Journey(NamedTuple):
    """The open frames at the equation, and the files entered on the way, in order."""

    frames: list[Frame]
    files: list[str]


def journey(owner: object, name: str, call: Callable[[], object]) -> Journey:
    """Return the way from ``call`` to the first call of the function ``owner.name``.

    The function is replaced on the way, so ``owner`` may be a class, a module or an object.
    """
    original = getattr(owner, name)
    file = str(Path(original.__code__.co_filename).relative_to(SRC))
    frames: list[Frame] = []
    files: dict[str, None] = {}

    def enter(frame: FrameType, event: str, _: object) -> None:
        code = frame.f_code
        if event == "call" and code.co_name != "<module>" and code.co_filename.startswith(str(SRC)):
            files.setdefault(str(Path(code.co_filename).relative_to(SRC)))

    def arrive(*_: object, **__: object) -> object:
        frames.extend([*stack(sys._getframe(1)), Frame(file, original.__qualname__)])
        raise Reached

    replace = type.__setattr__ if isinstance(owner, type) else object.__setattr__
    replace(owner, name, arrive)
    try:
        with suppress(Reached):
            call()  # imports what the way needs, so that decorators and registries do not count
        frames.clear()
        sys.setprofile(enter)
        with suppress(Reached):
            call()
    finally:
        sys.setprofile(None)
        replace(owner, name, original)
    return Journey(frames, list(files))


def solve() -> Journey:
    """Return the way from ``Simulator.solve`` to the strain energy of the law."""
    import emulator as em

    scene = em.scenes.once_clamped_beam(cells=(2, 1, 1), order=1)
    simulator = em.Simulator(scene)
    return journey(scene.law, "energy", lambda: simulator.solve(scene.centre))


NODES = "node,ux,uy,uz\n3,0.5,0.0,-9.0\n7,0.4,0.1,-5.0\n11,0.2,0.0,-2.0\n19,0.1,0.0,-7.0\n"


def infer(then: Callable[[str], object] = lambda _: None) -> None:
    """Run ``calibrate infer`` on a data file, with the shipped emulator of the beam.

    ``then`` is called with the folder of its results.
    """
    from calibrate.cli import main

    with TemporaryDirectory() as folder:
        data = Path(folder) / "nodes.csv"
        data.write_text(NODES)
        words = ["once_clamped_beam", "--data", str(data), "--no-unit-check", "--no-certify"]
        main(["--no-cache", "infer", *words, "--out", f"{folder}/run"])
        then(f"{folder}/run")


def parse() -> Journey:
    """Return the way from ``calibrate infer`` to the reader of its CSV file."""
    from calibrate.measurements import data

    return journey(data, "read_csv", infer)


def likelihood() -> Journey:
    """Return the way from ``calibrate infer`` to the distribution of the data."""
    from calibrate.statistical_model import Model

    return journey(Model, "distributions", infer)


SCENE = """law = "neo_hookean"
mesh = "block.vtu"
supports = [{node_set = "left"}]
loads = [{kind = "gravity"}]
constants = {lam = 30.0}
parameters = {mu = {unit = "kPa", range = [5.0, 20.0]}}
"""


def scene_file() -> Journey:
    """Return the way from ``calibrate simulate file.toml`` to the construction of its scene."""
    from calibrate.cli import main
    from emulator.geometry.generators.box import box
    from emulator.geometry.io import write_mesh
    from emulator.scenes import Scene

    with TemporaryDirectory() as folder:
        write_mesh(f"{folder}/block.vtu", box((2.0, 1.0, 1.0), (2, 1, 1)))
        file = Path(folder) / "file.toml"
        file.write_text(SCENE)
        words = ["--no-cache", "simulate", str(file)]
        return journey(Scene, "__post_init__", lambda: main(words))


def check() -> Journey:
    """Return the way from ``calibrate certify`` to the FEM solve."""
    import emulator as em
    from calibrate.cli import main

    ways: list[Journey] = []

    def certify(folder: str) -> None:
        words = ["--no-cache", "certify", folder, "--draws", "25", "--no-mesh"]
        ways.append(journey(em.Simulator, "solve", lambda: main(words)))

    infer(certify)
    return ways[0]


STATES = "stretch_x,stress_x [kPa]\n1.05,0.9\n1.10,2.0\n1.15,3.4\n1.20,5.2\n"


def specimen() -> Journey:
    """Return the way from the table of a uniaxial test to the distribution of its data."""
    from calibrate.cli import main
    from calibrate.statistical_model import Model

    with TemporaryDirectory() as folder:
        table = Path(folder) / "test.csv"
        table.write_text(STATES)
        main(["--no-cache", "init", str(table), "--out", f"{folder}/scene.toml"])
        words = [
            "--no-cache",
            "infer",
            f"{folder}/scene.toml",
            "--no-certify",
            "--out",
            f"{folder}/run",
        ]
        words.append("--force")
        return journey(Model, "distributions", lambda: main(words))


JOURNEYS: dict[str, tuple[int, Callable[[], Journey]]] = {
    "scene TOML to Scene": (18, scene_file),
    "Simulator.solve to law.energy": (12, solve),
    "calibrate infer to the data file": (35, parse),
    "calibrate infer to the likelihood": (87, likelihood),
    "table of a specimen to the likelihood": (83, specimen),
    "calibrate certify to Simulator.solve": (75, check),
}
"""Journeys by what they lead from and to, each with the most files that it may enter."""


def main() -> None:
    """Print the frames of each journey, and the files entered."""
    for name, (most, travel) in JOURNEYS.items():
        frames, files = travel()
        print(f"{name}: {len(frames)} frames; {len(files)} files entered (at most {most})")
        for frame in frames:
            print(f"  {frame.file:44} {frame.function}")
        print("  entered:", ", ".join(files))


if __name__ == "__main__":
    main()
