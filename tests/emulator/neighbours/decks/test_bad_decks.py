"""Decks that are refused, in one line each that names the deck and the line; and the command."""

import json

import pytest

from calibrate.cli import main
from deck_support import (
    QUADRATIC,
    abaqus,
    abaqus_supports,
    complaint,
    drafted,
    febio,
    febio_supports,
)
from emulator.core.errors import InputError
from emulator.scenes.file import read_scene

MATERIAL = 'type="neo-Hookean"><E>30</E><v>0.3</v>'
SECOND = '<material id="2" name="other" type="{}"><E>9</E><v>0.3</v><G>1</G><k>9</k></material>'
DECK = febio(
    "4.0",
    MATERIAL,
    febio_supports("4.0"),
    '<surface_load type="pressure" surface="right"><pressure lc="1">2</pressure></surface_load>',
)
TWO = DECK.replace("</MeshDomains>", '<SolidDomain name="P" mat="other"/></MeshDomains>').replace(
    "</Material>", f"{SECOND}</Material>", 1
)
BILLION = '<!DOCTYPE a [<!ENTITY b "bb"><!ENTITY c "&b;&b;">]>\n<febio_spec'
FUNG = "".join(f"<E{k}>0</E{k}><v{k}{k % 3 + 1}>0</v{k}{k % 3 + 1}>" for k in (1, 2, 3))
FUNG += "<G12>1</G12><G23>1</G23><G31>1</G31><c>1</c><k>9</k>"
INP = abaqus("*Hyperelastic, neo hooke\n2.0, 0.025", abaqus_supports())


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty"),
        (DECK[: len(DECK) // 2], "it is not valid XML ("),
        ("no tags", "it is not valid XML (syntax error)"),
        (DECK.replace("<febio_spec", BILLION, 1), "line 2: it has a document type (<!DOCTYPE>)"),
        (DECK.replace('"4.0"', '"1.2"'), "expected <febio_spec>, version 2.5, 3.0, 4.0"),
        (DECK.replace('Module type="solid"', 'Module type="biphasic"'), "module 'biphasic'; only"),
        (DECK.replace('node_set="left"', 'node_set="lft"'), "node set 'lft' is not in the deck; "),
        (DECK.replace('surface="right"', 'surface="rigth"'), "; did you mean 'right'?"),
        (DECK.replace('"tet4"', '"hex20"'), "elements 'hex20'; expected tetrahedra (tet4 or"),
        (DECK.replace('"tet4"', '"hex8"'), "4 nodes; a hex8 has 8"),
        (DECK.replace("tri3", "quad8"), "quad8; expected triangles or quad4"),
        (DECK.replace('"tet4"', '"tet10"'), "4 nodes; a tet10 has 10"),
        (DECK.replace('<node id="2">1.0,', '<node id="2">one,'), "line 9: 'one' is not a number"),
        (DECK.replace('<node id="2">1.0,', '<node id="2">'), "2 numbers, expected 3 finite ones"),
        (DECK.replace('<node id="2">1.0,', '<node id="2">nan,'), "3 numbers, expected 3 finite"),
        (DECK.replace('<node id="3">', '<node id="2">'), "line 10: node 2 is there before"),
        (DECK.replace('<elem id="2">', '<elem id="1">'), "element 1 is there before"),
        (DECK.replace('<elem id="1">1,', '<elem id="1">99,'), "element 1 has no node 99"),
        (DECK.replace('<elem id="1">1,', '<elem id="1">x,'), "'x' is not the number of a node"),
        (DECK.replace('"neo-Hookean"', '"isotropic elastic"'), "material 'isotropic elastic' is no"),
        (DECK.replace("<v>0.3</v>", ""), 'type="neo-Hookean"> has no <v>'),
        (DECK.replace("<v>0.3</v>", "<v>0.5</v>"), "line 5: parameter 'nu' is 0.5"),
        (DECK.replace(MATERIAL, f'type="Fung orthotropic">{FUNG}'), "c of the material; expected"),
        (DECK.replace('mat="tissue"', 'mat="tisue"'), "material 'tisue' is not in the deck"),
        (DECK.replace('lc="1"', 'lc="7"'), "load curve 7 is not there, or has no points"),
        (TWO.format("incomp neo-Hookean"), "a second material: 'neo_hookean_split', not 'neo_"),
        (TWO.format("neo-Hookean"), "a second material: other values of 'neo_hookean_E_nu' "),
        (DECK.replace('name="left">', 'name="left">99,'), "a set has node 99, which does not"),
        (DECK.replace("zero disp", "zero"), "it prescribes no displacement, the body"),
        (DECK.replace("<z_dof>1", "<z_dof>0"), "its supports leave 1 of the 6 rigid motions free"),
    ],
)  # fmt: skip
def test_a_deck_of_febio_is_refused(tmp_path, text, message):
    said = complaint(tmp_path / "bad.feb", text)
    assert message in said
    assert "bad.feb" in said
    assert not list(tmp_path.glob("scene/*"))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("C3D4", "C3D20", "elements 'C3D20'; expected tetrahedra (C3D4 or C3D10), prisms"),
        ("2, 1.0,", "2, one,", "line 5: 'one' is not a number"),
        ("\n3, ", "\n2, ", "line 6: node 2 is there before"),
        ("left, 1,", "lft, 1,", "node set 'lft' is not in the deck; it has left, right"),
        ("material=tissue", "material=tisue", "material 'TISUE' is not in the deck"),
        ("neo hooke\n2.0, 0.025", "neo hooke\n2.0, 0.", "D1 is 0: no law here is incompressible"),
        ("neo hooke", "arruda-boyce", "arruda-boyce"),
        ("*Static", "*Include, input=loads.inp\n*Static", "file 'loads.inp' does not exist"),
        ("*Static", "*Include, input=/etc/hosts\n*Static", "is outside of the deck's folder"),
        ("*Hyperelastic, neo hooke\n2.0, 0.025", "*Elastic\n9., .3", "*Elastic is a law here with"),
        ("*Hyperelastic, neo hooke\n2.0, 0.025", "*Density\n1.", "has 0 laws; expected one *Hyper"),
        (
            "*Nset, nset=left\n",
            "*Nset, nset=left\nleft, ",
            "set 'LEFT': there is no node or set left",
        ),
    ],
)
def test_a_deck_of_abaqus_is_refused(tmp_path, old, new, message):
    said = complaint(tmp_path / "bad.inp", INP.replace(old, new))
    assert message.lower() in said.lower()
    assert "bad.inp" in said


