r"""svMultiPhysics: the material part of an equation in XML; kg, mm, s, hence kPa and mN.

The penalty ``ST91`` has the pressure :math:`p = \frac{K_p}{2} (J - 1/J)`, that is, our

.. math:: U = \frac{K_p}{4} (J^2 - 1 - 2 \ln J)

(``compute_svol_p``), and isochoric energies (``compute_pk2cc`` in ``mat_models.cpp``, constants in
``set_material_props.h``) are

.. math::
    \Psi_\text{nHK} &= \frac{\mu}{2} (\bar I_1 - 3), \quad \mu = \frac{E}{2(1 + \nu)}, \qquad
    \Psi_\text{MR} = c_1 (\bar I_1 - 3) + c_2 (\bar I_2 - 3) \\
    \Psi_\text{HO} &= \frac{a}{2b} e^{b (\bar I_1 - 3)}
        + \sum_{i = f, s} \frac{a_i}{2 b_i} \chi(\bar I_{4i}) (e^{b_i (\bar I_{4i} - 1)^2} - 1)
        + \frac{a_{fs}}{2 b_{fs}} (e^{b_{fs} \bar I_{8fs}^2} - 1), \qquad
    \chi = \frac{1}{1 + e^{-k (\bar I_{4i} - 1)}} .

The switch is smooth, and sharp for large k: with :data:`SHARP` stresses of fibres differ where
:math:`|\bar I_4 - 1|` is below some 1/k, by less than a_f/k. With k = 0, chi is 1/2 everywhere, so
that twice a_f gives fibres without a switch. The material always reads two directions; a law
without sheets gets a_s = a_fs = 0. Dispersed and arterial fibres (``HGO``) have no switch there,
and Guccione's energy is of the isochoric strain.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import meshio
import numpy as np

from emulator.neighbours.cards.card import (
    ISOCHORIC_GUCCIONE,
    SPLIT,
    ExportedBody,
    Form,
    Program,
    Values,
    digits,
)

SHARP = 1e3
"""The k of the switch: larger ones overflow at stretches of 1.3."""


def _card(kind: str, bulk: float, inner: Mapping[str, float], outer: Mapping[str, float]) -> str:
    lines = [f"<{name}> {digits(value)} </{name}>" for name, value in outer.items()]
    lines.append(f'<Constitutive_model type="{kind}">')
    lines += [f"  <{name}> {digits(value)} </{name}>" for name, value in inner.items()]
    lines += [
        "</Constitutive_model>",
        "<Dilational_penalty_model> ST91 </Dilational_penalty_model>",
        f"<Penalty_parameter> {digits(bulk)} </Penalty_parameter>",
    ]
    return "\n".join(lines) + "\n"


def _elastic(mu: float, kappa: float) -> dict[str, float]:
    """Return E and nu of a shear and a bulk modulus in kPa."""
    E, nu = (
        9.0 * kappa * mu / (3.0 * kappa + mu),
        (3.0 * kappa - 2.0 * mu) / (6.0 * kappa + 2.0 * mu),
    )
    return {"Elasticity_modulus": E, "Poisson_ratio": nu}


def _neo_hookean(v: Values) -> str:
    return _card("neoHookean", v["kappa"], {}, _elastic(v["mu"], v["kappa"]))


def _mooney_rivlin(v: Values) -> str:
    outer = _elastic(2.0 * (v["c_10"] + v["c_01"]), v["kappa"])
    return _card("Mooney-Rivlin", v["kappa"], {"c1": v["c_10"], "c2": v["c_01"]}, outer)


def _exponential(factor: float = 1.0, *, switch: bool = True) -> Callable[[Values], str]:
    """Return the writer of a Holzapfel-Ogden card; ``factor`` multiplies its moduli."""

    def write(v: Values) -> str:
        fibres = factor if switch else 2.0 * factor
        inner = {"a": factor * v["a"], "b": v["b"]}
        inner |= {"a4f": fibres * v.get("a_f", 0.0), "b4f": v.get("b_f", 1.0)}
        inner |= {"a4s": fibres * v.get("a_s", 0.0), "b4s": v.get("b_s", 1.0)}
        inner |= {"afs": factor * v.get("a_fs", 0.0), "bfs": v.get("b_fs", 1.0)}
        bulk = 4.0 * v["kappa"]
        inner["k"] = SHARP if switch else 0.0
        outer = _elastic(factor * v["a"], bulk)
        return _card("HolzapfelOgden", bulk, inner, outer)

    return write


def write_body(folder: Path, body: ExportedBody) -> list[str]:
    """Write the mesh and, for each direction, a file of the mesh with the cell data FIB_DIR."""
    kind = "tetra" if body.mesh.order == 1 else "tetra10"
    cells = [(kind, body.mesh.elements)]
    nodes, elements = (
        np.arange(1, len(rows) + 1, dtype=np.int32)
        for rows in (body.mesh.nodes, body.mesh.elements)
    )
    numbers = {"GlobalElementID": [elements]}
    axes = body.axes
    axes = np.tile(np.eye(3)[:2], (len(elements), 1, 1)) if axes is None else axes
    contents = {
        "body.vtu": numbers,
        "fibres.vtu": {"FIB_DIR": [axes[:, 0]]},
        "sheets.vtu": {"FIB_DIR": [axes[:, 1]]},
    }
    for name, cell_data in contents.items():
        points = {"GlobalNodeID": nodes}
        content = meshio.Mesh(body.mesh.nodes, cells, point_data=points, cell_data=cell_data)
        meshio.write(folder / name, content, file_format="vtu")
    return list(contents)


_SMOOTH = (
    f"Fibres are switched off in compression by a smooth function, k = {SHARP:g}: their stress "
    "differs by less than a_f/k, where the squared stretch differs from 1 by less than about 1/k.",
)
_OFF = ("k = 0 halves the fibres' energy at every stretch, so their moduli are doubled.",)
SVMULTIPHYSICS = Program(
    name="svmultiphysics",
    title="svMultiPhysics",
    suffix=".xml",
    units="kg, mm, s, hence kPa and mN",
    forms={
        "neo_hookean_split": Form(_neo_hookean),
        "mooney_rivlin": Form(_mooney_rivlin),
        "holzapfel_ogden_isotropic": Form(_exponential()),
        "holzapfel_ogden": Form(_exponential(), differs=_SMOOTH),
        "holzapfel_ogden_unswitched": Form(_exponential(switch=False), differs=_OFF),
        "holzapfel_ogden_released": Form(_exponential(2.0, switch=False), differs=_OFF),
        "holzapfel_ogden_orthotropic": Form(_exponential(), differs=_SMOOTH),
    },
    refusals={
        **dict.fromkeys(
            ("holzapfel_gasser_ogden", "gasser_ogden_holzapfel"),
            "its arterial fibres resist compression, too, so that forces would differ",
        ),
        "guccione": ISOCHORIC_GUCCIONE,
        **SPLIT,
    },
    write_body=write_body,
    usage='Put a card\'s elements into `Add_equation type="struct"`, `body.vtu` and both '
    "`Fiber_direction_file_path` (fibres, then sheets) into `Add_mesh`. Faces are not written.",
)
