r"""Abaqus: keywords of an input file, mm, MPa and N.

Isotropic laws are those of :mod:`emulator.neighbours.cards.inp`. Arterial walls are ours,

.. math::
    U = C_{10} (\bar I_1 - 3) + \frac{1}{D} \Big(\frac{J^2 - 1}{2} - \ln J\Big)
      + \frac{k_1}{2 k_2} \sum_\alpha \big(e^{k_2 \langle \bar E_\alpha \rangle^2} - 1\big), \quad
    \bar E_\alpha = \kappa (\bar I_1 - 3) + (1 - 3 \kappa)(\bar I_{4\alpha} - 1)

(Abaqus, "Anisotropic hyperelastic behavior", Holzapfel-Gasser-Ogden form; ``*ANISOTROPIC
HYPERELASTIC, HOLZAPFEL`` with data C10, D, k1, k2, kappa), with :math:`C_{10} = c/2`,
:math:`D = 2/\kappa`, since :math:`\frac{\kappa}{2} (\frac{J^2 - 1}{2} - \ln J)` is our volumetric
part, and its kappa our dispersion. The two families are local directions of the orientation,
:math:`(\cos\beta, \pm\sin\beta, 0)` in axes of fibre and sheet. Abaqus's Fung energies are of the
isochoric strain, ours of the whole one.
"""

from __future__ import annotations

from math import cos, radians, sin
from pathlib import Path

from emulator.neighbours.cards.card import SPLIT, ExportedBody, Form, Program, Values
from emulator.neighbours.cards.inp import PER_KPA, data, deck, isotropic_forms, write_deck


def _two_families(v: Values) -> str:
    beta = radians(v["angle"])
    numbers = [
        PER_KPA * v["c"] / 2.0,
        2.0 / (PER_KPA * v["kappa"]),
        PER_KPA * v["k_1"],
        v["k_2"],
        v.get("dispersion", 0.0),
    ]
    return deck(
        "TISSUE",
        ["*ANISOTROPIC HYPERELASTIC, HOLZAPFEL, LOCAL DIRECTIONS=2", *data(numbers)],
        ["*ORIENTATION, NAME=FIBRES, LOCAL DIRECTIONS=2", "FIBRE_AXES", "3, 0."],
        [*data([cos(beta), sin(beta), 0.0]), *data([cos(beta), -sin(beta), 0.0])],
    )


def write_body(folder: Path, body: ExportedBody) -> list[str]:
    """Write ``body.inp``: mesh, sets and axes of fibre and sheet."""
    axes = None if body.axes is None else body.axes.reshape(-1, 6)
    return write_deck(folder, body, "TISSUE", axes, _DISTRIBUTION)


_DISTRIBUTION = (
    "*DISTRIBUTION TABLE, NAME=TWO_VECTORS",
    "COORD3D, COORD3D",
    "*DISTRIBUTION, NAME=FIBRE_AXES, LOCATION=ELEMENT, TABLE=TWO_VECTORS",
)
_ISOCHORIC = "its Fung energies are of the isochoric strain, so that forces would differ"
ABAQUS = Program(
    name="abaqus",
    title="Abaqus",
    suffix=".inp",
    units="mm, MPa, N",
    forms={
        **isotropic_forms(unused=0.0),
        "holzapfel_gasser_ogden": Form(_two_families),
        "gasser_ogden_holzapfel": Form(_two_families),
    },
    refusals={
        **dict.fromkeys(("guccione", "fung_orthotropic", "fung_planar"), _ISOCHORIC),
        **SPLIT,
    },
    write_body=write_body,
    usage="`*INCLUDE, INPUT=mean.inp` reads a card; `body.inp` does, and needs a step. Cards with "
    "fibres take their axes (fibre, sheet) from a distribution named `FIBRE_AXES`.",
)
