"""What several test modules build with."""

from dataclasses import replace

import numpy as np

from emulator.geometry.generators.box import box
from emulator.mechanics.laws import find_law
from emulator.scenes import Parameter, Scene, Support
from emulator.scenes.loads import Gravity


def block(
    *,
    loads: tuple[Gravity, ...] = (),
    supports: tuple[Support, ...] = (Support("left"),),
    cells=(2, 2, 2),
) -> Scene:
    """A small Neo-Hookean block with whatever loads and supports a test wants."""
    return Scene(
        name="block",
        mesh=box((2.0, 3.0, 4.0), cells),
        law=find_law("neo_hookean"),
        parameters=(
            Parameter("mu", "kPa", 1.0, 10.0, "log"),
            Parameter("lam", "kPa", 1.0, 10.0, "log"),
        ),
        loads=loads,
        supports=supports,
    )


HEIGHT = 4.0  # mm, of the block between plates


def between_plates(order=2, dilatation="pointwise", cells=(2, 2, 2), **changes) -> Scene:
    """A block glued to two plates, of which the upper one is moved: shear along x, stretch."""
    scene = Scene(
        name="block between plates",
        mesh=box((4.0, 4.0, HEIGHT), cells, order),
        law=find_law("neo_hookean"),
        parameters=(
            Parameter("mu", "kPa", 1.0, 10.0, "log"),
            Parameter("shear", "", -0.5, 0.5),
            Parameter("stretch", "", -0.2, 0.2),
        ),
        constants={"lam": 8.0},
        supports=(
            Support("bottom"),
            Support("top", (HEIGHT, 0.0, 0.0), "x", amount="shear"),
            Support("top", (0.0, 0.0, HEIGHT), "z", amount="stretch"),
            Support("top", components="y"),
        ),
        dilatation=dilatation,
    )
    return replace(scene, **changes)


MU, LAM = Parameter("mu", "kPa", 3.5, 10.0, "log"), Parameter("lam", "kPa", 3.5, 10.0, "log")


def hanging_block() -> Scene:
    """A Neo-Hookean block that hangs under its weight; theta = (mu, lam)."""
    return Scene(
        name="hanging",
        mesh=box((20.0, 10.0, 10.0), (2, 1, 1)),
        law=find_law("neo_hookean"),
        parameters=(MU, LAM),
        loads=(Gravity(density=1.0, direction=(0.0, 0.0, -1.0), acceleration=9.80),),
        supports=(Support("left"),),
    )


def rotation(seed: int = 0) -> np.ndarray:
    """A proper rotation, far from the identity."""
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else -q


def slope(steps: np.ndarray, errors: np.ndarray) -> float:
    """Order of convergence: slope of log error over log step."""
    return float(np.polyfit(np.log(steps), np.log(errors), 1)[0])
