r"""FElupe: a Python module with a function ``umat``, mm, kPa and mN.

FElupe takes an energy of C as a function and differentiates it (``felupe.Hyperelastic``), so every
law goes out as it is, its volumetric part included. Two laws are FElupe's own classes:

.. math::
    \psi = \frac{\mu}{2} \operatorname{tr} C - \mu \ln J + \frac{\lambda}{2} (\ln J)^2

(``felupe.NeoHookeCompressible``) and ``felupe.LinearElastic`` of E and nu. Sums of powers of
principal stretches take eigenvalues, which FElupe moves apart by a little where two are equal.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from emulator.neighbours.cards.card import ExportedBody, Form, Program, Values, engineering

_HEAD = '''"""A material of FElupe, in mm, kPa and mN. Fibres (3, ...) are unit vectors at rest."""

import felupe
'''
_MEASURES = {
    "x": "J ** (-2 / 3) * tm.trace(tensor) - 3",
    "y": "J ** (-4 / 3) * (tm.trace(tensor) ** 2 - tm.trace(tensor @ tensor)) / 2 - 3",
    "f": "J ** (-2 / 3) * along(tensor, fibre, fibre) - 1",
    "s": "J ** (-2 / 3) * along(tensor, sheet, sheet) - 1",
    "g": "J ** (-2 / 3) * along(tensor, fibre, sheet)",
    "w": "J ** (-2 / 3) * tm.linalg.eigvalsh(tensor)",
    "ff": "(along(tensor, fibre, fibre) - 1) / 2",
    "ss": "(along(tensor, sheet, sheet) - 1) / 2",
    "fs": "along(tensor, fibre, sheet) / 2",
    "nn": "(along(tensor, normal, normal) - 1) / 2",
    "sn": "along(tensor, sheet, normal) / 2",
    "nf": "along(tensor, normal, fibre) / 2",
}
"""Measures of C, called ``tensor``: isochoric invariants less their values at rest, and strains."""
_VOLUME = "kappa / 4 * (J**2 - 1 - 2 * tm.log(J))"
_FOUR_VOLUMES = "kappa * (J**2 - 1 - 2 * tm.log(J))"


def _module(v: Values, measures: str, energy: str, before: str = "") -> str:
    names = ", ".join(v)
    lines = [f"    {name} = {_MEASURES[name]}" for name in measures.split()]
    lines += [f"    {line}" for line in before.splitlines()]
    parameters = "".join(f"    {name!r}: {value!r},\n" for name, value in v.items())
    return (
        f"{_HEAD}import numpy\nimport tensortrax.math as tm\n\n"
        f"PARAMETERS = {{\n{parameters}}}\n\n\n"
        "def along(tensor, one, other):\n"
        '    return tm.einsum("i...,ij...,j...->...", one, tensor, other)\n\n\n'
        f"def energy(tensor, fibre, sheet, normal, {names}):\n"
        "    J = tm.sqrt(tm.linalg.det(tensor))\n"
        + "".join(f"{line}\n" for line in lines)
        + f"    return {energy}\n\n\n"
        "def umat(fibre=None, sheet=None):\n"
        "    normal = None if sheet is None else numpy.cross(fibre, sheet, axis=0)\n"
        "    directions = {'fibre': fibre, 'sheet': sheet, 'normal': normal}\n"
        "    return felupe.Hyperelastic(energy, **directions, **PARAMETERS)\n"
    )


def _form(measures: str, energy: str, volume: str = _VOLUME, before: str = "") -> Form:
    text = f"{energy} + {volume}"
    return Form(lambda v: _module(v, measures, text, before))


def _class(call: Callable[[Values], str]) -> Form:
    def write(v: Values) -> str:
        return f"{_HEAD}\n\ndef umat(fibre=None, sheet=None):\n    return felupe.{call(v)}\n"

    return Form(write)


def _lame(v: Values) -> str:
    return f"NeoHookeCompressible(mu={v['mu']!r}, lmbda={v['lam']!r})"


def _lame_of_engineering(v: Values) -> str:
    E, nu = v["E"], v["nu"]
    return _lame({"mu": E / (2.0 * (1.0 + nu)), "lam": E * nu / ((1.0 + nu) * (1.0 - 2.0 * nu))})


def _linear(v: Values) -> str:
    E, nu = engineering(v["mu"], v["lam"])
    return f"LinearElastic(E={E!r}, nu={nu!r})"


def _ogden(terms: int) -> Form:
    sums = (
        f"2 * mu_{k} / alpha_{k}**2 * (tm.sum(w ** (alpha_{k} / 2), axis=0) - 3)"
        for k in range(1, terms + 1)
    )
    return _form("w", " + ".join(sums))


def _fibres(name: str) -> str:
    return f"a_{name} / (2 * b_{name}) * (tm.exp(b_{name} * {name}**2) - 1)"


_MATRIX = "a / (2 * b) * (tm.exp(b * x) - 1)"
_PARALLEL = f"{_MATRIX} + {_fibres('f')}"
_TENSION = "f = tm.maximum(f, 0.0)"
_ORTHOTROPIC = f"{_PARALLEL} + {_fibres('s')} + a_fs / (2 * b_fs) * (tm.exp(b_fs * g**2) - 1)"
_BOTH_TENSIONS = f"{_TENSION}\ns = tm.maximum(s, 0.0)"
_MEAN = "f = dispersion * x + (1 - 3 * dispersion) * f"
_FAMILIES = """\
beta = numpy.deg2rad(angle)
shear = numpy.sin(2 * beta) * g
both = numpy.cos(beta) ** 2 * f + numpy.sin(beta) ** 2 * s
one = tm.maximum({0} * x + (1 - 3 * {0}) * (both + shear), 0.0)
other = tm.maximum({0} * x + (1 - 3 * {0}) * (both - shear), 0.0)"""
_ARTERY = "c / 2 * x + k_1 / (2 * k_2) * (tm.exp(k_2 * one**2) + tm.exp(k_2 * other**2) - 2)"
_TERMS = """\
f, s = tm.maximum(f, 0.0), tm.maximum(s, 0.0)
isotropic = I1 * x / 2 + I1_2 * x**2 / 2 + I1_e / 20 * (tm.exp(10 * x) - 1)
isotropic = isotropic + I2 * y / 2 + I2_2 * y**2 / 2
fibres = f_2 * f**2 / 2 + f_3 * f**3 / 3 + f_e / 40 * (tm.exp(20 * f**2) - 1)
sheets = s_2 * s**2 / 2 + s_e / 40 * (tm.exp(20 * s**2) - 1)
shear = fs_2 * g**2 / 2 + fs_e / 40 * (tm.exp(20 * g**2) - 1)"""
_FUNG = "C / 2 * (tm.exp(Q) - 1) + mu / 2 * x"
_Q_PLANE = "Q = b_1 * ff**2 + b_2 * ss**2 + 2 * b_4 * ff * ss + 4 * b_7 * fs**2"
_Q_BODY = f"""\
{_Q_PLANE}
Q = Q + b_3 * nn**2 + 2 * b_5 * ss * nn + 2 * b_6 * nn * ff + 4 * b_8 * sn**2 + 4 * b_9 * nf**2"""
_Q_GUCCIONE = """\
square = (tm.trace(tensor @ tensor) - 2 * tm.trace(tensor) + 3) / 4
row = (along(tensor @ tensor, fibre, fibre) - 2 * along(tensor, fibre, fibre) + 1) / 4
Q = b_f * ff**2 + b_t * (square - 2 * row + ff**2) + 2 * b_fs * (row - ff**2)"""


def write_body(folder: Path, body: ExportedBody) -> list[str]:
    """Write ``body.npz``, the mesh and its directions, and ``case.py``, which builds the solid."""
    arrays: dict[str, Any] = {"points": body.mesh.nodes, "cells": body.mesh.elements}
    for name, directions in (("fibre", body.fibres), ("sheet", body.sheets)):
        if directions is not None:
            arrays[name] = np.ascontiguousarray(directions.T[:, None])  # (3, 1, m)
    arrays |= {f"nodes {name}": nodes for name, nodes in body.mesh.node_sets.items()}
    np.savez(folder / "body.npz", **arrays)
    linear = body.mesh.order == 1
    kind, region = ("tetra", "RegionTetra") if linear else ("tetra10", "RegionQuadraticTetra")
    text = _CASE.replace("KIND", kind).replace("REGION", region)
    (folder / "case.py").write_text(text, encoding="utf-8")
    return ["body.npz", "case.py"]


_CASE = '''"""The body in FElupe: ``build("mean")`` gives its field, and its solid of a card."""

import importlib.util
from pathlib import Path

import felupe
import numpy

HERE = Path(__file__).resolve().parent


def build(card="mean"):
    spec = importlib.util.spec_from_file_location(card, HERE / f"{card}.py")
    material = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(material)
    with numpy.load(HERE / "body.npz") as body:
        mesh = felupe.Mesh(body["points"], body["cells"], "KIND")
        directions = {name: body[name] for name in ("fibre", "sheet") if name in body}
    field = felupe.FieldContainer([felupe.Field(felupe.REGION(mesh), dim=3)])
    return field, felupe.SolidBody(material.umat(**directions), field)


if __name__ == "__main__":
    field, solid = build()
    forces = solid.assemble.vector(field).toarray()
    print(f"{len(forces) // 3} nodes, largest force at rest {abs(forces).max():.2g} mN")
'''
_FORMS: Mapping[str, Form] = {
    "neo_hookean": _class(_lame),
    "neo_hookean_E_nu": _class(_lame_of_engineering),
    "small_strain": _class(_linear),
    "small_strain_E_nu": _class(lambda v: f"LinearElastic(E={v['E']!r}, nu={v['nu']!r})"),
    "neo_hookean_split": _form("x", "mu / 2 * x"),
    "mooney_rivlin": _form("x y", "c_10 * x + c_01 * y"),
    "yeoh": _form("x", "c_1 * x + c_2 * x**2 + c_3 * x**3"),
    **{f"ogden_{terms}": _ogden(terms) for terms in (1, 2, 3)},
    "holzapfel_ogden_isotropic": _form("x", _MATRIX, _FOUR_VOLUMES),
    "holzapfel_ogden": _form("x f", _PARALLEL, _FOUR_VOLUMES, _TENSION),
    "holzapfel_ogden_unswitched": _form("x f", _PARALLEL, _FOUR_VOLUMES),
    "holzapfel_ogden_released": _form("x f", f"2 * ({_PARALLEL})", _FOUR_VOLUMES),
    "holzapfel_ogden_dispersed": _form("x f", _PARALLEL, _FOUR_VOLUMES, f"{_MEAN}\n{_TENSION}"),
    "holzapfel_ogden_dispersed_unswitched": _form("x f", _PARALLEL, _FOUR_VOLUMES, _MEAN),
    "holzapfel_ogden_orthotropic": _form("x f s g", _ORTHOTROPIC, _FOUR_VOLUMES, _BOTH_TENSIONS),
    "holzapfel_gasser_ogden": _form("x f s g", _ARTERY, before=_FAMILIES.format("0.0")),
    "gasser_ogden_holzapfel": _form("x f s g", _ARTERY, before=_FAMILIES.format("dispersion")),
    "guccione": _form("ff", "C / 2 * (tm.exp(Q) - 1)", "kappa / 2 * (J - 1) ** 2", _Q_GUCCIONE),
    "fung_planar": _form("x ff ss fs", _FUNG, before=_Q_PLANE),
    "fung_orthotropic": _form("x ff ss fs nn sn nf", _FUNG, before=_Q_BODY),
    "may_newman": _form(
        "x f",
        "c_0 * (tm.exp(c_1 * x**2 + c_2 * (tm.sqrt(f + 1) - 1) ** 4) - 1) + mu / 2 * x",
    ),
    "invariant_terms": _form("x y f s g", "isotropic + fibres + sheets + shear", before=_TERMS),
}
FELUPE = Program(
    name="felupe",
    title="FElupe 11",
    suffix=".py",
    units="mm, kPa, mN",
    forms=_FORMS,
    write_body=write_body,
    usage="A card is a module: `from mean import umat`, then `felupe.SolidBody(umat(fibre, sheet), "
    "field)`. `case.py` builds body and material of any card. Needs `felupe` and `tensortrax`.",
)
