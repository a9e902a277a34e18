"""Decks of FEBio: homogeneous states and weights by hand, fibres by the Python interface."""

from pathlib import Path

import numpy as np
import pytest

import deck_support as decks
import emulator as em
from deck_support import BLOCK, QUADRATIC, drafted, febio, febio_supports

SMALLEST = 1e-8  # mm and mN


def solved(draft):
    """The solution at the deck's values, which are the centre of the ranges."""
    return em.Simulator(draft.scene).solve(draft.scene.centre)


@pytest.mark.parametrize("unit", ["mm,kPa", "m,Pa"])
def test_a_prescribed_displacement_of_format_2_5(tmp_path, unit):
    """Twice 0.2 times a curve that ends at 1: a stretch of 1.2; in m, all lengths are in mm."""
    pull = (
        '<prescribe bc="x" node_set="right"><scale lc="1">0.2</scale><value>2</value></prescribe>'
    )
    text = febio(
        "2.5",
        'type="neo-Hookean"><density>1</density><E>30</E><v>0.3</v>',
        febio_supports("2.5") + pull,
    )
    draft = drafted(tmp_path / "pull.feb", text, unit)
    scene, solution = draft.scene, solved(draft)
    energy = decks.neo_hookean(30.0, 0.3)
    stretches = decks.pulled(energy, along=1.2)
    size = 1e3 if unit == "m,Pa" else 1.0
    gap = np.asarray(solution.displacement) - decks.stretched(scene, stretches)
    assert np.abs(gap).max() < SMALLEST * size
    force = em.Simulator(scene).reaction("left", solution.displacement, scene.centre)
    stress = decks.nominal(energy, stretches)[0] / size * (1e6 if size > 1.0 else 1.0)
    assert abs(float(force[0]) + stress) < SMALLEST * size
    assert scene.parameters[0].prior.median == pytest.approx(30.0 / size, rel=1e-15)
    assert not draft.unread


def test_a_traction_of_format_3_on_an_incompressible_neo_hookean(tmp_path):
    load = (
        '<surface_load type="traction" surface="right"><scale lc="1">2</scale>'
        "<traction>1.5,0,0</traction></surface_load>"
    )
    material = 'type="incomp neo-Hookean"><G>4</G><k>90</k><pressure_model>1</pressure_model>'
    draft = drafted(tmp_path / "t.feb", febio("3.0", material, febio_supports("3.0"), load))
    energy = decks.isochoric(lambda a, b, c: 2.0 * (a**2 + b**2 + c**2 - 3), 90.0)
    stretches = decks.pulled(energy, nominal_stress=3.0)
    assert decks.judged(draft.scene, energy, stretches) < SMALLEST
    assert draft.scene.constants == {"kappa": 90.0}


def test_a_pressure_of_format_4_follows_the_surface(tmp_path):
    load = (
        '<surface_load type="pressure" surface="right"><pressure lc="1">2.5</pressure>'
        "<linear>0</linear></surface_load>"
    )
    material = 'type="neo-Hookean"><E>30</E><v>0.3</v>'
    draft = drafted(tmp_path / "p.feb", febio("4.0", material, febio_supports("4.0"), load))
    energy = decks.neo_hookean(30.0, 0.3)
    stretches = decks.pulled(energy, cauchy=-2.5)
    assert decks.judged(draft.scene, energy, stretches) < SMALLEST


@pytest.mark.parametrize("unit", ["mm,kPa", "cm,dyn/cm2"])
def test_the_weight_of_format_4(tmp_path, unit):
    """FEBio's body force b acts as -rho b; the support carries rho b V, in any unit."""
    load = '<body_load type="body force"><force lc="1">0,0,0.03</force></body_load>'
    material = 'type="neo-Hookean"><density>4</density><E>30</E><v>0.3</v>'
    supports = febio_supports("4.0", {"left": "xyz"})
    draft = drafted(tmp_path / "w.feb", febio("4.0", material, supports, load), unit)
    scene, solution = draft.scene, solved(draft)
    force = em.Simulator(scene).reaction("left", solution.displacement, scene.centre)
    of_unit = 1.0 if unit == "mm,kPa" else 1e-4 * 100.0  # stress times area
    np.testing.assert_allclose(force, [0.0, 0.0, 0.24 * of_unit], atol=SMALLEST)
    lowest = np.asarray(solution.displacement)[:, 2].min()
    assert lowest < 0.0


def test_quadratic_tetrahedra_and_mooney_rivlin(tmp_path):
    pull = (
        '<bc type="prescribed displacement" node_set="right"><dof>x</dof>'
        '<value lc="1">0.5</value><relative>0</relative></bc>'
    )
    material = 'type="Mooney-Rivlin"><c1>2</c1><c2>0.5</c2><k>80</k><pressure_model>NIKE3D</pressure_model>'
    text = febio("4.0", material, febio_supports("4.0") + pull, mesh=QUADRATIC)
    draft = drafted(tmp_path / "q.feb", text)

    def shape(a, b, c):
        one, two = a**2 + b**2 + c**2, (a * b) ** 2 + (b * c) ** 2 + (a * c) ** 2
        return 2.0 * (one - 3) + 0.5 * (two - 3)

    energy = decks.isochoric(shape, 80.0)
    stretches = decks.pulled(energy, along=1.25)
    assert decks.judged(draft.scene, energy, stretches) < SMALLEST
    assert draft.scene.mesh.order == 2


