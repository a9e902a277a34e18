r"""Gaussian errors of a model's data besides its noise: a list of terms, integrated out exactly.

.. math:: y = g(x) + \sum_k V_k(x)^T z_k + \varepsilon, \qquad z_k \sim N(0, I), \qquad
          \varepsilon \sim N(0, W^{-1})

with the unknowns x, the predicted data g of all observations (d numbers), the information W of the
noise (d, d), or its diagonal, and the modes of each term in the unit of the data: what one standard
deviation of each :math:`z_{ki}` changes,

.. math:: V_k(x) = \alpha_k\, \left(A_k + B_k \circ g(x)\right).

A :class:`Term` declares A, B and the size :math:`\alpha`: 1, or a number that is inferred under a
half-normal prior (:class:`~calibrate.noise.protocol.Scale`). Modes B are shares of the prediction,
such as a load cell's gain.

Elimination without exchanges, :math:`I + V W V^T = L P L^T` with pivots P and a unit lower
triangular L, gives all that is needed. With the reduced rows :math:`R = L^{-1} V W` the log
likelihood of the residual r = y - g changes by

.. math:: \tfrac12 \sum_i \left[\frac{(R_i r)^2}{P_i} - \log P_i\right]

(Woodbury's identity and the matrix determinant lemma), and of the information about the means

.. math:: W - R^T P^{-1} R

is left. Where B = 0, modes are chosen, once, for which :math:`G = A W A^T` is diagonal: then L = I,
:math:`P = I + \alpha^2 G`, and a likelihood of d numbers costs one product with the modes. Others
are eliminated anew for each x (:mod:`calibrate.model_error.algebra`).

Shares are of the prediction g and not of the data y: the noise of the data would be scaled in the
modes, too, so that smaller predictions would err less, and a scale of n numbers with share s would
be fitted too low by the factor :math:`1 + (n - 1) s^2` (Peelle's puzzle; D'Agostini 1994).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from jax.flatten_util import ravel_pytree

from calibrate.noise.protocol import Scale
from emulator.core.errors import InputError
from emulator.core.small_matrices import eliminate
from emulator.surrogates.protocol import fingerprint_of

Means = Mapping[str, jax.Array]
"""Data without noise by the observation's name."""

