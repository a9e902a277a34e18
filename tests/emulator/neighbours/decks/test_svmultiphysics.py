"""Decks of svMultiPhysics: homogeneous states by hand, fibres by the Python interface."""

import numpy as np
import pytest

import deck_support as decks
import emulator as em
from deck_support import BLOCK, complaint, drafted, svmultiphysics, svmultiphysics_supports

SMALLEST = 1e-8  # mm and mN
NEO_HOOKEAN = """<Elasticity_modulus> 12.0 </Elasticity_modulus>
  <Poisson_ratio> 0.48 </Poisson_ratio>
  <Constitutive_model type="neoHookean"> </Constitutive_model>"""
HOLZAPFEL_OGDEN = """<Constitutive_model type="HolzapfelOgden">
    <a> 0.5 </a> <b> 8.0 </b> <a4f> 18.0 </a4f> <b4f> 16.0 </b4f> <a4s> 2.5 </a4s>
    <b4s> 11.0 </b4s> <afs> 0.2 </afs> <bfs> 11.5 </bfs> <k> 100.0 </k>
  </Constitutive_model>
  <Penalty_parameter> 100.0 </Penalty_parameter>"""


def condition(name, kind, text):
    return f'<Add_BC name="{name}"><Type> {kind} </Type>{text}</Add_BC>'


def energy(a, b, c):
    """mu = E / 2(1 + nu), kappa = E / 3(1 - 2 nu)."""
    mu, kappa = 12.0 / 2.96, 12.0 / (3 * 0.04)
    return decks.isochoric(lambda x, y, z: mu / 2 * (x**2 + y**2 + z**2 - 3), kappa)(a, b, c)


@pytest.mark.parametrize("follows", [True, False])
def test_a_pressure_of_a_time_table(tmp_path, follows):
    """The last of three values; of a Neumann condition, which pushes."""
    (tmp_path / "p.dat").write_text("3 1\n0.0 0.0\n1.0 5.0\n2.0 -2.0\n")
    text = "<Time_dependence> Unsteady </Time_dependence><Temporal_values_file_path> p.dat </Temporal_values_file_path>"
    text += f"<Follower_pressure_load> {str(follows).lower()} </Follower_pressure_load>"
    conditions = svmultiphysics_supports() + condition("right", "Neu", text)
    draft = drafted(tmp_path / "s.xml", svmultiphysics(tmp_path, NEO_HOOKEAN, conditions))
    stretches = decks.pulled(energy, **{"cauchy" if follows else "nominal_stress": 2.0})
    assert decks.judged(draft.scene, energy, stretches) < SMALLEST
    assert not draft.notes[1:]  # ST91 is the volume energy here
    assert not draft.unread


def test_a_displacement_of_the_older_program(tmp_path):
    text = "<Value> 0.5 </Value><Effective_direction> 1 0 0 </Effective_direction>"
    held = "<Impose_on_state_variable_integral> true </Impose_on_state_variable_integral>"
    conditions = svmultiphysics_supports() + condition("right", "Dirichlet", text + held)
    deck = svmultiphysics(tmp_path, NEO_HOOKEAN, conditions, root="svFSIFile")
    scene = drafted(tmp_path / "d.xml", deck).scene
    stretches = decks.pulled(energy, along=1.25)
    assert decks.judged(scene, energy, stretches) < SMALLEST
    velocity = svmultiphysics_supports() + condition("right", "Dirichlet", text)
    deck = svmultiphysics(tmp_path, NEO_HOOKEAN, velocity)
    (tmp_path / "other").mkdir()
    said = decks.draft_deck(_written(tmp_path / "v.xml", deck), tmp_path / "other", "mm,kPa").unread
    assert "condition Dirichlet on 'right', a velocity" in said[0]


def _written(path, text):
    path.write_text(text)
    return path


def test_myocardium_on_springs_gives_the_scene_of_the_python_interface(tmp_path):
    """Fibres from a file, sheets of one direction, springs along the normal; kappa is a quarter."""
    fibres = np.tile([0.6, 0.8, 0.0], (len(BLOCK.elements), 1))
    em.write_mesh(tmp_path / "fibres.vtu", BLOCK, fibres)
    directions = "<Fiber_direction_file_path> fibres.vtu </Fiber_direction_file_path>\n"
    directions += "<Fiber_direction> (-4.0, 3.0, 0.0) </Fiber_direction>"
    springs = "<Stiffness> 3.0 </Stiffness><Damping> 5.0 </Damping>"
    springs += "<Apply_along_normal_direction> 1 </Apply_along_normal_direction>"
    conditions = svmultiphysics_supports({"left": "xyz"}) + condition("right", "Robin", springs)
    deck = svmultiphysics(tmp_path, HOLZAPFEL_OGDEN, conditions, directions)
    draft = drafted(tmp_path / "h.xml", deck)
    scene = em.Scene(
        name="by hand",
        mesh=BLOCK,
        law=em.find_law("holzapfel_ogden_orthotropic"),
        parameters=(em.Parameter("a", "kPa", 0.4, 0.6),),
        supports=(em.Support("left"), em.supports.ElasticSupport("right", 3.0, "normal")),
        constants={
            **{"b": 8.0, "a_f": 18.0, "b_f": 16.0, "a_s": 2.5, "b_s": 11.0},
            **{"a_fs": 0.2, "b_fs": 11.5, "kappa": 25.0},
        },
        fibres=fibres,
        sheets=np.tile([-0.8, 0.6, 0.0], (len(BLOCK.elements), 1)),
    )
    u = 0.1 * np.random.default_rng(1).uniform(size=BLOCK.nodes.shape)
    np.testing.assert_allclose(
        decks.forces(draft.scene, u), decks.forces(scene, u), rtol=1e-10, atol=SMALLEST
    )
    assert "damping on 'right'" in draft.unread[0]
    assert any("fibres switch on at once" in note for note in draft.notes)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("mesh/block.vtu", "../block.vtu", "'../block.vtu' is outside of the deck's folder"),
        ("mesh/right.vtp", "mesh/none.vtp", "file 'mesh/none.vtp' does not exist"),
        ('"struct"', '"fluid"', "equation 'fluid'; expected struct or ustruct"),
        ('"neoHookean"', '"Guccione"', "model 'Guccione' is no law of this package; it reads"),
        ("0.48", "0.5", "Poisson's ratio 0.5 without a penalty"),
        ("12.0", "soft", "line 19: 'soft' is not a number"),
        ('name="right"><Type', 'name="rigth"><Type', "face 'rigth' is not in the deck; it has"),
    ],
)
def test_what_is_refused(tmp_path, old, new, message):
    conditions = svmultiphysics_supports() + condition("right", "Neu", "<Value> 1.0 </Value>")
    deck = svmultiphysics(tmp_path, NEO_HOOKEAN, conditions)
    assert message in complaint(tmp_path / "b.xml", deck.replace(old, new))
