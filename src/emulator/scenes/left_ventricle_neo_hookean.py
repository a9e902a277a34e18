"""A left ventricle of isotropic material (Dalton et al. 2023, Appendix C)."""

from __future__ import annotations

from emulator.geometry.generators.ellipsoid import human_ventricle
from emulator.mechanics.laws import find_law
from emulator.scenes.left_ventricle import PRESSURE, SIZES
from emulator.scenes.loads import CavityPressure
from emulator.scenes.parameter_space import Parameter
from emulator.scenes.resolution import resolved
from emulator.scenes.scene import Scene
from emulator.scenes.supports import Support


def left_ventricle_neo_hookean(
    rings: int | None = None,
    around: int | None = None,
    layers: int | None = None,
    order: int = 2,
    grading: float | None = None,
) -> Scene:
    """Neo-Hookean ventricle under cavity pressure, its base held, without fibres.

    theta = (mu, lam, pressure). Geometry as in
    :func:`~emulator.scenes.left_ventricle.left_ventricle`. We had no access to the appendix: the
    ranges, ``mu`` 4 to 12 kPa and ``lam`` 40 to 120 kPa, are our choice.

    Parameters
    ----------
    rings, around, layers, order, grading : of the mesh, as in ``left_ventricle``.
    """
    made = resolved(SIZES, order, rings=rings, around=around, layers=layers, grading=grading)
    return Scene(
        name="left_ventricle_neo_hookean",
        mesh=human_ventricle(**made),
        law=find_law("neo_hookean"),
        parameters=(
            Parameter("mu", "kPa", 4.0, 12.0, "log"),
            Parameter("lam", "kPa", 40.0, 120.0, "log"),
            PRESSURE,
        ),
        loads=(CavityPressure("endocardium"),),
        supports=(Support("base"),),
        origin={"scene": "left_ventricle_neo_hookean", **made},
    )
