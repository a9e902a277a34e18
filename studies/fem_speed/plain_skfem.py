"""The pressurised body of this study in plain scikit-fem and SciPy, as their users write it.

One form for the residual and one for the tangent, stress and elasticity tensor evaluated at all
quadrature points at once and handed to the forms as fields (as in scikit-fem's example 36), the
pressure as a follower load on the facets, SuperLU for the linear systems, Newton with load steps.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import splu
from skfem import Basis, BilinearForm, ElementTetP1, ElementVector, FacetBasis, LinearForm, MeshTet
from skfem.assembly import asm
from skfem.helpers import ddot, dot, grad

IDENTITY = np.eye(3)[:, :, None, None]


class Result(NamedTuple):
    """Displacement (n, 3), Newton iterations over all load steps, and whether it converged."""

    displacement: np.ndarray
    iterations: int
    converged: bool


class Fields(NamedTuple):
    """Integrands of the forms; elements or facets, and their quadrature points, last."""

    stress: np.ndarray  # (3, 3, m, 1)
    elasticity: np.ndarray  # (3, 3, 3, 3, m, 1)
    area: np.ndarray  # (3, k, 1): cof(F) N
    turning: np.ndarray  # (3, 3, 3, k, 1): its derivative in F


@dataclass(frozen=True)
class Material:
    """Holzapfel-Ogden, released variant; arrays run over elements and quadrature points last."""

    a: float
    b: float
    a_f: float
    b_f: float
    kappa: float
    fibres: np.ndarray  # (3, m, 1)

    def stress_and_elasticity(self, H: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """First Piola-Kirchhoff stress (3, 3, ...) and its derivative in F (3, 3, 3, 3, ...)."""
        F = IDENTITY + H
        J, G = _inverse_transpose(F)
        Ff = np.einsum("ij...,j...->i...", F, self.fibres)
        # Each isochoric invariant is I = J^(-2/3) q(F) with q quadratic in F.
        q1, dq1 = np.einsum("ij...,ij...->...", F, F), 2.0 * F
        q4, dq4 = np.einsum("i...,i...->...", Ff, Ff), 2.0 * _outer1(Ff, self.fibres)
        power = J ** (-2.0 / 3.0)
        I1, I4 = power * q1 - 3.0, power * q4 - 1.0
        dI1, dI4 = power * (dq1 - 2.0 / 3.0 * q1 * G), power * (dq4 - 2.0 / 3.0 * q4 * G)
        e1, e4 = np.exp(self.b * I1), np.exp(self.b_f * I4**2)
        w1, w11 = self.a * e1, self.a * self.b * e1
        w4 = 2.0 * self.a_f * I4 * e4
        w44 = 2.0 * self.a_f * e4 * (1.0 + 2.0 * self.b_f * I4**2)
        u1 = 2.0 * self.kappa * (J**2 - 1.0)  # J dU/dJ
        P = w1 * dI1 + w4 * dI4 + u1 * G
        GG, swapped = _outer(G, G), np.einsum("il...,kj...->ijkl...", G, G)
        A = w11 * _outer(dI1, dI1) + w44 * _outer(dI4, dI4)
        A += w1 * self._second(power, q1, dq1, G, GG, swapped)
        A += w4 * self._second(power, q4, dq4, G, GG, swapped)
        A += 4.0 * self.kappa * J**2 * GG - u1 * swapped
        isotropic = 2.0 * w1 * power
        fibre = 2.0 * w4 * power * _outer1(self.fibres, self.fibres)
        for i in range(3):
            A[i, :, i, :] += fibre
            for j in range(3):
                A[i, j, i, j] += isotropic
        return P, A

    @staticmethod
    def _second(
        power: np.ndarray,
        q: np.ndarray,
        dq: np.ndarray,
        G: np.ndarray,
        GG: np.ndarray,
        swapped: np.ndarray,
    ) -> np.ndarray:
        """Second derivative of ``J^(-2/3) q`` in F, without the term with ``q``."""
        mixed = _outer(dq, G)
        mixed = mixed + mixed.transpose(2, 3, 0, 1, *range(4, mixed.ndim))
        return power * (-2.0 / 3.0 * mixed + q * (4.0 / 9.0 * GG + 2.0 / 3.0 * swapped))


def _outer(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    return A[:, :, None, None] * B[None, None]


def _outer1(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, None] * b[None]


def _cofactor(F: np.ndarray) -> np.ndarray:
    rows = [np.cross(F[i], F[j], axis=0) for i, j in ((1, 2), (2, 0), (0, 1))]
    return np.stack(rows)


def _inverse_transpose(F: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """``det F`` and ``F^-T``."""
    cofactor = _cofactor(F)
    J = np.einsum("j...,j...->...", F[0], cofactor[0])
    return J, cofactor / J


@LinearForm
def internal(v, w):
    return ddot(w["stress"], grad(v))


@BilinearForm
def stiffness(u, v, w):
    return ddot(np.einsum("ijkl...,kl...->ij...", w["elasticity"], grad(u)), grad(v))


@LinearForm
def pressed(v, w):
    return dot(w["area"], v)


@BilinearForm
def pressed_tangent(u, v, w):
    return dot(np.einsum("ikl...,kl...->i...", w["turning"], grad(u)), v)


def _turning(F: np.ndarray, N: np.ndarray) -> np.ndarray:
    """Derivative (i, k, l) of ``cof(F) N`` in F: linear in F, so built from unit directions."""
    turning = np.zeros((3, 3, 3, *F.shape[2:]))
    # cof(F)_ij = 1/2 eps_imn eps_jpq F_mp F_nq
    eps = np.zeros((3, 3, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        eps[i, j, k], eps[i, k, j] = 1.0, -1.0
    np.einsum("ikn,jlq,nq...,j...->ikl...", eps, eps, F, N, out=turning, optimize=True)
    return turning


@dataclass(frozen=True)
class Body:
    """Mesh, supports and load; ``solve`` takes theta.

    nodes (n, 3), elements (m, 4), fibres (m, 3), facets (k, 3), held (h,) node numbers.
    """

    nodes: np.ndarray
    elements: np.ndarray
    fibres: np.ndarray
    facets: np.ndarray
    held: np.ndarray
    pressure: float
    kappa: float

    @cached_property
    def basis(self) -> Basis:
        mesh = MeshTet(self.nodes.T.copy(), self.elements.T.copy(), sort_t=False)
        return Basis(mesh, ElementVector(ElementTetP1()), intorder=1)

    @cached_property
    def facet_basis(self) -> FacetBasis:
        mesh = self.basis.mesh
        wanted = {tuple(row) for row in np.sort(self.facets, axis=1).tolist()}
        found = [
            k for k, f in enumerate(np.sort(mesh.facets.T, axis=1).tolist()) if tuple(f) in wanted
        ]
        return FacetBasis(mesh, self.basis.elem, facets=np.array(found), intorder=1)

    @cached_property
    def free(self) -> np.ndarray:
        held = self.basis.nodal_dofs[:, self.held].ravel()
        return np.setdiff1d(np.arange(self.basis.N), held)

    def fields(self, u: np.ndarray, material: Material) -> Fields:
        """The integrands of the forms at every quadrature point."""
        stress, elasticity = material.stress_and_elasticity(self.basis.interpolate(u).grad)
        F = IDENTITY + self.facet_basis.interpolate(u).grad
        normals = self.facet_basis.normals
        area = np.einsum("ij...,j...->i...", _cofactor(F), normals)
        return Fields(stress, elasticity, area, _turning(F, normals))

    def forces(self, fields: Fields, pressure: float) -> tuple[np.ndarray, np.ndarray]:
        """Internal force and pressure force over all degrees of freedom."""
        inner = asm(internal, self.basis, stress=fields.stress)
        return inner, -pressure * asm(pressed, self.facet_basis, area=fields.area)

    def tangent(self, fields: Fields, pressure: float) -> csc_matrix:
        """Derivative of the residual over the free degrees of freedom."""
        K = asm(stiffness, self.basis, elasticity=fields.elasticity)
        K = K + pressure * asm(pressed_tangent, self.facet_basis, turning=fields.turning)
        return K[self.free][:, self.free].tocsc()

    def solve(self, theta: np.ndarray, steps: int = 3) -> Result:
        """Newton from rest in equal load steps; twice as many when one of them fails."""
        a, b, a_f, b_f = map(float, theta)
        material = Material(a, b, a_f, b_f, self.kappa, self.fibres.T[:, :, None])
        spent = 0
        while steps <= 48:
            u, iterations, converged = self._walk(material, steps)
            spent += iterations
            if converged:
                return Result(u[self.basis.nodal_dofs].T, spent, True)
            steps *= 2
        return Result(u[self.basis.nodal_dofs].T, spent, False)

    def _walk(self, material: Material, steps: int) -> tuple[np.ndarray, int, bool]:
        u, total = np.zeros(self.basis.N), 0
        for step in range(1, steps + 1):
            # Only the last load step needs the tight tolerance.
            tolerance = 1e-10 if step == steps else 1e-2
            u, iterations, converged = self._newton(
                u, material, self.pressure * step / steps, tolerance
            )
            total += iterations
            if not converged:
                return u, total, False
        return u, total, True

    def _newton(
        self, u: np.ndarray, material: Material, pressure: float, tolerance: float
    ) -> tuple[np.ndarray, int, bool]:
        for iteration in range(26):
            with np.errstate(all="ignore"):  # too long a step gives NaN, seen below
                fields = self.fields(u, material)
                inner, outer = self.forces(fields, pressure)
                residual = (inner - outer)[self.free]
                size = np.linalg.norm(inner) + np.linalg.norm(outer)
            if not np.isfinite(size):
                return u, iteration, False
            if np.linalg.norm(residual) <= tolerance * size:
                return u, iteration, True
            # Minimum degree on A + A' is SuperLU's best ordering for a symmetric pattern.
            factor = splu(
                self.tangent(fields, pressure),
                permc_spec="MMD_AT_PLUS_A",
                diag_pivot_thresh=0.01,
                options={"SymmetricMode": True},
            )
            u = u.copy()
            u[self.free] -= factor.solve(residual)
        return u, 26, False
