"""Two ventricles filling in diastole (Dalton et al. 2023, Appendix D)."""

from __future__ import annotations

from emulator.geometry.bodies import biventricle as geometry
from emulator.geometry.fibres import biventricular_directions
from emulator.mechanics.laws import find_law
from emulator.scenes.left_ventricle import HELIX, MYOCARDIUM, PRESSURE
from emulator.scenes.loads import KPA_PER_MMHG, CavityPressure
from emulator.scenes.scene import Scene
from emulator.scenes.supports import Support


def biventricle(
    rings: int = 15,
    around: int = 32,
    layers: tuple[int, int] = (3, 2),
    angles: tuple[float, float] = HELIX,
    kappa: float = 25.0,
    right_pressure: float = 2.0 * KPA_PER_MMHG,
) -> Scene:
    """Holzapfel-Ogden ventricles, each under its own cavity pressure, their base held.

    theta = (a, b, a_f, b_f, pressure), ranges and ``kappa`` as in
    :func:`~emulator.scenes.left_ventricle.left_ventricle`; ``pressure`` is the left ventricle's.
    We had no access to the appendix: the geometry is idealised, and the right pressure, 2 mmHg by
    default, is our choice; as in a healthy heart it is below every left pressure of the range.

    Parameters
    ----------
    rings, around, layers : of the mesh, as in
        :func:`~emulator.geometry.bodies.biventricle.biventricle`.
    angles : helix angle in degrees on the endocardia and on the epicardium.
    kappa : resistance to volume change, kPa.
    right_pressure : in the right ventricle, kPa.
    """
    mesh = geometry.biventricle(rings=rings, around=around, layers=layers)
    return Scene(
        name="biventricle",
        mesh=mesh,
        law=find_law("holzapfel_ogden"),
        parameters=(*MYOCARDIUM, PRESSURE),
        loads=(
            CavityPressure("lv_endocardium"),
            CavityPressure("rv_endocardium", parameter="right_pressure"),
        ),
        supports=(Support("base"),),
        constants={"kappa": kappa, "right_pressure": right_pressure},
        fibres=biventricular_directions(mesh, angles).fibres,
        origin={
            "scene": "biventricle",
            "rings": rings,
            "around": around,
            "layers": list(layers),
            "angles": list(angles),
            "kappa": kappa,
            "right_pressure": right_pressure,
        },
    )
