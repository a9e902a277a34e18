"""Land's inflated ventricle and Gasser's strip, as decks of FEBio and Abaqus written here.

Both are solved from the deck and from the scene of the Python interface, on coarse meshes.
"""

from dataclasses import replace

import numpy as np
import pytest

import emulator as em
from deck_support import abaqus, abaqus_supports, drafted, febio, febio_supports, forces
from emulator.geometry.generators.box import box
from emulator.geometry.generators.ellipsoid import land_ventricle
from emulator.verify.land import KAPPA

SAME = 1e-8  # of displacement and force, relative
APEXES = (-26.61, -28.28)  # mm, deformed, inside and outside: Land 2 of ``calibrate verify``
VENTRICLE = land_ventricle(5, 10, 1, order=2)
STRIP = box((10.0, 3.0, 0.5), (6, 2, 1), order=2)  # mm, Gasser, Ogden & Holzapfel (2006), Section 5
PULL = 1.0  # mm
ADVENTITIA = {"c": 7.64, "k_1": 996.6, "k_2": 524.6, "angle": 49.98, "dispersion": 0.226}
"""Of the paper, kPa and degrees; its material is incompressible."""
BULK = 1e3  # kPa


def axes_of_febio():
    return '<mat_axis type="vector"><a>1,0,0</a><d>0,1,0</d></mat_axis>'


def ventricle_of_febio():
    """Fung's exponential with E = c, G = c / 2 and v = 0 is C / 2 (e^(E : E) - 1)."""
    moduli = "".join(f"<E{k}>10</E{k}>" for k in (1, 2, 3))
    moduli += "".join(f"<G{k}>5</G{k}><v{k}>0</v{k}>" for k in (12, 23, 31))
    material = f'type="Fung-ortho-compressible">{moduli}<c>10</c><k>{KAPPA}</k>{axes_of_febio()}'
    load = (
        '<surface_load type="pressure" surface="endocardium"><pressure lc="1">10</pressure>'
        "<linear>0</linear></surface_load>"
    )
    supports = febio_supports("4.0", {"base": "xyz"})
    return febio("4.0", material, supports, load, mesh=VENTRICLE), ".feb", "mm,kPa"


AXES = "*Orientation, name=Axes\n1., 0., 0., 0., 1., 0."


def ventricle_of_abaqus():
    """The same in MPa; E : E has each shear twice, and b_1212 four times."""
    material = f"""*Anisotropic hyperelastic, Fung-orthotropic
1., 0., 1., 0., 0., 1., 0.5, 0.5
0.5, 0.01, {2.0 / (1e-3 * KAPPA)}"""
    conditions = f"{abaqus_supports({'base': 'xyz'})}\n*Dsload\nendocardium_face, P, 0.01"
    text = abaqus(material, conditions, mesh=VENTRICLE, section=", orientation=Axes", more=AXES)
    return text, ".inp", "mm,MPa"


def strip_of_febio():
    names = {"c": "c", "k1": "k_1", "k2": "k_2", "gamma": "angle", "kappa": "dispersion"}
    entries = "".join(f"<{tag}>{ADVENTITIA[name]}</{tag}>" for tag, name in names.items())
    material = f'type="Holzapfel-Gasser-Ogden">{entries}<k>{BULK}</k>{axes_of_febio()}'
    pull = (
        '<bc type="prescribed displacement" node_set="right"><dof>x</dof>'
        f'<value lc="1">{PULL}</value><relative>0</relative></bc>'
    )
    supports = febio_supports("4.0", {"left": "xyz", "right": "yz"})
    return febio("4.0", material, supports + pull, mesh=STRIP), ".feb", "mm,kPa"


def strip_of_abaqus():
    values = {name: 1e-3 * ADVENTITIA[name] for name in ("c", "k_1")}
    numbers = [
        0.5 * values["c"],
        2e3 / BULK,
        values["k_1"],
        ADVENTITIA["k_2"],
        ADVENTITIA["dispersion"],
    ]
    beta = np.radians(ADVENTITIA["angle"])
    families = "\n".join(f"{np.cos(beta)!s}, {sign * np.sin(beta)!s}, 0." for sign in (1, -1))
    axes = AXES.replace("Axes", "Axes, local directions=2")
    text = abaqus(
        f"*Anisotropic hyperelastic, Holzapfel, local directions=2\n{', '.join(map(str, numbers))}",
        f"{abaqus_supports({'left': 'xyz', 'right': 'yz'})}\nright, 1, 1, {PULL}",
        mesh=STRIP,
        section=", orientation=Axes",
        more=f"{axes}\n3, 0.\n{families}",
    )
    return text, ".inp", "mm,MPa"


