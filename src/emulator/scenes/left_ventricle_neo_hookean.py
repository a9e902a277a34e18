"""The left ventricle of an isotropic material (Dalton et al. 2023, Appendix C)."""

from __future__ import annotations

from emulator.geometry.bodies.ellipsoid import human_ventricle
from emulator.mechanics.laws import find_law
from emulator.scenes.left_ventricle import PRESSURE
from emulator.scenes.loads import CavityPressure
from emulator.scenes.parameter_space import Parameter
from emulator.scenes.scene import Scene
from emulator.scenes.supports import Support


def left_ventricle_neo_hookean(rings: int = 15, around: int = 30, layers: int = 3) -> Scene:
    """Neo-Hookean ventricle under cavity pressure, its base held, with no fibres at all.

    theta = (mu, lam, pressure). The geometry is that of
    :func:`~emulator.scenes.left_ventricle.left_ventricle`. The appendix was not at hand: ``mu`` 4
    to 12 kPa and ``lam`` 40 to 120 kPa are ours.

    Parameters
    ----------
    rings, around, layers : of the mesh, as in
        :func:`~emulator.geometry.bodies.ellipsoid.truncated_ellipsoid`; the default has 1564 nodes.
    """
    return Scene(
        name="left_ventricle_neo_hookean",
        mesh=human_ventricle(rings, around, layers),
        law=find_law("neo_hookean"),
        parameters=(
            Parameter("mu", "kPa", 4.0, 12.0, "log"),
            Parameter("lam", "kPa", 40.0, 120.0, "log"),
            PRESSURE,
        ),
        loads=(CavityPressure("endocardium"),),
        supports=(Support("base"),),
        origin={
            "scene": "left_ventricle_neo_hookean",
            "rings": rings,
            "around": around,
            "layers": layers,
        },
    )
