"""Input files of Abaqus and CalculiX: homogeneous states, weights and placed parts by hand."""

import numpy as np
import pytest

import deck_support as decks
import emulator as em
from deck_support import (
    BLOCK,
    QUADRATIC,
    SLIDING,
    abaqus,
    abaqus_supports,
    complaint,
    drafted,
    imbalance,
)

SMALLEST = 1e-8  # mm and mN
NEO_HOOKE = "*Hyperelastic, neo hooke\n2.0, 0.025"
PULL = "\nright, 1, 1, 0.5"


def neo_hooke(a, b, c):
    """C10 = 2."""
    return 2.0 * (a**2 + b**2 + c**2 - 3)


def test_a_prescribed_displacement_with_an_amplitude(tmp_path):
    """D1 = 0.025 is a bulk modulus of 80; half of the amplitude's 2 at the end of the step."""
    text = abaqus(
        NEO_HOOKE,
        f"{abaqus_supports()}\n*Boundary, amplitude=ramp\nright, 1, 1, 0.25",
        more="*Amplitude, name=Ramp\n0., 0., 1., 2.",
    )
    draft = drafted(tmp_path / "a.inp", text)
    energy = decks.isochoric(neo_hooke, 80.0)
    stretches = decks.pulled(energy, along=1.25)
    assert decks.judged(draft.scene, energy, stretches) < SMALLEST
    assert draft.scene.constants == {"kappa": 80.0}
    assert any("kappa/2 (J - 1)^2 in the deck" in note for note in draft.notes)
    assert not draft.unread


@pytest.mark.parametrize("nlgeom", ["YES", "NO"])
def test_a_pressure_on_a_surface_follows_with_nlgeom(tmp_path, nlgeom):
    text = abaqus(NEO_HOOKE, f"{abaqus_supports()}\n*Dsload\nright_face, P, 1.5", nlgeom=nlgeom)
    draft = drafted(tmp_path / "p.inp", text)
    known = {"cauchy" if nlgeom == "YES" else "nominal_stress": -1.5}
    energy = decks.isochoric(neo_hooke, 80.0)
    stretches = decks.pulled(energy, **known)
    assert decks.judged(draft.scene, energy, stretches) < SMALLEST
    assert any("no NLGEOM" in note for note in draft.notes) == (nlgeom == "NO")


def test_constants_at_another_temperature_and_a_thermal_load_are_listed(tmp_path):
    text = abaqus(f"{NEO_HOOKE}, 20.\n3., 0.02, 40.", f"{abaqus_supports()}\n*Dflux\nbody, BF, 1.")
    draft = drafted(tmp_path / "t.inp", text)
    lines = text.splitlines()
    assert draft.scene.constants == {"kappa": 80.0}
    for sentence, start in zip(draft.unread, ("*Hyperelastic", "*Dflux"), strict=True):
        number = int(sentence.split()[1])
        assert lines[number - 1].startswith(start)


def test_yeoh_under_a_dead_traction_in_mpa(tmp_path):
    """Of 0.003 MPa along (2, 0, 0), whose length does not matter."""
    load = "*Dsload, follower=NO, constant resultant=YES\nright_face, TRVEC, 0.003, 2., 0., 0."
    material = "*Hyperelastic, yeoh\n0.002, 0.0003, 0.0001, 20., 0., 0."
    draft = drafted(tmp_path / "y.inp", abaqus(material, f"{abaqus_supports()}\n{load}"), "mm,MPa")

    def shape(a, b, c):
        x = a**2 + b**2 + c**2 - 3
        return 2.0 * x + 0.3 * x**2 + 0.1 * x**3

    energy = decks.isochoric(shape, 100.0)
    stretches = decks.pulled(energy, nominal_stress=3.0)
    assert decks.judged(draft.scene, energy, stretches) < SMALLEST