_SIZED, _VARYING = "sized_", "varying_"  # prefixes of the arrays of a second term
_DIAGONAL = ("weights", "strength", "modes", "mixing")  # arrays of a term that is diagonal, and
_DENSE = ("modes", "shares", "sized", "information")  # of one that is not
# Recorded in saved errors, because in earlier versions shares were of the data.
_SHARES = "of the prediction"


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Term:
    """Errors of all data with one size.

    modes, shares : A and B, (r, d); no B where nothing is a share of the prediction.
    size : the size of the modes; ``None`` for 1.
    sized : 0 for each mode whose size is 1 whatever ``size`` is, 1 for the others, (r,); ``None``
        for 1.
    weights, strength : A W, (r, d), with W the information that terms before leave, and the
        diagonal of G, (r,), where the modes are chosen such that G is diagonal.
    mixing : orthogonal matrix (r, s) that makes such modes of the s declared ones, less the rows of
        modes that no datum could tell from nothing; ``None`` where the declared ones are forgotten.
    information : W, (d, d), or its diagonal (d,), where they are not.
    names : names of the unknowns z of the declared modes of a systematic error.
    """

    modes: np.ndarray
    shares: np.ndarray | None = None
    size: Scale | None = None
    sized: np.ndarray | None = None
    weights: Any = None
    strength: Any = None
    mixing: Any = None
    information: np.ndarray | None = None
    names: tuple[str, ...] = jax.tree.static(default=())

    @property
    def unknown_size(self) -> str:
        """The words of an error message for a size that is not known; empty for a size of 1."""
        if self.size is None:
            return ""
        return f"the size '{self.size.name}' is inferred (scale {self.size.prior_scale:g})"

    def at(self, size: Any, means: jax.Array) -> jax.Array:
        """Return V (r, d) at the inferred ``size``, if there is one, and the prediction (d,)."""
        alpha = 1.0 if self.size is None else size
        if self.sized is not None:
            alpha = jnp.where(self.sized > 0.0, alpha, 1.0)[:, None]
        modes = jnp.asarray(self.modes)
        return alpha * (modes if self.shares is None else modes + self.shares * means)

    def eliminated(
        self, size: Any, means: jax.Array, columns: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Return the pivots P (r,), and R ``columns`` (r, m) of columns (d, m)."""
        if self.strength is not None:
            alpha = 1.0 if self.size is None else size
            return 1.0 + alpha**2 * self.strength, alpha * (self.weights @ columns)
        V = self.at(size, means)
        VW = times(V, self.information)
        return eliminate(VW @ V.T + jnp.eye(len(V)), VW @ columns)


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class ModelError:
    """All errors of a model's data besides its noise.

    terms : the terms in the order in which they are eliminated.
    """

    terms: tuple[Term, ...] = ()

    @property
    def declarations(self) -> tuple[Term, ...]:
        """All terms, with the declared modes where these are known, to be integrated out anew."""
        return tuple(
            term if term.mixing is None else replace(term, modes=term.mixing.T @ term.modes)
            for term in self.terms
        )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the unknowns z of errors of known size, without shares."""
        return self.terms[0].names if self.terms else ()

    @property
    def size(self) -> Scale | None:
        """The size that is not known, of which there is one at most."""
        return next((term.size for term in self.terms if term.size is not None), None)

    @property
    def priors(self) -> dict[str, dist.Distribution]:
        """Prior of the size that is inferred, by its name in the posterior; empty if none is."""
        return {} if self.size is None else self.size.priors

    def log_ratio(self, size: Any, residual: Means, means: Means) -> jax.Array:
        """Return what the errors add to the log likelihood of ``residual``, data less ``means``.

        size : the inferred size of :attr:`priors`, (); of no effect where there is none.
        """
        total, means_flat = jnp.zeros(()), ravel_pytree(dict(means))[0]
        column = ravel_pytree(dict(residual))[0][:, None]
        for term in self.terms:
            pivots, rows = term.eliminated(size, means_flat, column)
            total += 0.5 * jnp.sum(rows[:, 0] ** 2 / pivots - jnp.log(pivots))
        return total

    def information_left(self, information: jax.Array, size: Any, means: Means) -> jax.Array:
        """Return what is left of the noise's ``information`` about ``means``, (d, d).

        It is the inverse covariance of the data given the unknowns. How the covariance itself
        depends on the unknowns is not counted. A diagonal (d,) stays one where there are no errors.
        """
        if not self.terms:
            return information
        flat = ravel_pytree(dict(means))[0]
        left = jnp.diag(information) if information.ndim == 1 else information
        for term in self.terms:
            pivots, rows = term.eliminated(size, flat, jnp.eye(len(information)))
            left = left - (rows.T / pivots) @ rows
        return left

    def draw(self, rng_key: jax.Array, size: Any, means: Means) -> dict[str, jax.Array]:
        """Return data without noise that might have come: ``means`` plus a draw of the errors."""
        flat, unravel = ravel_pytree(dict(means))
        keys = jax.random.split(rng_key, len(self.terms)) if self.terms[1:] else [rng_key]
        perturbed = flat
        for key, term in zip(keys, self.terms, strict=False):
            V = term.at(size, flat)
            perturbed += jax.random.normal(key, (len(V),)) @ V
        return unravel(perturbed)

    def largest(self, means: Means) -> np.ndarray:
        """Return V (r, d) beside data like ``means``, the size as large as is plausible."""
        flat = ravel_pytree(dict(means))[0]
        upper = 1.0 if self.size is None else self.size.upper
        rows = [term.at(upper, flat) for term in self.terms]
        return np.concatenate([np.zeros((0, len(flat))), *rows])

    def unknowns(self, residual: Means) -> tuple[np.ndarray, np.ndarray]:
        """Return mean (s,) and covariance (s, s) of the named z given ``residual``, at one draw.

        Raises
        ------
        InputError
            Some of the errors vary with the prediction or in size.
        """
        first, *others = self.terms
        if others or first.size is not None:
            reason = self.terms[-1].unknown_size or "some are shares of what is predicted"
            raise InputError(f"what is known of errors: {reason}")
        flat = np.asarray(ravel_pytree(dict(residual))[0])
        pivots = 1.0 + first.strength
        mean = first.mixing.T @ ((first.weights @ flat) / pivots)
        learned = (first.mixing.T * (1.0 - 1.0 / pivots)) @ first.mixing
        return mean, np.eye(len(self.names)) - learned

    @property
    def fingerprint(self) -> str:
        """Short hash of all that changes a likelihood."""
        return fingerprint_of(*self.arrays().values())

    def arrays(self) -> dict[str, np.ndarray]:
        """Return all that changes a likelihood, by its name in a file."""
        arrays: dict[str, Any] = {}
        for term in self.terms:
            kind, prefix = (_DENSE, _VARYING) if term.strength is None else (_DIAGONAL, _SIZED)
            prefix = prefix if arrays else ""
            arrays |= {f"{prefix}{name}": getattr(term, name) for name in kind}
        arrays["size_scale"] = getattr(self.size, "prior_scale", None)
        return {name: np.asarray(value) for name, value in arrays.items() if value is not None}

    @property
    def words(self) -> dict[str, Any]:
        """The plain JSON that :meth:`restore` needs besides arrays."""
        return {"names": self.names, "size": next(iter(self.priors), ""), "shares": _SHARES}

    @classmethod
    def restore(cls, arrays: Mapping[str, np.ndarray], words: Mapping[str, Any]) -> ModelError:
        """Return the errors of these :meth:`arrays` and :attr:`words`.

        Raises
        ------
        InputError
            Shares were of the data when the posterior was saved; the arrays do not tell.
        TypeError
            An array is missing, or one is unknown.
        """
        if words.get("shares") != _SHARES:
            raise InputError(
                "the posterior is older than systematic errors that are shares of predictions; "
                "infer again"
            )
        groups: dict[str, dict[str, Any]] = {"": {}, _SIZED: {}, _VARYING: {}}
        for name, array in arrays.items():
            prefix = next((p for p in (_SIZED, _VARYING) if name.startswith(p)), "")
            groups[prefix][name.removeprefix(prefix)] = array
        first, *others = groups.values()
        scale = first.pop("size_scale", None)
        if missing := set(_DIAGONAL[:3]) - set(first):
            raise TypeError(f"{', '.join(missing)} is missing")
        size = None if scale is None else inferred_size(words.get("size", ""), float(scale))
        terms = [Term(**group) for group in (first, *others) if group]
        terms[-1] = replace(terms[-1], size=size)
        terms[0] = replace(terms[0], names=tuple(words.get("names", ())))
        return cls(tuple(terms))


def inferred_size(name: str, scale: float) -> Scale:
    """Return a size of this name in the posterior, under a half-normal prior of this scale."""
    return Scale(name, (f"the size '{name}'", "its scale"), None, scale)


def times(rows: Any, information: Any) -> Any:
    """Return V W (r, d) of rows V (r, d) and an information (d, d), or its diagonal (d,)."""
    return rows * information if information.ndim == 1 else rows @ information
