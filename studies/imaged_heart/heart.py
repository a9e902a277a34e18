"""The heart that is imaged, and the scene a modeller makes of the image.

Truth: the built-in ventricle at rest, finely meshed, its theta not told. Muscle develops 30 % of
its tension across the fibre; with none, a wall of one constant tension snaps from 190 to 40 mL.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

import emulator as em

KAPPA, TRANSVERSE = 350.0, 0.3
ANGLES = ("endo", "epi")
FILLED = 12.0  # mmHg, the most that a wall is asked to bear without tension
FINE, COARSE = (10, 24, 2), (5, 12, 1)  # rings, around, layers: of the truth, of the model
_STATES = ("filling", "systole")
_IMAGED_UNDER = {"pressure": "imaged", "systolic": "imaged", "tension": "slack"}
_MMHG = em.loads.KPA_PER_MMHG

MUSCLE = (
    *em.scenes.left_ventricle(3, 6, 1).parameters[:4],
    em.Parameter("endo", "deg", 40.0, 80.0),
    em.Parameter("epi", "deg", -80.0, -40.0),
)
"""Stiffness, and angles as the built-in ventricle has them."""
PRESSURE = em.Parameter("pressure", "kPa", 0.0, FILLED * _MMHG)
SYSTOLIC = em.Parameter("systolic", "kPa", 85.0 * _MMHG, 115.0 * _MMHG)
TENSION = em.Parameter("tension", "kPa", 60.0, 110.0)
IMAGED = em.Parameter("imaged", "kPa", 5.0 * _MMHG, 15.0 * _MMHG)


@lru_cache
def at_rest() -> em.Scene:
    """The true heart without loads; theta is MUSCLE, pressure, tension."""
    scene = em.scenes.left_ventricle(*FINE, angles=ANGLES, kappa=KAPPA)
    cavity = em.loads.CavityPressure("endocardium")
    return replace(
        scene,
        loads=(cavity, em.loads.ActiveTension(transverse=TRANSVERSE)),
        parameters=(
            *MUSCLE,
            replace(SYSTOLIC, name="pressure", low=0.0),
            replace(TENSION, low=0.0),
        ),
        dilatation="mean",
        origin={},
    )


def template() -> em.Mesh:
    """The model's mesh before it is fitted to an image."""
    return em.scenes.left_ventricle(*COARSE).mesh


def imaged(mesh: em.Mesh, *, loaded: bool = True) -> em.Scene:
    """The heart of an image, twice: as it fills, and as it contracts.

    theta is MUSCLE, the pressure in the image, that of filling, that of systole, and the tension.
    The two share the material, and nothing else: each has its own range of loads to be learned.

    loaded : ``False`` to take the image for the shape at rest; then theta has no pressure in it.
    """
    bodies = em.side_by_side(dict.fromkeys(_STATES, mesh), gap=20.0)
    walls = {
        wall: np.concatenate([bodies.mesh.facet_sets[f"{state}.{wall}"] for state in _STATES])
        for wall in ("endocardium", "epicardium")
    }
    both = replace(bodies.mesh, facet_sets={**bodies.mesh.facet_sets, **walls})
    rule = em.scenes.Helix(ANGLES)
    cavities = {"filling": "pressure", "systole": "systolic"}
    return em.Scene(
        name="imaged_heart",
        mesh=both,
        law=em.find_law("holzapfel_ogden"),
        parameters=(*MUSCLE, *((IMAGED,) if loaded else ()), PRESSURE, SYSTOLIC, TENSION),
        loads=(
            *(
                em.loads.CavityPressure(f"{s}.endocardium", parameter=p)
                for s, p in cavities.items()
            ),
            em.loads.ActiveTension(transverse=TRANSVERSE, within="systole.endocardium"),
        ),
        supports=tuple(em.Support(f"{state}.base") for state in _STATES),
        constants={"kappa": KAPPA, **({"slack": 0.0} if loaded else {})},
        fibres=rule.directions(both)[0],
        fibre_rule=rule,
        angles=rule.angles_in(both),
        dilatation="mean",
        loaded_by=_IMAGED_UNDER if loaded else {},
    )