def test_two_terms_of_ogden_on_quadratic_tetrahedra(tmp_path):
    """Abaqus's 2 mu / alpha^2 is the law's here; one exponent is negative."""
    material = "*Hyperelastic, ogden, n=2\n3., 2.5, 1.2, -2., 0.02, 0."
    text = abaqus(material, abaqus_supports() + PULL, mesh=QUADRATIC, kind="C3D10H")
    draft = drafted(tmp_path / "o.inp", text)

    def shape(a, b, c):
        terms = ((3.0, 2.5), (1.2, -2.0))
        return sum(2 * m / p**2 * (a**p + b**p + c**p - 3) for m, p in terms)

    energy = decks.isochoric(shape, 100.0)
    stretches = decks.pulled(energy, along=1.25)
    assert decks.judged(draft.scene, energy, stretches) < SMALLEST


def test_mooney_rivlin_of_calculix_under_pressure_on_faces(tmp_path):
    """CalculiX's *DLOAD on faces P1 to P4 of an element set."""
    faces = [decks.face_of(BLOCK, "right", row) for row in (0, 1)]
    rows = "\n".join(f"{number}, P{face[1:]}, -2." for number, face in faces)
    text = abaqus(
        "*Hyperelastic, Mooney-Rivlin\n1.5, .5, .025", f"{abaqus_supports()}\n*Dload\n{rows}"
    )
    draft = drafted(tmp_path / "m.inp", text.replace("*Nset", "*NSET").replace("name=load, ", ""))

    def shape(a, b, c):
        one, two = a**2 + b**2 + c**2, (a * b) ** 2 + (b * c) ** 2 + (a * c) ** 2
        return 1.5 * (one - 3) + 0.5 * (two - 3)

    energy = decks.isochoric(shape, 80.0)
    stretches = decks.pulled(energy, cauchy=2.0)
    assert decks.judged(draft.scene, energy, stretches) < SMALLEST


def test_a_bar_hangs_by_its_weight(tmp_path):
    """Hooke's law without NLGEOM, nu = 0: u = rho g (L x - x^2 / 2) / E on quadratic elements."""
    load = "*Dload\nbody, GRAV, 9.81, 1., 0., 0."
    material = "*Elastic\n40., 0.\n*Density\n0.02"
    text = abaqus(material, f"{abaqus_supports()}\n{load}", mesh=QUADRATIC, nlgeom="NO")
    draft = drafted(tmp_path / "w.inp", text)
    x = draft.scene.mesh.nodes[:, 0]
    u = np.zeros_like(draft.scene.mesh.nodes)
    u[:, 0] = 0.02 * 9.81 * (2.0 * x - x**2 / 2) / 40.0
    assert imbalance(draft.scene, u) < SMALLEST
    reaction = decks.forces(draft.scene, u)[draft.scene.mesh.node_set("left"), 0].sum()
    assert abs(reaction + 0.02 * 9.81 * 2.0) < SMALLEST


PARTS = """*Heading
*Part, name=Block
{mesh}
*Solid Section, elset=body, material=Tissue
,
*End Part
*Assembly, name=Assembly
*Instance, name=One, part=Block
{first}
*End Instance
{second}
*Nset, nset=ends, instance=One
right
*Nset, nset=corner, instance=One
{corner}
*End Assembly
*Material, name=Tissue
*Hyperelastic, neo hooke
2.0, 0.025
*Step, nlgeom=YES
*Static
1., 1.
{conditions}
*End Step
"""


def test_a_part_that_is_shifted_and_turned(tmp_path):
    """Shifted by (1, 2, 3), then turned by 90 degrees about z at (1, 0, 0): x is y."""
    conditions = abaqus_supports({"left": "y", "front": "x", "bottom": "z"}, "One.")
    text = PARTS.format(
        mesh=decks.abaqus_mesh(),
        first="1., 2., 3.\n1., 0., 0., 1., 0., 1., 90.",
        second="",
        corner=1,
        conditions=f"{conditions}\n*Boundary\nends, 2, 2, 0.5",
    )
    scene = drafted(tmp_path / "r.inp", text).scene
    x, y, z = BLOCK.nodes.T
    np.testing.assert_allclose(
        scene.mesh.nodes, np.column_stack([-y - 1.0, x, z + 3.0]), atol=1e-12
    )
    along, aside, _ = decks.pulled(decks.isochoric(neo_hooke, 80.0), along=1.25)
    u = np.column_stack([(1.0 - aside) * y, (along - 1.0) * x, (aside - 1.0) * z])
    assert imbalance(scene, u) < SMALLEST