def test_a_file_that_includes_itself_is_refused(tmp_path):
    text = INP.replace("*Static", "*Include, input=loop.inp\n*Static")
    assert "more than 10 files that include one another" in complaint(tmp_path / "loop.inp", text)


def test_an_unknown_unit_and_a_file_that_is_there_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"unit 'mpa' is unknown; known: mm, .*MPa"):
        drafted(tmp_path / "u.feb", DECK, "mm,mpa")
    drafted(tmp_path / "u.feb", DECK)
    with pytest.raises(InputError, match=r"u\.toml is there already"):
        drafted(tmp_path / "u.feb", DECK)


def test_the_command_writes_a_scene_that_simulate_takes(tmp_path, capsys):
    deck, out = tmp_path / "block.feb", tmp_path / "scene"
    deck.write_text(DECK.replace("</febio_spec>", "<Rigid><rigid_bc/></Rigid></febio_spec>"))
    assert main(["init", str(deck), "--out", str(out), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["law"] == "neo_hookean_E_nu"
    assert result["parameters"] == ["E", "nu"]
    assert [line.split(": ")[1] for line in result["unread"]] == ["<rigid_bc> in Rigid"]
    assert any("stresses are taken to be kPa" in note for note in result["notes"])
    scene = out / "block.toml"
    assert read_scene(scene).centre.tolist() == pytest.approx([30.0, 0.3], rel=1e-14)
    assert main(["simulate", str(scene), "--out", str(tmp_path / "u.vtu")]) == 0
    assert "converged" in capsys.readouterr().out
    for words, message in (
        (["--law", "yeoh"], "--law has no effect on a deck"),
        (["--unit", "furlong"], "unit 'furlong' is unknown"),
    ):
        assert main(["init", str(deck), "--out", str(tmp_path / "x"), *words]) == 2
        assert message in capsys.readouterr().err


def test_a_quadratic_deck_goes_through_the_command(tmp_path, capsys):
    deck = tmp_path / "q.inp"
    deck.write_text(abaqus("*Hyperelastic, neo hooke\n2.0, 0.025", abaqus_supports(), QUADRATIC))
    assert main(["init", str(deck), "--unit", "mm,MPa", "--out", str(tmp_path / "q.toml")]) == 0
    assert "45 nodes, 12 tetrahedra" in capsys.readouterr().out
    assert read_scene(tmp_path / "q.toml").constants == {"kappa": 80_000.0}
