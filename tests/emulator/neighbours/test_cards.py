"""Cards, read from their text, give our stress by the programs' own formulas."""

from functools import cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from card_support import ENERGIES, stress
from emulator.core.errors import InputError
from emulator.mechanics.kinematics import Strain
from emulator.mechanics.laws import LAWS
from emulator.neighbours.cards import PROGRAMS, write_card
from emulator.neighbours.cards.card import moduli_at_rest
from emulator.neighbours.cards.svmultiphysics import SHARP
from law_support import ARGUMENTS, FIBRE, SHEET

AXES = np.array([FIBRE, SHEET, np.cross(FIBRE, SHEET)])
STRETCHES = {
    "along the fibre": ((0.25, 0.0, 0.0), (0.0, -0.1, 0.05), (0.0, 0.0, -0.08)),
    "fibre compressed": ((-0.2, 0.0, 0.0), (0.1, 0.15, 0.0), (0.0, 0.0, 0.1)),
    "both compressed": ((-0.1, 0.02, 0.0), (0.0, -0.15, 0.0), (0.0, 0.1, 0.3)),
    "sheared": ((0.05, 0.3, 0.1), (0.0, 0.06, -0.2), (0.1, 0.0, -0.05)),
    "volume alone": ((0.02, 0.0, 0.0), (0.0, 0.02, 0.0), (0.0, 0.0, 0.02)),
}
GRADIENTS = np.array([np.eye(3) + AXES.T @ np.array(H) @ AXES for H in STRETCHES.values()])
PENALTIES = {  # derivatives by J, of bulk modulus K
    "K/2 (J - 1)^2": lambda K, J: K * (J - 1),
    "k/2 (ln J)^2": lambda K, J: K * np.log(J) / J,
}
PAIRS = [(name, law) for name, program in PROGRAMS.items() for law in program.forms]


def parameters(name):
    """Values of a law, nearly incompressible; FEBio's Fung material has no matrix."""
    values = dict(zip((q.name for q in LAWS[name].quantities), ARGUMENTS[name], strict=True))
    if "kappa" in values:
        values["kappa"] *= 20.0
    return values


@cache
def our_stresses(name, **changes):
    law, values = LAWS[name], parameters(name) | changes
    axes = jnp.asarray(AXES[:2])

    def energy(H):
        return law.energy(Strain(H, None, axes), *map(jnp.asarray, values.values()))

    return np.asarray(jax.jit(jax.vmap(jax.grad(energy)))(jnp.asarray(GRADIENTS - np.eye(3))))


@pytest.mark.parametrize(("name", "law"), PAIRS)
def test_a_card_gives_our_stress(name, law):
    """All of it, or all but the documented pressure."""
    form, changes = PROGRAMS[name].forms[law], {}
    if (name, law) == ("febio", "fung_orthotropic"):
        changes = {"mu": 0.0}
    values = parameters(law) | changes
    energy = ENERGIES[name](write_card(PROGRAMS[name], LAWS[law], values), AXES)
    for F, ours in zip(GRADIENTS, our_stresses(law, **changes), strict=True):
        J, cofactor = np.linalg.det(F), np.linalg.det(F) * np.linalg.inv(F).T
        theirs = stress(energy, F)
        if form.penalty:
            K = values["kappa"]
            our_slope = K * (J - 1) if law == "guccione" else 0.5 * K * (J - 1 / J)
            ours = ours + (PENALTIES[form.penalty](K, J) - our_slope) * cofactor
        np.testing.assert_allclose(theirs, ours, rtol=0, atol=1e-10 * np.abs(ours).max())


def test_stretches_lengthen_and_shorten_fibres_and_sheets():
    squares = np.array([[a @ F.T @ F @ a / np.linalg.det(F) ** (2 / 3) for a in AXES[:2]]
                        for F in GRADIENTS])  # fmt: skip
    assert (squares[:-1].min(axis=0) < 0.95).all()
    assert (squares[:-1].max(axis=0) > 1.05).all()
    assert (np.abs(squares[:-1] - 1) > 0.03).all()  # where smooth switches are off or on


def test_a_wrong_factor_is_seen():
    values = parameters("ogden_1")
    card = write_card(PROGRAMS["febio"], LAWS["ogden_1"], values | {"mu_1": values["mu_1"] / 2})
    theirs, ours = stress(ENERGIES["febio"](card, AXES), GRADIENTS[0]), our_stresses("ogden_1")[0]
    assert np.abs(theirs - ours).max() > 0.01 * np.abs(ours).max()