def test_two_instances_of_a_part(tmp_path):
    """Beside one another; each has its sets, by its name, and its own displacement."""
    supports = "\n".join(abaqus_supports(SLIDING, f"{name}.") for name in ("One", "Two"))
    text = PARTS.format(
        mesh=decks.abaqus_mesh(),
        first="0., 0., 0.",
        second="*Instance, name=Two, part=Block\n0., 0., 5.\n*End Instance",
        corner=1,
        conditions=f"{supports}\n*Boundary\nends, 1, 1, 0.5\nTwo.Right, 1, 1, -0.2",
    )
    scene = drafted(tmp_path / "two.inp", text).scene
    energy = decks.isochoric(neo_hooke, 80.0)
    u = np.concatenate(
        [BLOCK.nodes * (decks.pulled(energy, along=along) - 1.0) for along in (1.25, 0.9)]
    )
    assert imbalance(scene, u) < SMALLEST
    assert {"One.left", "Two.right", "ends", "corner"} <= set(scene.mesh.node_sets)


def test_point_forces_and_an_included_file(tmp_path):
    """A force on each node of a set; they are those of the scene of the Python interface."""
    (tmp_path / "loads.inp").write_text("*Cload\nfree, 3, -0.4\n12, 1, 0.1\n")
    text = abaqus(
        "*Include, input=tissue.inp",
        f"{abaqus_supports({'left': 'xyz'})}\n*Include, input=loads.inp",
        more="*Nset, nset=free, generate\n6, 12, 3",
    )
    (tmp_path / "tissue.inp").write_text(f"** the law\n{NEO_HOOKE}\n")
    scene = drafted(tmp_path / "c.inp", text).scene
    by_hand = em.Scene(
        name="by hand",
        mesh=em.Mesh(
            BLOCK.nodes,
            BLOCK.elements,
            {"left": BLOCK.node_set("left"), **{f"n{k}": np.array([k - 1]) for k in (6, 9, 12)}},
        ),
        law=em.find_law("neo_hookean_split"),
        parameters=(em.Parameter("mu", "kPa", 3.0, 5.0),),
        loads=(
            *(em.loads.Force(f"n{k}", np.array([0.0, 0.0, -4e-4])) for k in (6, 9, 12)),
            em.loads.Force("n12", np.array([1e-4, 0.0, 0.0])),
        ),
        supports=(em.Support("left"),),
        constants={"kappa": 80.0},
    )
    u = 0.1 * np.random.default_rng(1).uniform(size=BLOCK.nodes.shape)
    np.testing.assert_allclose(decks.forces(scene, u), decks.forces(by_hand, u), atol=SMALLEST)


