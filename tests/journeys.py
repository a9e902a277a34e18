"""How many of this project's frames lie between a call and the equation it comes to.

``python -m tests.journeys`` prints the frames and the files of each journey in
:data:`JOURNEYS`. A journey is the call stack at the moment the equation is first evaluated,
cut to the frames whose code is in ``src/``.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
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


def journey(owner: object, name: str, call: Callable[[], object]) -> list[Frame]:
    """Return the frames from ``call`` to the first call of the function ``owner.name``.

    The function is replaced on the way, so ``owner`` may be a class, a module or an object.
    """
    original = getattr(owner, name)
    file = str(Path(original.__code__.co_filename).relative_to(SRC))
    frames: list[Frame] = []

    def arrive(*_: object, **__: object) -> object:
        frames.extend([*stack(sys._getframe(1)), Frame(file, original.__qualname__)])
        raise Reached

    replace = type.__setattr__ if isinstance(owner, type) else object.__setattr__
    replace(owner, name, arrive)
    try:
        call()
    except Reached:
        pass
    finally:
        replace(owner, name, original)
    return frames


def solve() -> list[Frame]:
    """Return the frames from ``Simulator.solve`` to the strain energy of the law."""
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


def parse() -> list[Frame]:
    """Return the frames from ``calibrate infer`` to the reader of its CSV file."""
    from calibrate.measurements import data

    return journey(data, "read_csv", infer)


def likelihood() -> list[Frame]:
    """Return the frames from ``calibrate infer`` to the distribution of the data."""
    from calibrate.statistical_model import Model

    return journey(Model, "distributions", infer)


SCENE = """law = "neo_hookean"
mesh = "block.vtu"
supports = [{node_set = "left"}]
loads = [{kind = "gravity"}]
constants = {lam = 30.0}
parameters = {mu = {unit = "kPa", range = [5.0, 20.0]}}
"""


def scene_file() -> list[Frame]:
    """Return the frames from ``calibrate simulate file.toml`` to the construction of its scene."""
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


def check() -> list[Frame]:
    """Return the frames from ``calibrate certify`` to the FEM solve."""
    import emulator as em
    from calibrate.cli import main

    frames: list[Frame] = []

    def certify(folder: str) -> None:
        words = ["--no-cache", "certify", folder, "--draws", "25", "--no-mesh"]
        frames.extend(journey(em.Simulator, "solve", lambda: main(words)))

    infer(certify)
    return frames


JOURNEYS: dict[str, Callable[[], list[Frame]]] = {
    "scene TOML to Scene": scene_file,
    "Simulator.solve to law.energy": solve,
    "calibrate infer to the data file": parse,
    "calibrate infer to the likelihood": likelihood,
    "calibrate certify to Simulator.solve": check,
}
"""Journeys by what they lead from and to."""


def main() -> None:
    """Print the frames and the number of files of each journey."""
    for name, travel in JOURNEYS.items():
        frames = travel()
        files = {frame.file for frame in frames}
        print(f"{name}: {len(frames)} frames in {len(files)} files")
        for frame in frames:
            print(f"  {frame.file:44} {frame.function}")


if __name__ == "__main__":
    main()
