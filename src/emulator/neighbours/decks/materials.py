r"""Parameters of other programs' materials as parameters of the laws of this package.

With :math:`\bar I_i` and :math:`\bar\lambda_i` without volume change, :math:`J = \det F`, and the
volumetric energies

.. math::
    U_0 = \tfrac{\kappa}{2} (\ln J)^2, \quad U_1 = \tfrac{\kappa}{4} (J^2 - 1 - 2 \ln J), \quad
    U_2 = \tfrac{\kappa}{2} (J - 1)^2, \quad U_3 = \kappa (J - 1 - \ln J)

=======================================  =======================================================
there                                    here
=======================================  =======================================================
FEBio neo-Hookean, E, v                  ``neo_hookean_E_nu``, the same energy
FEBio incomp neo-Hookean, G, k           ``neo_hookean_split``: mu = G, kappa = k
FEBio Mooney-Rivlin, c1, c2, k           ``mooney_rivlin``: c_10 = c1, c_01 = c2, kappa = k
FEBio Ogden, c_i, m_i, k                 ``ogden_N``: mu_i = c_i / 2, alpha_i = m_i, kappa = k,
                                         from :math:`\sum c_i / m_i^2 (\sum \bar\lambda^{m_i} - 3)`
FEBio Holzapfel-Gasser-Ogden             the same: c, k_1 = k1, k_2 = k2, angle = gamma (degrees),
                                         dispersion = kappa, kappa = k
FEBio Fung-ortho-compressible, E, G, v   ``fung_orthotropic`` without a matrix, kappa = k; of K, the
                                         inverse of the compliance of E and v: b_1, b_2, b_3 =
                                         K_11, K_22, K_33 over c, b_4, b_5, b_6 = K_12, K_23, K_31
                                         over c; b_7, b_8, b_9 = G12, G23, G31 over c
FEBio Fung orthotropic                   the same, of the isochoric strain there
Abaqus neo Hooke, C10, D1                ``neo_hookean_split``: mu = 2 C10, kappa = 2 / D1
Abaqus Mooney-Rivlin, C10, C01, D1       ``mooney_rivlin``, kappa = 2 / D1
Abaqus Yeoh, C10, C20, C30, D1           ``yeoh``, kappa = 2 / D1
Abaqus Ogden, mu_i, alpha_i, D_i         ``ogden_N``, the same energy, kappa = 2 / D1
Abaqus Holzapfel, C10, D, k1, k2, kappa  c = 2 C10, k_1, k_2, dispersion, kappa = 2 / D; the angle
                                         is half of that between the two local directions
Abaqus Fung-orthotropic, b_ijkl, c, D    ``fung_orthotropic`` without a matrix: b_1 to b_9 = b_1111,
                                         b_2222, b_3333, b_1122, b_2233, b_1133, b_1212, b_2323,
                                         b_1313, of the isochoric strain there; kappa = 2 / D
Abaqus elastic, E, nu, no NLGEOM         ``small_strain_E_nu``
svMultiPhysics neoHookean, E, nu         ``neo_hookean_split``: mu = E / 2(1 + nu), kappa is the
                                         penalty parameter, or else E / 3(1 - 2 nu)
svMultiPhysics HolzapfelOgden            ``holzapfel_ogden_orthotropic``: kappa = penalty / 4
=======================================  =======================================================

Laws here have :math:`U_1` (neo_hookean_E_nu has none of them). FEBio's uncoupled materials have
:math:`U_0` unless ``pressure_model`` names another one, its Holzapfel-Gasser-Ogden and
svMultiPhysics' ST91 :math:`U_1`, Abaqus :math:`U_2`, but its Holzapfel and Fung :math:`U_1`, M94
:math:`U_3`. All have the bulk modulus :math:`\kappa`: they agree to second order in J - 1, and a
note says where one stands for another. Fung's exponential is of the whole strain here. A deck's of
the isochoric strain stands for it where the bulk modulus is so large that both strains are one.

Sources: FEBio User Manual 4, "Uncoupled materials", and FEUncoupledMaterial.h; Abaqus Theory Guide,
4.6.1 and 4.6.3; Abaqus Analysis User's Guide, "Hyperelastic behavior of rubberlike materials";
svMultiPhysics user guide, "Material models", and mat_models.cpp.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

SAME = "kappa/4 (J^2 - 1 - 2 ln J)"
LOGARITHMIC, QUADRATIC = "kappa/2 (ln J)^2", "kappa/2 (J - 1)^2"
OTHER = "kappa (J - 1 - ln J)"

Parameters = tuple[str, dict[str, float]]
"""The name of a law, and its parameters."""


NEARLY_INCOMPRESSIBLE = 100.0
"""Bulk modulus over the stiffness at rest above which the isochoric strain is the strain."""


class Material(NamedTuple):
    """A law, its parameters by name, and the line of the deck that has it.

    density : mass density in the deck's unit, or None.
    bulk : the energy of volume change there, in words; empty where it is that of the law here.
    isochoric : whether the exponential is of the isochoric strain there, of the whole one here.
    """

    law: str
    values: dict[str, float]
    line: int
    density: float | None = None
    bulk: str = ""
    isochoric: bool = False

    def fault(self) -> str | None:
        """Return why the law cannot stand for the deck's, else None."""
        stiffness = [self.values.get(f"b_{k}", 0.0) for k in range(1, 10)]
        least = NEARLY_INCOMPRESSIBLE * self.values.get("C", 0.0) * max(stiffness)
        if not self.isochoric or self.values["kappa"] >= least:
            return None
        return (
            f"Fung's exponential is of the isochoric strain in the deck and of the whole strain "
            f"here; they are one only for a bulk modulus of {least:g} or more"
        )

    def notes(self) -> list[str]:
        """Return a sentence for each difference of the energies."""
        sentences = []
        if self.bulk:
            sentences.append(
                f"volume changes cost {self.bulk} in the deck and {SAME} here: the same bulk "
                "modulus, other energies of large volume changes"
            )
        if self.isochoric:
            sentences.append(
                "Fung's exponential is of the isochoric strain in the deck and of the whole strain "
                "here: they differ by the volume change, which this bulk modulus keeps small"
            )
        return sentences