@pytest.mark.parametrize("distributed", [False, True])
def test_fibres_between_two_local_directions(tmp_path, distributed):
    """In local axes turned by 90 degrees about z, at 40 degrees to both sides of the local x."""
    axes = "0., 1., 0., -1., 0., 0."
    rows = "\n".join(f"{k}, {axes}" for k in range(1, len(BLOCK.elements) + 1))
    cos, sin = float(np.cos(np.deg2rad(40.0))), float(np.sin(np.deg2rad(40.0)))
    more = (
        "*Distribution, name=Dist, location=ELEMENT, table=T\n, 1., 0., 0., 0., 1., 0.\n"
        f"{rows}\n*Orientation, name=Ori, local directions=2\n{'Dist' if distributed else axes}\n"
        f"3, 0.\n{cos!r}, {sin!r}, 0.\n{cos!r}, {-sin!r}, 0."
    )
    material = "*Anisotropic hyperelastic, holzapfel, local directions=2\n2., .02, 6., 1.3, 0."
    text = abaqus(material, abaqus_supports() + PULL, section=", orientation=Ori", more=more)
    scene = drafted(tmp_path / "f.inp", text).scene
    assert scene.law.name == "holzapfel_gasser_ogden"
    assert scene.constants == {"kappa": 100.0}
    np.testing.assert_allclose(scene.fibres, np.tile([0.0, 1.0, 0.0], (12, 1)), atol=1e-15)

    def energy(a, b, c):
        J = a * b * c
        a, b, c = (x * J ** (-1 / 3) for x in (a, b, c))
        along = cos**2 * b**2 + sin**2 * a**2 - 1  # of both families, fibres are along y
        fibres = 2 * 6.0 / 2.6 * (np.exp(1.3 * along**2) - 1) if along.real > 0 else 0.0
        return 2.0 * (a**2 + b**2 + c**2 - 3) + fibres + decks.volumetric(J, 100.0)

    stretches = decks.pulled(energy, along=1.25)
    assert stretches[1] < 1.0  # and yet the fibres are stretched
    assert decks.judged(scene, energy, stretches) < SMALLEST


def test_a_mesh_of_abaqus_without_a_material_is_a_mesh(tmp_path, capsys):
    from calibrate.cli import main

    (tmp_path / "mesh.inp").write_text(decks.abaqus_mesh())
    assert main(["init", str(tmp_path / "mesh.inp")]) == 0
    assert "law neo_hookean: the mesh has no fibres" in capsys.readouterr().out


FUNG = "*Anisotropic hyperelastic, fung-orthotropic\n9., 1., 5., 0.7, -0.6, 4., 2., 2.5\n3., 2., {}"
LOCAL = "*Orientation, name=Axes\n0., 1., 0., -1., 0., 0."


def test_fungs_constants_in_the_axes_of_an_orientation(tmp_path):
    """b_1133 is our b_6, b_1313 our b_9; 2 / D = 1e4 is 555 times the largest stiffness, 18."""
    text = abaqus(
        FUNG.format(2e-4), abaqus_supports() + PULL, section=", orientation=Axes", more=LOCAL
    )
    draft = drafted(tmp_path / "f.inp", text)
    read = draft.scene.resolve(draft.scene.centre)
    expected = (9.0, 5.0, 4.0, 1.0, -0.6, 0.7, 2.0, 3.0, 2.5)
    values = [float(read[f"b_{k}"]) for k in range(1, 10)]
    np.testing.assert_allclose(values, expected, rtol=1e-12)
    assert [float(read[name]) for name in ("C", "mu", "kappa")] == pytest.approx([2.0, 0.0, 1e4])
    np.testing.assert_allclose(draft.scene.fibres, np.tile([0.0, 1.0, 0.0], (12, 1)))
    np.testing.assert_allclose(draft.scene.sheets, np.tile([-1.0, 0.0, 0.0], (12, 1)))
    assert any("isochoric strain" in note for note in draft.notes)


def test_what_is_no_fung_law_of_the_whole_strain_is_refused(tmp_path):
    options = {"section": ", orientation=Axes", "more": LOCAL}
    soft = abaqus(FUNG.format(0.02), abaqus_supports(), **options)
    assert "bulk modulus of 1800 or more" in complaint(tmp_path / "s.inp", soft)
    turned = LOCAL.replace("Axes", "Axes, system=cylindrical")
    text = abaqus(FUNG.format(2e-4), abaqus_supports(), **options | {"more": turned})
    assert "expected SYSTEM=RECTANGULAR" in complaint(tmp_path / "c.inp", text)
    short = FUNG.format(2e-4).replace("3., 2., ", "")
    message = complaint(tmp_path / "n.inp", abaqus(short, abaqus_supports(), **options))
    assert "nine b_ijkl" in message
