"""A liver hanging from its ligament (Dalton et al. 2023, Section 3.3)."""

from __future__ import annotations

from typing import Any

from emulator.geometry.generators.body import resolved
from emulator.geometry.generators.sphere import organ
from emulator.mechanics.laws import find_law
from emulator.scenes.loads import Gravity
from emulator.scenes.parameter_space import Parameter
from emulator.scenes.scene import Scene
from emulator.scenes.supports import ElasticSupport, Support

_SIZES: dict[int, dict[str, Any]] = {
    1: {"shells": 6, "clustering": 0.0, "ligament_shells": 6, "ligament": None},
    2: {"shells": 5, "clustering": 0.5, "ligament_shells": 5, "ligament": 2.0},
}
"""Mesh by default, as in :func:`~emulator.geometry.generators.sphere.organ`, and the ligament's
stiffness: 923 linear nodes, 3871 quadratic ones."""


def liver(
    shells: int | None = None,
    order: int = 2,
    clustering: float | None = None,
    ligament_shells: int | None = None,
    ligament: float | None = None,
) -> Scene:
    """A liver-like body held at its ligament and bending under its own weight.

    theta = (lam, mu), each 3.5 to 10 kPa, density 1 g/cm3 and g = 9.80 m/s2 as published; the body
    is idealised (``published:Liver`` is the released geometry).

    Parameters
    ----------
    shells, clustering, ligament_shells : the resolution of the mesh, as in
        :func:`~emulator.geometry.generators.sphere.organ`; by default what the elements' order
        needs.
    order : the order of the elements.
    ligament : its stiffness in kPa/mm, 2 by default. Linear elements have it clamped by default, as
        published: stresses are then infinite at its edge, and no mesh for daily use is right there
        (six shells of quadratic elements are 0.5 mm off).
    """
    sizes = {"shells": shells, "clustering": clustering, "ligament_shells": ligament_shells}
    resolution = resolved(_SIZES, order, **sizes, ligament=ligament)
    stiffness = resolution.pop("ligament")
    support = Support("ligament") if stiffness is None else ElasticSupport("ligament", stiffness)
    return Scene(
        name="liver",
        mesh=organ(**resolution),
        law=find_law("neo_hookean"),
        parameters=(
            Parameter("lam", "kPa", 3.5, 10.0, "log"),
            Parameter("mu", "kPa", 3.5, 10.0, "log"),
        ),
        loads=(Gravity(density=1.0, direction=(0.0, 0.0, -1.0), acceleration=9.80),),
        supports=(support,),
        origin={"scene": "liver", **resolution, "ligament": stiffness},
    )
