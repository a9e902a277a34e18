r"""FEBio 4: ``<material>`` in XML.

Uncoupled materials have an energy of the isochoric part of C and a penalty. Of its pressure models
"Abaqus (GOH)" is ours,

.. math:: U = \frac{k}{2} \Big(\frac{J^2 - 1}{2} - \ln J\Big) = \frac{k}{4} (J^2 - 1 - 2 \ln J)

(``FEUncoupledMaterial::U``), so that k is kappa, and four times the kappa of Holzapfel-Ogden laws,
whose volumetric part is :math:`\kappa (J^2 - 1 - 2 \ln J)`. Only a material at the top has k.

=========================  =====================================================================
neo-Hookean                :math:`\frac{\mu}{2}(I_1 - 3) - \mu \ln J + \frac{\lambda}{2}(\ln J)^2`
                           with E and v (``FENeoHookean``)
Mooney-Rivlin              :math:`c_1 (\bar I_1 - 3) + c_2 (\bar I_2 - 3)`
Yeoh                       :math:`\sum_i c_i (\bar I_1 - 3)^i` (``FEYeoh``)
Ogden                      :math:`\sum_i c_i / m_i^2\, (\sum_k \bar\lambda_k^{m_i} - 3)`: our
                           :math:`2 \mu_i / \alpha_i^2` gives :math:`c_i = 2 \mu_i`
Veronda-Westmann           :math:`c_1 (e^{c_2 (\bar I_1 - 3)} - 1) - \frac{c_1 c_2}{2}
                           (\bar I_2 - 3)` (``FEVerondaWestmann``)
fiber-exp-pow-uncoupled    :math:`\frac{\xi}{\alpha\beta} (e^{\alpha \langle \bar I_n - 1
                           \rangle^\beta} - 1)` (``FEFiberExpPowUncoupled``), in tension only
Holzapfel-Gasser-Ogden     :math:`\frac{c}{2} (\bar I_1 - 3) + \sum_i \frac{k_1}{2 k_2} (e^{k_2
                           \langle E_i \rangle^2} - 1)`, fibres at :math:`\pm\gamma` from axis 1
                           in the plane of 1 and 2 (``FEHolzapfelGasserOgden``)
Fung-ortho-compressible    :math:`\frac{c}{2} (e^Q - 1) + \frac{k}{2} (\ln J)^2`, Q of the whole
                           Green-Lagrange strain (``FEFungOrthoCompressible``)
=========================  =====================================================================

The exponential matrix :math:`\frac{a}{2b} (e^{b (\bar I_1 - 3)} - 1)` is the mixture of
Veronda-Westmann with :math:`c_1 = a/2b, c_2 = b` and Mooney-Rivlin with :math:`c_1 = 0, c_2 = a/4`,
which takes out its second term; dispersed fibres are the Holzapfel-Gasser-Ogden material with
:math:`c = \gamma = 0` and half of a_f, because it has two families. With the matrix of Q,

.. math::
    c\, Q = \sum_{ij} K_{ij} E_{ii} E_{jj} + 4 (G_{12} E_{12}^2 + G_{23} E_{23}^2 + G_{31} E_{31}^2)

and the compliance :math:`S = K^{-1}`: :math:`E_i = 1/S_{ii}`, :math:`\nu_{12} = -S_{12} E_1`,
:math:`\nu_{23} = -S_{23} E_2`, :math:`\nu_{31} = -S_{31} E_3`.

Source of all: the files of these classes in FEBio's repository, folder FEBioMech, and the user
manual's sections on materials, ``MeshData`` and the attribute ``from``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError
from emulator.mechanics.kinematics import cofactor, determinant
from emulator.neighbours.cards.card import (
    ExportedBody,
    Form,
    Program,
    Values,
    digits,
    engineering,
    row,
)

_FIBRE = '<fiber type="vector">1,0,0</fiber>'
_VOLUME = "<pressure_model>Abaqus (GOH)</pressure_model>"


def _entries(**values: float) -> list[str]:
    return [f"<{name}>{digits(value)}</{name}>" for name, value in values.items()]


def _solid(kind: str, lines: Iterable[str]) -> list[str]:
    return [f'<solid type="{kind}">', *(f"  {line}" for line in lines), "</solid>"]


def _card(kind: str, lines: Iterable[str]) -> str:
    content = "\n".join(f"      {line}" for line in ["<density>1</density>", *lines])
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<febio_spec version="4.0">\n  <Material>\n'
        f'    <material id="1" name="tissue" type="{kind}">\n{content}\n    </material>\n'
        "  </Material>\n</febio_spec>\n"
    )


def _uncoupled(kind: str, bulk: float, lines: Iterable[str]) -> str:
    return _card(kind, [*_entries(k=bulk), _VOLUME, *lines])


def _same(kind: str, **names: str) -> Form:
    """Return the form of an uncoupled material that has our parameters under its ``names``."""

    def write(v: Values) -> str:
        return _uncoupled(kind, v["kappa"], _entries(**{key: v[n] for key, n in names.items()}))

    return Form(write)


def _lame(v: Values) -> str:
    E, nu = engineering(v["mu"], v["lam"])
    return _card("neo-Hookean", _entries(E=E, v=nu))


def _ogden(v: Values) -> str:
    terms = range(1, (len(v) - 1) // 2 + 1)
    moduli = {f"c{k}": 2.0 * v[f"mu_{k}"] for k in terms}
    exponents = {f"m{k}": v[f"alpha_{k}"] for k in terms}
    return _uncoupled("Ogden", v["kappa"], _entries(**moduli, **exponents))


def _exponential_matrix(v: Values) -> list[str]:
    exponential = _entries(c1=v["a"] / (2.0 * v["b"]), c2=v["b"])
    return [
        *_solid("Veronda-Westmann", exponential),
        *_solid("Mooney-Rivlin", _entries(c1=0.0, c2=v["a"] / 4.0)),
    ]


def _mixture(fibres: Callable[[Values], list[str]]) -> Callable[[Values], str]:
    def write(v: Values) -> str:
        solids = [*_exponential_matrix(v), *fibres(v)]
        return _uncoupled("uncoupled solid mixture", 4.0 * v["kappa"], solids)

    return write


def _parallel(v: Values) -> list[str]:
    lines = [*_entries(ksi=v["a_f"], alpha=v["b_f"], beta=2.0), _FIBRE]
    return _solid("fiber-exp-pow-uncoupled", lines)


def _dispersed(v: Values) -> list[str]:
    family = _entries(c=0.0, k1=v["a_f"] / 2.0, k2=v["b_f"], kappa=v["dispersion"], gamma=0.0)
    return _solid("Holzapfel-Gasser-Ogden", family)


def _two_families(v: Values) -> str:
    shape = {"c": v["c"], "k1": v["k_1"], "k2": v["k_2"], "kappa": v.get("dispersion", 0.0)}
    lines = _entries(**shape, gamma=v["angle"])
    return _uncoupled("Holzapfel-Gasser-Ogden", v["kappa"], lines)


def _fung(normal: np.ndarray, shear: Iterable[float], C: float, kappa: float) -> str:
    """Return the Fung material of ``normal`` (3, 3) and ``shear`` (12, 23, 31) moduli in kPa."""
    K = jnp.asarray(normal)
    S = np.asarray(cofactor(K) / determinant(K))  # K is symmetric
    E = 1.0 / np.diag(S)
    ratios = {"v12": -S[0, 1] * E[0], "v23": -S[1, 2] * E[1], "v31": -S[2, 0] * E[2]}
    moduli = dict(zip(("E1", "E2", "E3"), E.tolist(), strict=True))
    shears = dict(zip(("G12", "G23", "G31"), shear, strict=True))
    return _card("Fung-ortho-compressible", _entries(**moduli, **shears, **ratios, c=C, k=kappa))


def _guccione(v: Values) -> str:
    C = v["C"]
    normal = np.diag([C * v["b_f"], C * v["b_t"], C * v["b_t"]])
    shear = (C * v["b_fs"] / 2.0, C * v["b_t"] / 2.0, C * v["b_fs"] / 2.0)
    return _fung(normal, shear, C, v["kappa"])


def _fung_orthotropic(v: Values) -> str:
    if v["mu"] != 0.0:
        raise InputError(
            f"FEBio 4 has no Fung material with a matrix: parameter 'mu' is {v['mu']:g} kPa; only "
            "0 can be exported"
        )
    b = [v["C"] * v[f"b_{k}"] for k in range(1, 10)]
    normal = np.array([[b[0], b[3], b[5]], [b[3], b[1], b[4]], [b[5], b[4], b[2]]])
    if np.linalg.eigvalsh(normal)[0] <= 0.0:
        raise InputError("FEBio 4 needs a Fung exponent that is convex in the normal strains")
    return _fung(normal, b[6:], v["C"], v["kappa"])


def _elements(body: ExportedBody) -> list[str]:
    kind = "tet4" if body.mesh.order == 1 else "tet10"
    lines = [f'    <Elements type="{kind}" name="body">']
    for k, nodes in enumerate(body.mesh.elements + 1, start=1):
        lines.append(f'      <elem id="{k}">{",".join(map(str, nodes))}</elem>')
    return [*lines, "    </Elements>"]


def _sets(body: ExportedBody) -> list[str]:
    lines = [
        f'    <NodeSet name="{name}">{",".join(map(str, nodes + 1))}</NodeSet>'
        for name, nodes in body.mesh.node_sets.items()
    ]
    kind = "tri3" if body.mesh.order == 1 else "tri6"
    for name, facets in body.mesh.facet_sets.items():
        lines.append(f'    <Surface name="{name}">')
        for k, nodes in enumerate(facets + 1, start=1):
            lines.append(f'      <{kind} id="{k}">{",".join(map(str, nodes))}</{kind}>')
        lines.append("    </Surface>")
    return lines


def write_body(folder: Path, body: ExportedBody) -> list[str]:
    """Write ``body.feb``: mesh, sets and material axes, with the material of ``mean.feb``."""
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        '<febio_spec version="4.0">',
        '  <Module type="solid"/>',
        '  <Material from="mean.feb"/>',
        "  <Mesh>",
        '    <Nodes name="nodes">',
    ]
    for k, point in enumerate(body.mesh.nodes, start=1):
        lines.append(f'      <node id="{k}">{row(point).replace(" ", "")}</node>')
    lines += ["    </Nodes>", *_elements(body), *_sets(body), "  </Mesh>"]
    lines += ["  <MeshDomains>", '    <SolidDomain name="body" mat="tissue"/>', "  </MeshDomains>"]
    if (axes := body.axes) is not None:
        lines += ["  <MeshData>", '    <ElementData type="mat_axis" elem_set="body">']
        for k, (a, d) in enumerate(axes, start=1):
            vectors = (row(vector).replace(" ", "") for vector in (a, d))
            lines.append('      <elem lid="{}"><a>{}</a><d>{}</d></elem>'.format(k, *vectors))
        lines += ["    </ElementData>", "  </MeshData>"]
    (folder / "body.feb").write_text("\n".join([*lines, "</febio_spec>"]) + "\n", encoding="utf-8")
    return ["body.feb"]


_LN = "k/2 (ln J)^2"
_MIXED = ("The law is a mixture of FEBio's materials, whose sum is the law's energy.",)
FEBIO = Program(
    name="febio",
    title="FEBio 4",
    suffix=".feb",
    units="mm, kPa, mN",
    forms={
        "neo_hookean": Form(_lame),
        "neo_hookean_E_nu": Form(lambda v: _card("neo-Hookean", _entries(E=v["E"], v=v["nu"]))),
        "neo_hookean_split": Form(
            lambda v: _uncoupled("Mooney-Rivlin", v["kappa"], _entries(c1=v["mu"] / 2.0, c2=0.0))
        ),
        "mooney_rivlin": _same("Mooney-Rivlin", c1="c_10", c2="c_01"),
        "yeoh": _same("Yeoh", c1="c_1", c2="c_2", c3="c_3"),
        "ogden_1": Form(_ogden),
        "ogden_2": Form(_ogden),
        "ogden_3": Form(_ogden),
        "holzapfel_ogden_isotropic": Form(_mixture(lambda _: []), differs=_MIXED),
        "holzapfel_ogden": Form(_mixture(_parallel), differs=_MIXED),
        "holzapfel_ogden_dispersed": Form(_mixture(_dispersed), differs=_MIXED),
        "holzapfel_gasser_ogden": Form(_two_families),
        "gasser_ogden_holzapfel": Form(_two_families),
        "guccione": Form(_guccione, penalty=_LN),
        "fung_orthotropic": Form(_fung_orthotropic, penalty=_LN),
    },
    refusals={
        **dict.fromkeys(
            (
                "holzapfel_ogden_unswitched",
                "holzapfel_ogden_released",
                "holzapfel_ogden_dispersed_unswitched",
            ),
            "its fibres resist extension only",
        ),
        **dict.fromkeys(
            ("holzapfel_ogden_orthotropic", "invariant_terms"),
            "it has no material with the shear between fibres and sheets",
        ),
        "fung_planar": "its Fung material has no plane without resistance across",
        **dict.fromkeys(("small_strain", "small_strain_E_nu"), "its analyses are of finite strain"),
    },
    write_body=write_body,
    usage='`<Material from="mean.feb"/>` reads a card; `body.feb` does, and needs a `Control`, '
    "boundary conditions and loads. Axis 1 of `mat_axis` is the fibre, axis 2 the sheet.",
)
