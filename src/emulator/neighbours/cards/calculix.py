r"""CalculiX: keywords of an input file, mm, MPa and N.

Isotropic laws are those of :mod:`emulator.neighbours.cards.inp`. CalculiX replaces a D that is 0 by
a number of its own (``hyperelastics.f``), so that powers of J - 1 that are absent get a D of 1e20.
Fields of numbers have 20 characters.

Two families of parallel fibres are the material whose name begins with ``ELASTIC_FIBER``,

.. math::
    U = C_{10} (\bar I_1 - 3) + \frac{1}{D_1} (J - 1)^2
      + \sum_i \frac{k_{1i}}{2 k_{2i}} \big(e^{k_{2i} \langle \bar J_{4i} - 1 \rangle^2} - 1\big)

(``umat_elastic_fiber.f``; manual, "Fiber reinforced material"), with :math:`C_{10} = c/2` and
:math:`D_1 = 2/\kappa`. Of a fibre it reads two components and takes the third one, positive, from
the length 1. Axes are therefore sheet, fibre x sheet, fibre: :math:`(\pm\sin\beta, 0, \cos\beta)`.
"""

from __future__ import annotations

from math import radians, sin
from pathlib import Path

import numpy as np

from emulator.neighbours.cards.card import SPLIT, ExportedBody, Form, Program, Values
from emulator.neighbours.cards.inp import PER_KPA, SQUARE, data, deck, isotropic_forms, write_deck

_FIBRE_NAME = "ELASTIC_FIBER_TISSUE"


def _two_families(v: Values) -> str:
    across, k_1 = sin(radians(v["angle"])), PER_KPA * v["k_1"]
    numbers = [PER_KPA * v["c"] / 2.0, 2.0 / (PER_KPA * v["kappa"])]
    for sign in (1.0, -1.0):
        numbers += [sign * across, 0.0, k_1, v["k_2"]]
    return deck(
        _FIBRE_NAME,
        [f"*USER MATERIAL, CONSTANTS={len(numbers)}", *data(numbers)],
        ["*ORIENTATION, NAME=FIBRES, SYSTEM=RECTANGULAR", "FIBRE_AXES"],
    )


def write_body(folder: Path, body: ExportedBody) -> list[str]:
    """Write ``body.inp``: mesh, sets and axes of sheet and fibre x sheet."""
    head = ["*DISTRIBUTION, NAME=FIBRE_AXES"]
    if (axes := body.axes) is None:
        return write_deck(folder, body, "TISSUE", None, head)
    six = np.concatenate([axes[:, 1], np.cross(axes[:, 0], axes[:, 1])], axis=1)
    return write_deck(folder, body, _FIBRE_NAME, six, head)


CALCULIX = Program(
    name="calculix",
    title="CalculiX",
    suffix=".inp",
    units="mm, MPa, N",
    forms={
        **isotropic_forms(unused=1e20),
        "holzapfel_gasser_ogden": Form(_two_families, penalty=SQUARE),
    },
    refusals={
        "gasser_ogden_holzapfel": "its fibres are not dispersed",
        **SPLIT,
    },
    write_body=write_body,
    usage="`*INCLUDE, INPUT=mean.inp` reads a card; `body.inp` does, and needs a step. Cards with "
    "fibres take their axes (sheet, fibre x sheet) from a distribution named `FIBRE_AXES`.",
)
