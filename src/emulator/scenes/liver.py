"""A liver hanging from its ligament (Dalton et al. 2023, Section 3.3)."""

from __future__ import annotations

from emulator.geometry.bodies.organ import organ
from emulator.mechanics.laws import find_law
from emulator.scenes.loads import Gravity
from emulator.scenes.parameter_space import Parameter
from emulator.scenes.scene import Scene
from emulator.scenes.supports import Support


def liver(shells: int = 6) -> Scene:
    """A liver-like body held at its ligament and bending under its own weight.

    theta = (lam, mu), each 3.5 to 10 kPa, density 1 g/cm3 and g = 9.80 m/s2 as published; the body
    is idealised (``published:Liver`` is the released geometry).

    Parameters
    ----------
    shells : of the mesh, as in :func:`~emulator.geometry.bodies.organ.organ`; 6 give 923 nodes.
    """
    return Scene(
        name="liver",
        mesh=organ(shells=shells),
        law=find_law("neo_hookean"),
        parameters=(
            Parameter("lam", "kPa", 3.5, 10.0, "log"),
            Parameter("mu", "kPa", 3.5, 10.0, "log"),
        ),
        loads=(Gravity(density=1.0, direction=(0.0, 0.0, -1.0), acceleration=9.80),),
        supports=(Support("ligament"),),
        origin={"scene": "liver", "shells": shells},
    )
