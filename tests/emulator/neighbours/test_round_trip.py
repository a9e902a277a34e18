"""A card that goes out and comes back as a deck has the same law and the same parameters.

Cards and decks have their conventions apart, from sources and from manuals: here they meet.
"""

import re

import pytest

from deck_support import (
    abaqus,
    abaqus_supports,
    drafted,
    febio,
    febio_supports,
    svmultiphysics,
    svmultiphysics_supports,
)
from emulator.mechanics.laws import find_law
from emulator.neighbours.cards import PROGRAMS, write_card

VALUES = {
    "mu": 3.0, "lam": 40.0, "kappa": 900.0, "E": 12.0, "nu": 0.3, "c_10": 1.1, "c_01": 0.4,
    "c_1": 1.2, "c_2": 0.3, "c_3": 0.05, "mu_1": 1.3, "alpha_1": 4.0, "mu_2": 0.6, "alpha_2": -2.0,
    "mu_3": 0.2, "alpha_3": 9.0, "c": 5.0, "k_1": 7.0, "k_2": 2.5, "angle": 35.0, "dispersion": 0.1,
    "a": 0.8, "b": 5.0, "a_f": 6.0, "b_f": 7.0, "a_s": 2.0, "b_s": 3.0, "a_fs": 0.5, "b_fs": 4.0,
    "C": 2.0, "b_1": 9.0, "b_2": 5.0, "b_3": 4.0, "b_4": 1.0, "b_5": -0.6, "b_6": 0.7, "b_7": 2.0,
    "b_8": 3.0, "b_9": 2.5,
}  # fmt: skip
OGDEN = ("ogden_1", "ogden_2", "ogden_3")
FUNG = "fung_orthotropic"
FAMILIES = ("holzapfel_gasser_ogden", "gasser_ogden_holzapfel")
LAWS = {
    "febio": ("neo_hookean_E_nu", "mooney_rivlin", *OGDEN, *FAMILIES, FUNG),
    "abaqus": (
        "neo_hookean_split", "mooney_rivlin", "yeoh", *OGDEN, *FAMILIES, "small_strain_E_nu",
    ),
    "svmultiphysics": ("neo_hookean_split", "holzapfel_ogden_orthotropic"),
}  # fmt: skip
DISTRIBUTION = (
    "*Distribution, name=FIBRE_AXES, location=element\n, 1., 0., 0., 0., 1., 0.\n"
    + "\n".join(f"{k}, 1., 0., 0., 0., 1., 0." for k in range(1, 13))
)


def as_febio(card):
    """A deck of FEBio with the material of a card."""
    material = re.search(r'name="tissue" (type=.*?)</material>', card, re.DOTALL)[1]
    axes = "<mat_axis type='vector'><a>1,0,0</a><d>0,1,0</d></mat_axis>"
    if "gamma" in material or "G12" in material:
        material += axes
    return febio("4.0", material, febio_supports("4.0"))


def as_abaqus(card):
    """A deck of Abaqus with the keywords of a card, and axes for its fibres."""
    keywords, _, orientation = card.partition("*ORIENTATION")
    material = keywords.partition("\n")[2]
    has_fibres = bool(orientation)
    return abaqus(
        material,
        abaqus_supports(),
        nlgeom="NO" if "*ELASTIC" in card else "YES",
        section=", orientation=Fibres" if has_fibres else "",
        more=f"*ORIENTATION{orientation}{DISTRIBUTION}" if has_fibres else "",
    )


@pytest.mark.parametrize(("program", "name"), [(p, n) for p, names in LAWS.items() for n in names])
def test_a_card_is_read_back_as_it_went_out(tmp_path, program, name):
    law = find_law(name)
    values = {quantity.name: VALUES[quantity.name] for quantity in law.quantities}
    if name == FUNG:
        values["mu"] = 0.0  # a matrix is no part of FEBio's
    card = write_card(PROGRAMS[program], law, values)
    if program == "svmultiphysics":
        fibres = "<Fiber_direction> (1.0, 0.0, 0.0) </Fiber_direction>"
        sheets = "<Fiber_direction> (0.0, 1.0, 0.0) </Fiber_direction>"
        text = svmultiphysics(tmp_path, card, svmultiphysics_supports(), fibres + sheets)
        text = text.replace("<Dilational_penalty_model> ST91 </Dilational_penalty_model>", "", 1)
        suffix, unit = ".xml", "mm,kPa"
    elif program == "febio":
        text, suffix, unit = as_febio(card), ".feb", "mm,kPa"
    else:
        text, suffix, unit = as_abaqus(card), ".inp", "mm,MPa"
    scene = drafted(tmp_path / f"deck{suffix}", text, unit).scene
    assert scene.law.name == name
    read = scene.resolve(scene.centre)
    for quantity, value in values.items():
        assert float(read[quantity]) == pytest.approx(value, rel=1e-9), quantity