def by_python(mesh, law, constants, loads, supports):
    """The scene of the Python interface; its first constant is the parameter."""
    (name, value), *rest = constants.items()
    fibres, sheets = (np.tile(row, (len(mesh.elements), 1)) for row in np.eye(3)[:2])
    return em.Scene(
        name="by Python",
        mesh=mesh,
        law=em.find_law(law),
        parameters=(em.Parameter(name, "kPa", 0.5 * value, 1.5 * value),),  # the centre is value
        loads=loads,
        supports=supports,
        constants=dict(rest),
        fibres=fibres,
        sheets=sheets,
    )


def solved(scene):
    """A simulator without the locking of an incompressible material, and its displacement."""
    simulator = em.Simulator(replace(scene, dilatation="mean"))
    return simulator, simulator.solve(scene.centre).require_converged(scene.name).displacement


def read(tmp_path, text, suffix, unit):
    """The scene of a deck of which every line is understood, and its notes on energies."""
    draft = drafted(tmp_path / f"deck_{suffix[1:]}{suffix}", text, unit)
    assert not draft.unread
    return draft.scene, [note for note in draft.notes if "in the deck" in note]


@pytest.mark.slow
def test_land_2_of_both_programs_is_the_scene_of_python(tmp_path):
    """Guccione's law with C = 10 kPa and exponents of 1, at 10 kPa (Land et al. 2015)."""
    exponents = {f"b_{k}": (1.0, 0.0, 0.5)[(k - 1) // 3] for k in range(1, 10)}
    expected = by_python(
        VENTRICLE,
        "fung_orthotropic",
        {"C": 10.0, **exponents, "mu": 0.0, "kappa": KAPPA},
        (em.loads.FollowerPressure("endocardium", 10.0),),
        (em.Support("base"),),
    )
    febio_scene, (energy,) = read(tmp_path, *ventricle_of_febio())
    assert energy.startswith("volume changes cost kappa/2 (ln J)^2")
    abaqus_scene, (energy,) = read(tmp_path, *ventricle_of_abaqus())
    assert energy.startswith("Fung's exponential is of the isochoric strain")
    _, u = solved(expected)
    same_forces(u, expected, febio_scene, abaqus_scene)
    _, by_deck = solved(febio_scene)
    apex = [int(VENTRICLE.node_set(f"apex_{wall}")[0]) for wall in ("endocardium", "epicardium")]
    assert np.abs(by_deck - u)[apex].max() < SAME * np.abs(u)[apex].max()
    np.testing.assert_allclose(VENTRICLE.nodes[apex, 2] + u[apex, 2], APEXES, rtol=0.005)


@pytest.mark.slow
def test_the_strip_of_gasser_of_both_programs_is_the_scene_of_python(tmp_path):
    """The adventitia along the circumference, pulled between clamps by a tenth."""
    expected = by_python(
        STRIP,
        "gasser_ogden_holzapfel",
        {**ADVENTITIA, "kappa": BULK},
        (),
        (em.Support("left"), em.Support("right", np.array([PULL, 0.0, 0.0]))),
    )
    (febio_scene, notes), (abaqus_scene, others) = (
        read(tmp_path, *deck()) for deck in (strip_of_febio, strip_of_abaqus)
    )
    assert [*notes, *others] == []
    simulator, u = solved(expected)
    same_forces(u, expected, febio_scene, abaqus_scene)
    force = float(simulator.reaction("left", u, expected.centre)[0])
    simulator, by_deck = solved(abaqus_scene)
    force_by_deck = float(simulator.reaction("left", by_deck, abaqus_scene.centre)[0])
    assert force < 0.0
    assert abs(force_by_deck - force) < SAME * abs(force)


def same_forces(u, *scenes):
    """Every node of every scene has the force of the first one's, at a solution."""
    first, *others = (forces(replace(scene, dilatation="mean"), u) for scene in scenes)
    for other in others:
        assert np.abs(other - first).max() < SAME * np.abs(first).max()
