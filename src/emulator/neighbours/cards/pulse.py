r"""pulse (fenicsx-pulse 0.12): a Python module with a function ``material``; mm and kPa.

pulse evaluates a material at the isochoric part of C, and adds a penalty (``CardiacModel.S``):

.. math:: \Psi = \Psi_m(J^{-2/3} C) + \frac{\kappa}{4} (J^2 - 1 - 2 \ln J)

with ``Compressible2``. Its Holzapfel-Ogden energy (``HolzapfelOgden``) is ours,

.. math::
    \Psi_m = \frac{a}{2b} (e^{b (I_1 - 3)} - 1)
        + \sum_{i = f, s} \frac{a_i}{2 b_i} (e^{b_i \langle I_{4i} - 1 \rangle^2} - 1)
        + \frac{a_{fs}}{2 b_{fs}} (e^{b_{fs} I_{8fs}^2} - 1)

without the switch where ``use_subplus`` and ``use_heaviside`` are false, and ``NeoHookean`` is
:math:`\frac{\mu}{2} (I_1 - 3)`. The kappa of ours counts four times, see
:mod:`emulator.mechanics.laws.holzapfel_ogden`; the released variant is the unswitched one with
twice the moduli. Guccione's energy is of the isochoric strain there, ours of the whole one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import meshio
import numpy as np

from emulator.neighbours.cards.card import (
    ISOCHORIC_GUCCIONE,
    SPLIT,
    ExportedBody,
    Form,
    Program,
    Values,
)

_SWITCH_OFF = ["use_subplus=False", "use_heaviside=False"]


def _module(name: str, values: Values, kappa: float, words: str = "") -> str:
    units = {key: "dimensionless" if key[0] == "b" else "kPa" for key in values}
    quantities = [
        f"        {key}=pulse.Variable({value!r}, {units[key]!r}),\n"
        for key, value in values.items()
    ]
    return (
        '"""A material of pulse: ``f0`` and ``s0`` are functions of fibres and sheets."""\n\n'
        "import pulse\n\n\n"
        "def material(f0=None, s0=None):\n"
        f"    return pulse.{name}(\n{''.join(quantities)}{words}    )\n\n\n"
        "def compressibility():\n"
        f'    return pulse.compressibility.Compressible2(pulse.Variable({kappa!r}, "kPa"))\n'
    )


def _exponential(*names: str, factor: float = 1.0, switch: bool = True) -> Callable[[Values], str]:
    """Return the writer of a Holzapfel-Ogden card; ``factor`` multiplies its moduli."""

    def write(v: Values) -> str:
        values = {n: factor * v[n] if n.startswith("a") else v[n] for n in names}
        directions = [f"{d}0={d}0" for d in ("f", "s") if f"a_{d}" in names]
        words = [", ".join(directions)] if directions else []
        words += [] if switch else _SWITCH_OFF
        lines = "".join(f"        {line},\n" for line in words)
        return _module("HolzapfelOgden", values, 4.0 * v["kappa"], lines)

    return write


def write_body(folder: Path, body: ExportedBody) -> list[str]:
    """Write ``body.xdmf``, directions in ``body.npz``, and ``case.py``, which reads both."""
    kind = "tetra" if body.mesh.order == 1 else "tetra10"
    content = meshio.Mesh(body.mesh.nodes, [(kind, body.mesh.elements)])
    meshio.write(folder / "body.xdmf", content, file_format="xdmf", data_format="XML")
    axes = body.axes
    arrays: dict[str, Any] = {} if axes is None else {"f0": axes[:, 0], "s0": axes[:, 1]}
    np.savez(folder / "body.npz", **arrays)
    (folder / "case.py").write_text(_CASE, encoding="utf-8")
    return ["body.xdmf", "body.npz", "case.py"]


_CASE = '''"""The body in pulse: ``build("mean")`` gives its mesh, and the model of a card."""

import importlib.util
from pathlib import Path

import dolfinx
import numpy
import pulse
from mpi4py import MPI

HERE = Path(__file__).resolve().parent


def build(card="mean"):
    spec = importlib.util.spec_from_file_location(card, HERE / f"{card}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    with dolfinx.io.XDMFFile(MPI.COMM_WORLD, HERE / "body.xdmf", "r") as file:
        mesh = file.read_mesh(name="Grid")
    space, directions = dolfinx.fem.functionspace(mesh, ("DG", 0, (3,))), {}
    with numpy.load(HERE / "body.npz") as body:
        for name in body:
            directions[name] = dolfinx.fem.Function(space)
            rows = body[name][mesh.topology.original_cell_index]
            directions[name].x.array[:] = rows.ravel()
    model = pulse.CardiacModel(
        material=module.material(**directions),
        active=pulse.active_model.Passive(),
        compressibility=module.compressibility(),
    )
    return mesh, model
'''
_FIBRES = ("a", "b", "a_f", "b_f")
_NEO_HOOKEAN = Form(lambda v: _module("NeoHookean", {"mu": v["mu"]}, v["kappa"]))
_FORMS: Mapping[str, Form] = {
    "neo_hookean_split": _NEO_HOOKEAN,
    "holzapfel_ogden_isotropic": Form(_exponential("a", "b")),
    "holzapfel_ogden": Form(_exponential(*_FIBRES)),
    "holzapfel_ogden_unswitched": Form(_exponential(*_FIBRES, switch=False)),
    "holzapfel_ogden_released": Form(_exponential(*_FIBRES, factor=2.0, switch=False)),
    "holzapfel_ogden_orthotropic": Form(_exponential(*_FIBRES, "a_s", "b_s", "a_fs", "b_fs")),
}
PULSE = Program(
    name="pulse",
    title="pulse 0.12",
    suffix=".py",
    units="mm, kPa (pulse converts; give its problem mesh_unit mm)",
    forms=_FORMS,
    refusals={"guccione": ISOCHORIC_GUCCIONE, **SPLIT},
    write_body=write_body,
    usage="A card is a module: `from mean import material, compressibility`. `case.py` builds "
    "mesh, directions and model of any card; give `StaticProblem` the `mesh_unit` `mm`.",
)
