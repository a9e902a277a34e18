r"""Relaxation times and fractions of the stress that relaxes with them, from a few parameters.

The stress after a step of strain at time 0 is, as a fraction of its first value,

.. math:: G(t) = g_\infty + \sum_a g_a e^{-t / \tau_a}, \qquad G(0) = 1 .

``prony`` has one to six terms. ``relaxation_k`` :math:`= r_k` in (0, 1) is the fraction that term k
relaxes of the stress that the terms before leave,

.. math:: g_k = r_k \prod_{j < k} (1 - r_j), \qquad g_\infty = \prod_k (1 - r_k) > 0,

so that any values are admissible. Terms of equal times are one term; ranges or priors of ``tau_k``
that do not overlap, short times first, tell them apart.

``spectrum`` is Fung's continuous one (Fung 1993, *Biomechanics*, Section 7.6): equal fractions for
equal ratios of times between ``tau_1`` and ``tau_2``, with the strength c, ``spectrum``,

.. math::
    G(t) = \frac{1 + c\,[E_1(t / \tau_2) - E_1(t / \tau_1)]}{1 + c L}, \qquad
    L = \ln (\tau_2 / \tau_1), \qquad E_1(x) = \int_x^\infty \frac{e^{-s}}{s}\, ds .

Gauss-Legendre points in :math:`\ln \tau` make it a series of 16 terms, or of ``terms``. The largest
error of G is 3e-5 of :math:`c L / (1 + c L)` where the times are five decades apart, 2e-7 for three
decades (``tests/emulator/viscosity/test_series.py``).

``kelvin_voigt`` has no term: a stress :math:`\eta \dot E` beside the law's, with ``eta`` in kPa s
and the Green-Lagrange strain E, as in models of the beating heart (Arostica et al. 2025). For
bodies only.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError, check_known
from emulator.mechanics.laws.law import Quantity, number

KELVIN_VOIGT = "kelvin_voigt"
KINDS = ("prony", "spectrum", KELVIN_VOIGT)
_MOST = {"prony": 6, "spectrum": 64, KELVIN_VOIGT: 0}
_USUAL = {"prony": 1, "spectrum": 16, KELVIN_VOIGT: 0}


class Series(NamedTuple):
    """The terms of a relaxation.

    fractions : the fraction of the instantaneous stress that relaxes with each term, (a,).
    times : the relaxation time of each term, s, (a,).
    """

    fractions: jax.Array
    times: jax.Array


@dataclass(frozen=True)
class Viscosity:
    """How the isochoric stress of a law relaxes.

    Parameters
    ----------
    kind : ``prony`` for a few terms, ``spectrum`` for Fung's continuous spectrum,
        ``kelvin_voigt`` for a stress of the strain's rate.
    terms : the number of terms; by default 1, and 16 points of a spectrum.
    """

    kind: str = "prony"
    terms: int | None = None

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise InputError(f"viscosity: kind '{self.kind}'; use {' or '.join(KINDS)}")
        most = _MOST[self.kind]
        if self.terms is not None and self.kind == KELVIN_VOIGT:
            raise InputError(f"viscosity: {KELVIN_VOIGT} has no terms; leave them out")
        if self.terms is not None and not 1 <= self.terms <= most:
            raise InputError(
                f"viscosity: {self.terms} terms of kind '{self.kind}'; give 1 to {most}"
            )

    @property
    def count(self) -> int:
        """The number of terms."""
        return _USUAL[self.kind] if self.terms is None else self.terms

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """The parameters, in the order of the terms."""
        if self.kind == KELVIN_VOIGT:
            return (Quantity("eta", "kPa s", low_admitted=True),)
        if self.kind == "spectrum":
            return number("spectrum"), Quantity("tau_1", "s"), Quantity("tau_2", "s")
        pairs = (
            (number(f"relaxation_{k}", 0.0, 1.0), Quantity(f"tau_{k}", "s"))
            for k in range(1, self.count + 1)
        )
        return tuple(quantity for pair in pairs for quantity in pair)

    def series(self, values: Mapping[str, jax.Array]) -> Series:
        """Return fractions and times of the terms from the parameters' values by name."""
        if not self.count:
            return Series(jnp.zeros(0), jnp.zeros(0))
        if self.kind == "spectrum":
            logs = jnp.log(values["tau_1"]), jnp.log(values["tau_2"])
            points, weights = np.polynomial.legendre.leggauss(self.count)
            half = 0.5 * (logs[1] - logs[0])
            # The absolute value: the two times may come in either order.
            mass = jnp.abs(half) * values["spectrum"] * weights
            fractions = mass / (1.0 + 2.0 * jnp.abs(half) * values["spectrum"])
            return Series(fractions, jnp.exp(logs[0] + half * (1.0 + points)))
        terms = range(1, self.count + 1)
        relaxed = jnp.stack([jnp.asarray(values[f"relaxation_{k}"], float) for k in terms])
        left = jnp.concatenate([jnp.ones(1), jnp.cumprod(1.0 - relaxed)[:-1]])
        return Series(
            relaxed * left, jnp.stack([jnp.asarray(values[f"tau_{k}"], float) for k in terms])
        )


def viscosity_of(entries: Viscosity | Mapping[str, Any]) -> Viscosity:
    """Return the viscosity of the table of a scene file; one that is made already as it is."""
    return of_table(Viscosity, entries, "viscosity")


def of_table[T](kind: type[T], entries: T | Mapping[str, Any], noun: str) -> T:
    """Return the dataclass ``kind`` of a table's entries; one that is made already as it is."""
    if isinstance(entries, kind):
        return entries
    table = cast(Mapping[str, Any], entries)
    for word in table:
        check_known(word, [field.name for field in fields(cast(Any, kind))], f"{noun}: entry")
    return kind(**table)