def test_a_uniform_volume_energy_of_another_kind_is_said(tmp_path):
    """FEBio's Ogden: c/m^2; its (ln J)^2 agrees to second order only."""
    pull = '<bc type="prescribe" node_set="right"><dof>x</dof><scale lc="1">0.4</scale></bc>'
    material = 'type="Ogden"><c1>6</c1><m1>4</m1><k>50</k>'
    text = febio("3.0", material, febio_supports("3.0") + pull)
    draft = drafted(tmp_path / "o.feb", text)
    energy = decks.isochoric(lambda a, b, c: 6.0 / 16.0 * (a**4 + b**4 + c**4 - 3), 50.0)
    stretches = decks.pulled(energy, along=1.2)
    assert decks.judged(draft.scene, energy, stretches) < SMALLEST
    assert any("kappa/2 (ln J)^2 in the deck" in note for note in draft.notes)
    assert draft.scene.theta(mu_1=3.0, alpha_1=4.0).tolist() == draft.scene.centre.tolist()


def test_fibres_of_each_element_give_the_scene_of_the_python_interface(tmp_path):
    a = np.array([3.0, 4.0, 0.0]) / 5.0
    rows = "".join(
        f'<elem lid="{k}"><a>3,4,0</a><d>0,1,0</d></elem>'
        for k in range(1, len(BLOCK.elements) + 1)
    )
    axes = f'<MeshData><ElementData type="mat_axis" elem_set="P">{rows}</ElementData></MeshData>'
    material = (
        'type="Holzapfel-Gasser-Ogden"><c>5</c><k1>8</k1><k2>1.5</k2><gamma>30</gamma>'
        "<kappa>0.1</kappa><k>100</k>"
    )
    load = '<nodal_load type="nodal_force" node_set="corner"><value lc="1">0.2,0.1,0</value></nodal_load>'
    text = febio("4.0", material, febio_supports("4.0", {"left": "xyz"}), load, mat_axes=axes)
    text = text.replace(
        '<NodeSet name="left">', '<NodeSet name="corner">12</NodeSet><NodeSet name="left">'
    )
    draft = drafted(tmp_path / "h.feb", text)
    mesh = em.Mesh(
        BLOCK.nodes, BLOCK.elements, {**BLOCK.node_sets, "corner": np.array([11])}, BLOCK.facet_sets
    )
    scene = em.Scene(
        name="by hand",
        mesh=mesh,
        law=em.find_law("gasser_ogden_holzapfel"),
        parameters=(em.Parameter("c", "kPa", 4.0, 6.0),),
        loads=(em.loads.Force("corner", np.array([2e-4, 1e-4, 0.0])),),
        supports=(em.Support("left"),),
        constants={"k_1": 8.0, "k_2": 1.5, "angle": 30.0, "dispersion": 0.1, "kappa": 100.0},
        fibres=np.tile(a, (len(mesh.elements), 1)),
        sheets=np.tile([-0.8, 0.6, 0.0], (len(mesh.elements), 1)),
    )
    u = 0.1 * np.random.default_rng(1).uniform(size=mesh.nodes.shape)
    np.testing.assert_allclose(decks.forces(draft.scene, u), decks.forces(scene, u), atol=SMALLEST)
    assert not draft.notes[1:]  # its volume energy is the one here


def test_what_is_not_understood_is_listed_by_its_line(tmp_path):
    more = '<Contact>\n<contact type="sliding-elastic" name="c"/>\n</Contact>'
    load = '<surface_load type="traction" surface="top"><traction>0,0,1</traction></surface_load>'
    material = 'type="neo-Hookean"><E>30</E><v>0.3</v><viscosity>1</viscosity>'
    supports = febio_supports("4.0", {"left": "xyz"})
    text = febio("4.0", material, supports, load, more=more)
    draft = drafted(tmp_path / "u.feb", text)
    lines = text.splitlines()
    for sentence in draft.unread:
        number, words = sentence.removeprefix("line ").split(" is not understood: <")
        assert words.split()[0].rstrip(">") in lines[int(number) - 1]
    kinds = [sentence.split(": ")[1] for sentence in draft.unread]
    assert [kind.split(">")[0].split()[0] for kind in kinds] == [
        "<viscosity", "<surface_load", "<contact",
    ]  # fmt: skip
    written = Path(draft.path).read_text()
    assert all(f"# - {sentence}" in written for sentence in draft.unread)


def test_fungs_exponential_of_an_isotropic_material(tmp_path):
    """With G = E / 2 (1 + v), c Q = lam (tr E)^2 + 2 mu tr E^2 of the Green-Lagrange strain."""
    pull = '<bc type="prescribe" node_set="right"><dof>x</dof><scale lc="1">0.2</scale></bc>'
    moduli = "".join(f"<E{k}>30</E{k}>" for k in (1, 2, 3))
    moduli += "".join(f"<G{k}>12</G{k}><v{k}>0.25</v{k}>" for k in (12, 23, 31))
    axes = '<mat_axis type="vector"><a>0,1,0</a><d>1,0,0</d></mat_axis>'
    material = f'type="Fung-ortho-compressible">{moduli}<c>4</c><k>90</k>{axes}'
    text = febio("3.0", material, febio_supports("3.0") + pull)
    draft = drafted(tmp_path / "f.feb", text)

    def energy(*stretches):
        E = [(x**2 - 1.0) / 2.0 for x in stretches]
        Q = (12.0 * sum(E) ** 2 + 24.0 * sum(e**2 for e in E)) / 4.0
        J = stretches[0] * stretches[1] * stretches[2]
        return 2.0 * (np.exp(Q) - 1.0) + decks.volumetric(J, 90.0)

    stretches = decks.pulled(energy, along=1.1)
    assert decks.judged(draft.scene, energy, stretches) < SMALLEST
    assert any("kappa/2 (ln J)^2 in the deck" in note for note in draft.notes)
