r"""Input decks of keywords, which Abaqus and CalculiX share: isotropic laws, meshes, sets.

Both have the energies

.. math::
    U &= \sum_{ij} C_{ij} (\bar I_1 - 3)^i (\bar I_2 - 3)^j + \frac{1}{D_1} (J - 1)^2 \\
    U &= \sum_{i} \frac{2 \mu_i}{\alpha_i^2} \Big(\sum_k \bar\lambda_k^{\alpha_i} - 3\Big)
        + \frac{1}{D_1} (J - 1)^2

(Abaqus, "Hyperelastic behavior of rubberlike materials"; CalculiX, ``rubber.f``), so that
:math:`C_{10} = \mu/2` for the neo-Hookean law, Ogden's :math:`\mu_i, \alpha_i` are ours, and
:math:`D_1 = 2/\kappa`. Units are mm, MPa and N: moduli in kPa are divided by 1000.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from emulator.neighbours.cards.card import ExportedBody, Form, Values, digits, engineering, row

PER_KPA = 1e-3
"""Moduli in MPa for one of 1 kPa."""
SQUARE = "K/2 (J - 1)^2"
"""The penalty of both programs, K = 2/D1."""
_LINEAR = ("Small strains: the step must not have NLGEOM.",)


def deck(name: str, *blocks: Sequence[str]) -> str:
    """Return a card: the material ``name`` and its keywords, each with lines of data."""
    lines = [f"*MATERIAL, NAME={name}"]
    for block in blocks:
        lines += block
    return "\n".join(lines) + "\n"


def data(numbers: Iterable[float], per_line: int = 8) -> list[str]:
    """Return lines of data with at most ``per_line`` numbers."""
    words = list(map(digits, numbers))
    return [", ".join(words[k : k + per_line]) for k in range(0, len(words), per_line)]


def isotropic_forms(unused: float) -> Mapping[str, Form]:
    """Return the forms of isotropic laws; ``unused`` is the D of a higher power that is absent."""

    def hyperelastic(kind: str, moduli: Iterable[float], kappa: float, terms: int) -> str:
        volume = [2.0 / (PER_KPA * kappa), *([unused] * (terms - 1))]
        return deck("TISSUE", [f"*HYPERELASTIC, {kind}", *data([*moduli, *volume])])

    def polynomial(kind: str, *names: str, terms: int = 1) -> Form:
        def write(v: Values) -> str:
            return hyperelastic(kind, [PER_KPA * v[n] for n in names], v["kappa"], terms)

        return Form(write, penalty=SQUARE)

    def neo_hookean(v: Values) -> str:
        return hyperelastic("NEO HOOKE", [PER_KPA * v["mu"] / 2.0], v["kappa"], 1)

    def ogden(terms: int) -> Form:
        def write(v: Values) -> str:
            pairs = [
                x for k in range(1, terms + 1) for x in (PER_KPA * v[f"mu_{k}"], v[f"alpha_{k}"])
            ]
            return hyperelastic(f"OGDEN, N={terms}", pairs, v["kappa"], terms)

        return Form(write, penalty=SQUARE)

    def elastic(E: float, nu: float) -> str:
        return deck("TISSUE", ["*ELASTIC", *data([PER_KPA * E, nu])])

    def lame(v: Values) -> str:
        return elastic(*engineering(v["mu"], v["lam"]))

    return {
        "neo_hookean_split": Form(neo_hookean, penalty=SQUARE),
        "mooney_rivlin": polynomial("MOONEY-RIVLIN", "c_10", "c_01"),
        "yeoh": polynomial("YEOH", "c_1", "c_2", "c_3", terms=3),
        "ogden_1": ogden(1),
        "ogden_2": ogden(2),
        "ogden_3": ogden(3),
        "small_strain": Form(lame, differs=_LINEAR),
        "small_strain_E_nu": Form(lambda v: elastic(v["E"], v["nu"]), differs=_LINEAR),
    }


def mesh_lines(body: ExportedBody) -> list[str]:
    """Return nodes, elements and node sets."""
    lines = ["*NODE, NSET=ALL"]
    lines += [f"{k}, {row(point)}" for k, point in enumerate(body.mesh.nodes, start=1)]
    lines.append(f"*ELEMENT, TYPE={'C3D4' if body.mesh.order == 1 else 'C3D10'}, ELSET=BODY")
    for k, nodes in enumerate(body.mesh.elements + 1, start=1):
        lines.append(", ".join(map(str, (k, *nodes))))
    for name, nodes in body.mesh.node_sets.items():
        lines.append(f"*NSET, NSET={name.upper()}")
        for k in range(0, len(nodes), 8):
            lines.append(", ".join(map(str, nodes[k : k + 8] + 1)))
    return lines


def write_deck(
    folder: Path, body: ExportedBody, material: str, axes: np.ndarray | None, head: Sequence[str]
) -> list[str]:
    """Write ``body.inp``: mesh, sets and axes, with the material of ``mean.inp``.

    material : its name.
    axes : the six components (m, 6) of two vectors of each element; None without fibres.
    head : the lines that begin the distribution of these.
    """
    lines, section = mesh_lines(body), f"*SOLID SECTION, ELSET=BODY, MATERIAL={material}"
    if axes is not None:
        lines += [*head, ", 1., 0., 0., 0., 1., 0."]
        lines += [f"{k}, {row(six)}" for k, six in enumerate(axes, start=1)]
        section += ", ORIENTATION=FIBRES"
    lines += ["*INCLUDE, INPUT=mean.inp", section]
    (folder / "body.inp").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return ["body.inp"]