def ogden(mu: Sequence[float], alpha: Sequence[float], kappa: float) -> Parameters:
    """Return law and parameters of Ogden's sum; terms of zero modulus are left out.

    A sum of more terms than three is no law here; its name is then unknown.
    """
    terms = [(m, a) for m, a in zip(mu, alpha, strict=True) if m != 0.0]
    values: dict[str, float] = {}
    for k, (m, a) in enumerate(terms, start=1):
        values |= {f"mu_{k}": m, f"alpha_{k}": a}
    return f"ogden_{len(terms)}", {**values, "kappa": kappa}


def fibre_families(
    c: float, k_1: float, k_2: float, angle: float, dispersion: float, kappa: float
) -> Parameters:
    """Return law and parameters of two families of fibres at ``angle`` (degrees) to both sides."""
    values = {"c": c, "k_1": k_1, "k_2": k_2, "angle": angle}
    if dispersion == 0.0:
        return "holzapfel_gasser_ogden", {**values, "kappa": kappa}
    return "gasser_ogden_holzapfel", {**values, "dispersion": dispersion, "kappa": kappa}


def split_neo_hookean(E: float, nu: float, penalty: float | None) -> Parameters:
    """Return law and parameters from Young's modulus, Poisson's ratio, and a bulk modulus."""
    mu = E / (2.0 * (1.0 + nu))
    kappa = E / (3.0 * (1.0 - 2.0 * nu)) if penalty is None else penalty
    return "neo_hookean_split", {"mu": mu, "kappa": kappa}


def fung(c: float, normal: np.ndarray, shear: Sequence[float], kappa: float) -> Parameters:
    """Return law and parameters of Fung's exponential.

    Parameters
    ----------
    normal : the stiffness (3, 3) of normal strains.
    shear : those of shear between the axes 12, 23 and 31, in the unit of ``c``.
    """
    pairs = ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (2, 0))
    b = [*(float(normal[pair]) / c for pair in pairs), *(G / c for G in shear)]
    exponents = {f"b_{k}": value for k, value in enumerate(b, start=1)}
    return "fung_orthotropic", {"C": c, **exponents, "mu": 0.0, "kappa": kappa}
