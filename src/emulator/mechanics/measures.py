r"""The strain measures a law reads, and the law's energy as a function of these alone.

A law is a function of measures of the displacement gradient,

.. math::
    W(H) = \varphi(\xi(H)), \qquad \xi = (J - 1,\ \bar I_1 - 3,\ \bar I_{4f} - 1, \dots)

which are found by calling it with a strain that records every measure read. The exponentials and
the bulk modulus are in :math:`\varphi`, which is convex or nearly so; :math:`\xi` is a polynomial
or close to one. The solver uses the separation (:mod:`emulator.fem.stress_iterates`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.kept import kept
from emulator.mechanics.kinematics import Strain, cofactor
from emulator.mechanics.laws.law import Law

_SHAPES: dict[str, tuple[int, ...]] = {
    "J_minus_1": (),
    "I1_minus_3": (),
    "isochoric_I1_minus_3": (),
    "isochoric_I2_minus_3": (),
    "isochoric_I4f_minus_1": (),
    "isochoric_I4s_minus_1": (),
    "isochoric_I8fs": (),
    "green_lagrange": (3, 3),
}
_DIFFERENTIATED_BY_JAX = {"isochoric_I2_minus_3", "green_lagrange"}


def _metric(name: str, strain: Strain) -> jax.Array:
    """Return the matrix (3, 3) that makes an isochoric measure."""
    if name == "isochoric_I1_minus_3":
        return jnp.eye(3)
    one = strain.sheet if name == "isochoric_I4s_minus_1" else strain.fibre
    other = strain.sheet if name != "isochoric_I4f_minus_1" else strain.fibre
    product = jnp.outer(one, other)
    return 0.5 * (product + product.T)


class _GradientRead(Exception):
    """The error raised where the law reads the displacement gradient itself."""


def _measure(name: str) -> property:
    return property(lambda strain: strain.values[name])


class GivenStrain(Strain):
    """A strain whose measures are given as independent values.

    values : measure by name; :attr:`ln_J` follows from ``J_minus_1``.
    directions : as in :class:`~emulator.mechanics.kinematics.Strain`.
    """

    values: Mapping[str, jax.Array]

    def __init__(
        self, values: Mapping[str, jax.Array], directions: jax.Array | np.ndarray | None
    ) -> None:
        vars(self).update(values=values, directions=directions, barriers=None)

    @property
    def H(self) -> jax.Array:
        """Raise, because the displacement gradient is unknown here."""
        raise _GradientRead

    J_minus_1 = _measure("J_minus_1")
    I1_minus_3 = _measure("I1_minus_3")
    isochoric_I1_minus_3 = _measure("isochoric_I1_minus_3")
    isochoric_I2_minus_3 = _measure("isochoric_I2_minus_3")
    isochoric_I4f_minus_1 = _measure("isochoric_I4f_minus_1")
    isochoric_I4s_minus_1 = _measure("isochoric_I4s_minus_1")
    isochoric_I8fs = _measure("isochoric_I8fs")
    green_lagrange = _measure("green_lagrange")


class _Notes(dict[str, jax.Array]):
    """Measures of a strain at rest, all zero: those that were read, in order."""

    def __missing__(self, name: str) -> jax.Array:
        return self.setdefault(name, jnp.zeros(_SHAPES[name]))


@kept
def measures_read(law: Law) -> tuple[str, ...] | None:
    """Return the names of the measures that ``law`` reads; ``None`` if it reads anything else.

    Found by tracing the law once.
    """
    notes = _Notes()
    directions = np.eye(3)[:2] if law.sheets else np.eye(3)[0] if law.fibres else None

    def energy(*parameters: jax.Array) -> jax.Array:
        return law.energy(GivenStrain(notes, directions), *parameters)

    try:
        jax.eval_shape(energy, *(jnp.ones(()) for _ in law.parameters))
    except _GradientRead:
        return None
    return tuple(notes)


class Measures:
    """A law's measures as one flat vector; ``names`` are those of :func:`measures_read`."""

    def __init__(self, names: tuple[str, ...]) -> None:
        self.names = names
        self._sizes = [int(np.prod(_SHAPES[name])) for name in names]
        self.size = sum(self._sizes)

    @property
    def blocks(self) -> np.ndarray:
        """Entries that belong to each measure, (measures, size) of 0 and 1."""
        return np.repeat(np.eye(len(self.names)), self._sizes, axis=1)

    def of(self, H: jax.Array, directions: jax.Array | None) -> jax.Array:
        """Return the measures (size,) of a displacement gradient (3, 3)."""
        strain = Strain(H, None, directions)
        return jnp.concatenate([jnp.ravel(getattr(strain, name)) for name in self.names])

    def derivatives(
        self, H: jax.Array, directions: jax.Array | None, s: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        r"""Slopes (size, 3, 3) of the measures, and their curvature (3, 3, 3, 3) weighted by ``s``.

        With :math:`G = F^{-T}` and :math:`a = J^{-2/3}`, a measure :math:`\xi = a\, F : F M` less a
        number, M symmetric (:math:`I` for :math:`\bar I_1`, :math:`f \otimes f` for
        :math:`\bar I_{4f}`, the symmetric part of :math:`f \otimes s` for :math:`\bar I_{8fs}`),
        has

        .. math::
            \xi_{,ij} &= a\left(2 (FM)_{ij} - \tfrac23 Q G_{ij}\right), \qquad Q = F : F M \\
            \xi_{,ijkl} &= a\left(2 \delta_{ik} M_{jl}
                - \tfrac43 \left[(FM)_{ij} G_{kl} + G_{ij} (FM)_{kl}\right]
                + \tfrac49 Q G_{ij} G_{kl} + \tfrac23 Q G_{il} G_{kj}\right)

        which is linear in M, so that one M weighted by s serves all; and
        :math:`J_{,ij} = J G_{ij}`, :math:`J_{,ijkl} = J (G_{ij} G_{kl} - G_{il} G_{kj})`. Other
        measures are differentiated by JAX.
        """
        if _DIFFERENTIATED_BY_JAX & set(self.names):
            measures = lambda H: self.of(H, directions)  # noqa: E731
            pulled_back = lambda H: jax.vjp(measures, H)[1](s)[0]  # noqa: E731
            return jax.jacfwd(measures)(H), jax.jacfwd(pulled_back)(H)
        F, eye = H + jnp.eye(3, dtype=H.dtype), jnp.eye(3, dtype=H.dtype)
        strain = Strain(H, None, directions)
        J = 1.0 + strain.J_minus_1
        G, power = cofactor(F) / J, jnp.exp(-2.0 / 3.0 * strain.ln_J)
        zero = jnp.zeros((), H.dtype)
        slopes, whole, plain, pressure = list[jax.Array](), zero * eye, zero, zero
        for name, weight in zip(self.names, s, strict=True):
            if name == "J_minus_1":
                slopes.append(J * G)
                pressure = weight
            elif name == "I1_minus_3":
                slopes.append(2.0 * F)
                plain = weight
            else:
                M = _metric(name, strain)
                FM = F @ M
                slopes.append(power * (2.0 * FM - 2.0 / 3.0 * jnp.vdot(F, FM) * G))
                whole = whole + weight * M
        FM = F @ whole
        Q, GG = jnp.vdot(F, FM), jnp.einsum("ij,kl->ijkl", G, G)
        crossed = jnp.einsum("il,kj->ijkl", G, G)
        mixed = jnp.einsum("ij,kl->ijkl", FM, G)
        metric = jnp.einsum("ik,jl->ijkl", eye, power * whole + plain * eye)
        curvature = 2.0 * metric - 4.0 / 3.0 * power * (mixed + mixed.transpose(2, 3, 0, 1))
        curvature += (4.0 / 9.0 * power * Q + pressure * J) * GG
        curvature += (2.0 / 3.0 * power * Q - pressure * J) * crossed
        return jnp.stack(slopes), curvature

    def energy(
        self, constitutive: Callable[[Strain], jax.Array], directions: jax.Array | None
    ) -> Callable[[jax.Array], jax.Array]:
        """Return the energy density (kPa) as a function of the measures (size,)."""
        ends = np.cumsum(self._sizes)[:-1]

        def phi(xi: jax.Array) -> jax.Array:
            parts = zip(self.names, jnp.split(xi, ends), strict=True)
            values = {name: part.reshape(_SHAPES[name]) for name, part in parts}
            return constitutive(GivenStrain(values, directions))

        return phi