def test_a_smooth_switch_misses_by_less_than_its_note_says():
    law, values = LAWS["holzapfel_ogden"], parameters("holzapfel_ogden")
    energy = ENERGIES["svmultiphysics"](write_card(PROGRAMS["svmultiphysics"], law, values), AXES)

    def our_energy(H):
        strain = Strain(H, None, jnp.asarray(AXES[:2]))
        return law.energy(strain, *map(jnp.asarray, values.values()))

    ours = jax.jit(jax.grad(our_energy))
    for stretch in np.linspace(-3e-3, 3e-3, 13):
        H = stretch * (np.outer(AXES[0], AXES[0]) - np.outer(AXES[1], AXES[1]))
        missed = stress(energy, np.eye(3) + H) - np.asarray(ours(jnp.asarray(H)))
        assert np.abs(missed).max() < values["a_f"] / SHARP


def test_felupe_takes_every_law_and_ten_go_elsewhere():
    assert PROGRAMS["felupe"].forms.keys() == LAWS.keys()
    others = {law for name, law in PAIRS if name != "felupe"}
    assert len(others) >= 10


def test_the_page_has_every_form():
    page = Path(__file__).parents[3] / "docs" / "neighbours.md"
    lines = [line.split(" | ") for line in page.read_text(encoding="utf-8").splitlines()]
    header = next(cells for cells in lines if cells[0] == "| law")
    assert [cell.rstrip(" |") for cell in header[1:]] == list(PROGRAMS)
    table = {
        cells[0].split("`")[1]: [cell.strip(" |") for cell in cells[1:]]
        for cells in lines
        if len(cells) == len(header) and cells[0].startswith("| `")
    }

    def word(form):
        smooth = form is not None and any("smooth" in sentence for sentence in form.differs)
        return (
            "" if form is None else "penalty" if form.penalty else "switch" if smooth else "equal"
        )

    assert table == {law: [word(p.forms.get(law)) for p in PROGRAMS.values()] for law in LAWS}


@pytest.mark.parametrize("name", PROGRAMS)
def test_a_law_that_the_program_lacks_is_refused_in_a_line(name):
    program = PROGRAMS[name]
    assert program.refusals.keys() <= LAWS.keys() - program.forms.keys()
    for law in LAWS.keys() - program.forms.keys():
        with pytest.raises(InputError, match=f"{program.title} cannot take law '{law}': ") as error:
            write_card(program, LAWS[law], parameters(law))
        assert "\n" not in str(error.value)


def test_the_moduli_at_rest_are_those_of_the_law():
    bulk, shear = moduli_at_rest(LAWS["neo_hookean"], {"mu": 3.0, "lam": 7.0})
    np.testing.assert_allclose([bulk, shear], [7.0 + 2.0 * 3.0 / 3.0, 3.0], rtol=1e-12)
    values = {"a": 3.0, "b": 2.0, "kappa": 25.0}
    bulk, shear = moduli_at_rest(LAWS["holzapfel_ogden_isotropic"], values)
    np.testing.assert_allclose([bulk, shear], [100.0, 3.0], rtol=1e-12)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"stiffness": 1.0},
            "'stiffness' is no parameter of law 'mooney_rivlin': c_10, c_01, kappa",
        ),
        ({"c_10": None}, "law 'mooney_rivlin' needs 'c_10'"),
        ({"c_10": -1.0}, "parameter 'c_10' is -1 kPa; it must be above 0"),
        ({"kappa": 50.0}, "bulk modulus of 50 kPa, 8.33 times its shear modulus; Abaqus resists"),
    ],
)
def test_bad_values(changes, message):
    values = {n: v for n, v in (parameters("mooney_rivlin") | changes).items() if v is not None}
    with pytest.raises(InputError) as error:
        write_card(PROGRAMS["abaqus"], LAWS["mooney_rivlin"], values)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_febio_has_no_fung_material_with_a_matrix_or_a_plane_of_no_resistance():
    law, values = LAWS["fung_orthotropic"], parameters("fung_orthotropic")
    with pytest.raises(InputError, match="parameter 'mu' is 1 kPa; only 0 can be exported"):
        write_card(PROGRAMS["febio"], law, values)
    with pytest.raises(InputError, match="convex in the normal strains"):
        write_card(PROGRAMS["febio"], law, values | {"mu": 0.0, "b_4": 30.0})
