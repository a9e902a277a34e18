r"""Gaussian errors of a model's data besides its noise: a list of terms, integrated out exactly.

.. math:: y = g(x) + \sum_k V_k(x)^T z_k + \varepsilon, \qquad z_k \sim N(0, I), \qquad
          \varepsilon \sim N(0, W^{-1})

with the unknowns x, the predicted data g of all observations (d numbers), the information W of the
noise (d, d), or its diagonal, and the modes of each term in the unit of the data: what one standard
deviation of each :math:`z_{ki}` changes,

.. math:: V_k(x) = \alpha_k(x)\, \left(A_k + B_k \circ g(x)\right).

A :class:`Term` declares A, B and the size :math:`\alpha`: 1, or a function of the unknowns learned
from FEM runs (:class:`Amplitude`), or a number that is inferred under a half-normal prior
(:class:`~calibrate.noise.protocol.Scale`). Modes B are shares of the prediction, such as a load
cell's gain.

Elimination without exchanges, :math:`I + V W V^T = L P L^T` with pivots P and a unit lower
triangular L, gives all that is needed. With the reduced rows :math:`R = L^{-1} V W` the log
likelihood of the residual r = y - g changes by

.. math:: \tfrac12 \sum_i \left[\frac{(R_i r)^2}{P_i} - \log P_i\right]

(Woodbury's identity and the matrix determinant lemma), and of the information about the means

.. math:: W - R^T P^{-1} R

is left. Terms are eliminated in two groups, the second beside the information that the first
leaves. The first has the terms of size 1 without shares, which leave the same for all x. Where the
others have no shares, all their modes have one size, so that each group becomes one term with
modes, chosen once, for which :math:`G = A W A^T` is diagonal: then L = I,
:math:`P = I + \alpha^2 G`, and a likelihood of d numbers costs one product with the modes. Where
one has shares, the second group is eliminated anew for each x.

Which terms and noises can be together follows from this algebra (:func:`check_algebra`).

Shares are of the prediction g and not of the data y: the noise of the data would be scaled in the
modes, too, so that smaller predictions would err less, and a scale of n numbers with share s would
be fitted too low by the factor :math:`1 + (n - 1) s^2` (Peelle's puzzle; D'Agostini 1994).
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from jax.flatten_util import ravel_pytree

from calibrate.noise.protocol import Noise, Scale
from emulator.core.errors import InputError
from emulator.core.gaussian_process import eliminated
from emulator.surrogates.protocol import fingerprint_of

Means = Mapping[str, jax.Array]
"""Data without noise by the observation's name."""

LEARNED = "the size of the forward map's error is learned"
"""What is said of a size that is a function of the unknowns."""

_SIZED, _VARYING = "sized_", "varying_"  # prefixes of the arrays of a second group
# Recorded in saved errors, because in earlier versions shares were of the data.
_SHARES = "of the prediction"
_OF_PREDICTION = "some are shares of what is predicted"


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Amplitude:
    r"""Size of the errors as a function of the unknowns, by kernel regression on its logarithm.

    .. math:: \log\alpha(x) = \sum_j w_j \log\alpha_j, \qquad
              w_j \propto \exp\left(-\tfrac12 |x - x_j|^2 / h^2\right)

    x : the standardised unknowns (n, q) of the FEM runs.
    log_sizes : the logarithm of the size of each run's error, (n,).
    width : the kernel's width h, in standardised unknowns.
    centre, scale : mean and standard deviation (q,) by which the unknowns are standardised.
    """

    x: np.ndarray
    log_sizes: np.ndarray
    width: float
    centre: np.ndarray
    scale: np.ndarray

    def __call__(self, unknowns: jax.Array) -> jax.Array:
        """Return the size, (), at ``unknowns`` (q,): between the least and greatest of the runs."""
        at = (unknowns - self.centre) / self.scale
        log_weights = -0.5 * jnp.sum(((at - self.x) / self.width) ** 2, axis=-1)
        return jnp.exp(jax.nn.softmax(log_weights) @ self.log_sizes)

    @property
    def upper(self) -> float:
        """The greatest size of the runs."""
        return float(np.exp(np.max(self.log_sizes)))


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Term:
    """Errors of all data with one size.

    modes, shares : A and B, (r, d); no B where nothing is a share of the prediction.
    size : the size of the modes; ``None`` for 1.
    weights, strength : A W, (r, d), with W the information that terms before leave, and the
        diagonal of G, (r,); ``None`` where the modes are not chosen such that G is diagonal.
    mixing : orthogonal matrix (r, s) that makes such modes of the s declared ones, less the rows of
        modes that no datum could tell from nothing; ``None`` where the declared ones are forgotten.
    names : names of the unknowns z of the declared modes of a systematic error.
    of_fem : whether data differ from FEM on the map's mesh by these errors, too.
    """

    modes: np.ndarray
    shares: np.ndarray | None = None
    size: Amplitude | Scale | None = None
    weights: Any = None
    strength: Any = None
    mixing: Any = None
    names: tuple[str, ...] = jax.tree.static(default=())
    of_fem: bool = jax.tree.static(default=True)

    @property
    def is_learned(self) -> bool:
        """Whether the errors are the forward map's, learned from FEM runs."""
        return isinstance(self.size, Amplitude)

    @property
    def unknown_size(self) -> str:
        """What is said of the size if it is not known; empty for 1."""
        if isinstance(self.size, Scale):
            return f"the size '{self.size.name}' is inferred (scale {self.size.prior_scale:g})"
        return LEARNED if self.is_learned else ""

    def alpha(self, unknowns: jax.Array) -> Any:
        """Return the size, (), at ``unknowns``, of which an inferred one is the last."""
        if isinstance(self.size, Scale):
            return unknowns[-1]
        return 1.0 if self.size is None else self.size(unknowns)

    def at(self, alpha: Any, means: jax.Array) -> jax.Array:
        """Return V (r, d) where the size is ``alpha`` and the prediction ``means`` (d,)."""
        modes = jnp.asarray(self.modes)
        return alpha * (modes if self.shares is None else modes + self.shares * means)


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class ModelError:
    """All errors of a model's data besides its noise, as :func:`marginalised` makes them.

    terms : the terms in the order in which they are eliminated.
    information : W beside the terms that are not diagonal, which are eliminated anew for each x,
        (d, d), or its diagonal (d,); ``None`` where all are.
    """

    terms: tuple[Term, ...] = ()
    information: np.ndarray | None = None

    @property
    def declared(self) -> tuple[Term, ...]:
        """All terms, with the declared modes where these are known, to be integrated out anew."""
        return tuple(
            Term(
                t.modes if t.mixing is None else t.mixing.T @ t.modes,
                t.shares,
                t.size,
                names=t.names,
                of_fem=t.of_fem,
            )
            for t in self.terms
        )

    @property
    def of_fem(self) -> ModelError:
        """The errors by which data differ from FEM on the map's mesh, too."""
        return replace(self, terms=tuple(term for term in self.terms if term.of_fem))

    @property
    def is_learned(self) -> bool:
        """Whether errors of the forward map, learned from FEM runs, are among them."""
        return any(term.is_learned for term in self.terms)

    @property
    def of_mesh(self) -> bool:
        """Whether errors were learned on a finer mesh, so that they are the mesh's as well."""
        return self.of_fem.is_learned

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the unknowns z of systematic errors of known size, without shares."""
        return self.terms[0].names if self.terms else ()

    @property
    def size(self) -> Amplitude | Scale | None:
        """The size that is not known, of which there is one at most."""
        return next((term.size for term in self.terms if term.size is not None), None)

    @property
    def priors(self) -> dict[str, dist.Distribution]:
        """Prior of the size that is inferred, by its name in the posterior; empty if none is."""
        return self.size.priors if isinstance(self.size, Scale) else {}

    def log_ratio(self, unknowns: jax.Array, residual: Means, means: Means) -> jax.Array:
        """Return what the errors add to the log likelihood of ``residual``, data less ``means``.

        unknowns : theta's unknowns (q,), then the size of :attr:`priors` if one is inferred.
        """
        total, column = jnp.zeros(()), ravel_pytree(dict(residual))[0][:, None]
        for pivots, rows in self._eliminated(unknowns, means, column):
            total += 0.5 * jnp.sum(rows[:, 0] ** 2 / pivots - jnp.log(pivots))
        return total

    def information_left(
        self, information: jax.Array, unknowns: jax.Array, means: Means
    ) -> jax.Array:
        """Return what is left of the noise's ``information`` about ``means``, (d, d).

        It is the inverse covariance of the data given the unknowns. How the covariance itself
        depends on the unknowns is not counted. A diagonal (d,) stays one where there are no errors.
        """
        if not self.terms:
            return information
        left = jnp.diag(information) if information.ndim == 1 else information
        for pivots, rows in self._eliminated(unknowns, means, jnp.eye(len(information))):
            left = left - (rows.T / pivots) @ rows
        return left

    def draw(self, rng_key: jax.Array, unknowns: jax.Array, means: Means) -> dict[str, jax.Array]:
        """Return data without noise that might have come: ``means`` plus a draw of the errors."""
        flat, unravel = ravel_pytree(dict(means))
        modes = self._modes(unknowns, flat)
        keys = jax.random.split(rng_key, len(modes)) if len(modes) > 1 else [rng_key]
        for key, V in zip(keys, modes, strict=False):
            flat += jax.random.normal(key, (len(V),)) @ V
        return unravel(flat)

    def largest(self, means: Means) -> np.ndarray:
        """Return V (r, d) beside data like ``means``, each size as large as is plausible."""
        flat = ravel_pytree(dict(means))[0]
        rows = [term.at(term.size.upper if term.size else 1.0, flat) for term in self.terms]
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
            reasons = (*filter(None, (t.unknown_size for t in self.terms)), _OF_PREDICTION)
            raise InputError(f"what is known of errors: {reasons[0]}")
        assert first.mixing is not None
        ((pivots, rows),) = self._eliminated(
            jnp.zeros(0), {}, ravel_pytree(dict(residual))[0][:, None]
        )
        mean = first.mixing.T @ np.asarray(rows[:, 0] / pivots)
        learned = (first.mixing.T * np.asarray(1.0 - 1.0 / pivots)) @ first.mixing
        return mean, np.eye(len(self.names)) - learned

    def _modes(self, unknowns: jax.Array, means: jax.Array) -> list[jax.Array]:
        """Return V of each term that is diagonal, and of all others together if there are some."""
        each = [term.at(term.alpha(unknowns), means) for term in self.terms]
        modes = [V for V, term in zip(each, self.terms, strict=True) if term.strength is not None]
        others = each[len(modes) :]
        return [*modes, jnp.concatenate(others)] if others else modes

    def _eliminated(
        self, unknowns: jax.Array, means: Means, columns: jax.Array
    ) -> Iterator[tuple[jax.Array, jax.Array]]:
        """Yield pivots P (r,), and R ``columns`` (r, m) of columns (d, m), group by group."""
        for term in self.terms:
            if term.strength is not None:
                alpha = term.alpha(unknowns)
                yield 1.0 + alpha**2 * term.strength, alpha * (term.weights @ columns)
        if any(term.strength is None for term in self.terms):
            V = self._modes(unknowns, ravel_pytree(dict(means))[0])[-1]
            VW = times(V, self.information)
            yield eliminated(VW @ V.T + jnp.eye(len(V)), VW @ columns)

    # Files.

    @property
    def fingerprint(self) -> str:
        """Short hash of all that changes a likelihood."""
        return fingerprint_of(*self.arrays().values())

    def arrays(self) -> dict[str, np.ndarray]:
        """Return all that changes a likelihood, by its name in a file."""
        diagonal = [term for term in self.terms if term.strength is not None]
        arrays: dict[str, Any] = {
            f"{prefix}{name}": getattr(term, name)
            for prefix, term in zip(("", _SIZED), diagonal, strict=False)
            for name in ("weights", "strength", "modes", "mixing")
        }
        if isinstance(self.size, Amplitude):
            arrays |= vars(self.size)
        if others := self.terms[len(diagonal) :]:
            rows = [(t.modes, t.modes * 0.0 if t.shares is None else t.shares) for t in others]
            modes, shares = map(np.concatenate, zip(*rows, strict=True))
            sized = [np.full(len(term.modes), float(term.size is not None)) for term in others]
            varying = {"modes": modes, "shares": shares, "sized": np.concatenate(sized)}
            arrays |= {f"{_VARYING}{name}": value for name, value in varying.items()}
            arrays[f"{_VARYING}information"] = self.information
        if isinstance(self.size, Scale):
            arrays["size_scale"] = self.size.prior_scale
        if self.of_mesh:
            arrays["of_mesh"] = True
        return {name: np.asarray(value) for name, value in arrays.items() if value is not None}

    @property
    def words(self) -> dict[str, Any]:
        """The plain JSON that :meth:`restore` needs besides arrays; empty for learned errors."""
        if self.terms[0].mixing is None:
            return {}
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
        if words and words.get("shares") != _SHARES:
            raise InputError(
                "the posterior is older than systematic errors that are shares of predictions; "
                "infer again"
            )
        groups: dict[str, dict[str, Any]] = {"": {}, _SIZED: {}, _VARYING: {}}
        for name, array in arrays.items():
            prefix = next((p for p in (_SIZED, _VARYING) if name.startswith(p)), "")
            groups[prefix][name.removeprefix(prefix)] = array
        first, sized, varying = groups.values()
        learned = {
            each.name: first.pop(each.name) for each in fields(Amplitude) if each.name in first
        }
        of_mesh, scale = first.pop("of_mesh", None) is not None, first.pop("size_scale", None)
        more: dict[str, Any] = {"of_fem": of_mesh or not learned}
        if learned:
            more["size"] = Amplitude(**{**learned, "width": float(learned["width"])})
        elif scale is not None:
            more["size"] = inferred_size(words.get("size", ""), float(scale))
        names = tuple(words.get("names", ()))
        if not all(
            {"modes", "weights", "strength"} <= group.keys() for group in (first, sized) if group
        ):
            raise TypeError("an array is missing")
        terms = [Term(**first, **({} if sized or varying else more), names=names)]
        if sized:
            terms.append(Term(**sized, **more))
        if varying:
            ends = np.flatnonzero(np.diff(varying["sized"])) + 1
            for rows in np.split(np.arange(len(varying["sized"])), ends):
                of_size = more if varying["sized"][rows[0]] else {}
                terms.append(Term(varying["modes"][rows], varying["shares"][rows], **of_size))
        return cls(tuple(terms), varying.get("information"))


def inferred_size(name: str, scale: float) -> Scale:
    """Return a size of this name in the posterior, under a half-normal prior of this scale."""
    return Scale(name, (f"the size '{name}'", "its scale"), None, scale)


def times(rows: Any, information: Any) -> Any:
    """Return V W (r, d) of rows V (r, d) and an information (d, d), or its diagonal (d,)."""
    return rows * information if information.ndim == 1 else rows @ information


def check_algebra(
    what: str,
    noise: Mapping[str, Noise],
    sizes: Collection[str] = (),
    *,
    gaussian: bool = True,
    known: bool = True,
) -> None:
    """Raise :class:`InputError` unless noise and errors have the properties that algebra needs.

    Terms are integrated out beside Gaussian noise, whose information does not change with the
    unknowns; and modes are made diagonal for one size.

    what : the beginning of the message.
    sizes : the different sizes that are not known, as of :attr:`Term.unknown_size`.
    gaussian, known : whether the noise has to be Gaussian, and its sd known.
    """
    for name, each in noise.items():
        if gaussian and not each.gaussian:
            raise InputError(f"{what}: the noise of {name} must be Gaussian; it is {each.kind}")
        if known and each.priors:
            raise InputError(
                f"{what}: the noise of {name} must be of known sd; {', '.join(each.priors)} is "
                "inferred"
            )
    if len(sizes) > 1:
        raise InputError(
            f"{what}: {' and '.join(sizes)}; only one size can be unknown, by one name and scale"
        )


def marginalised(terms: Sequence[Term], information: np.ndarray) -> ModelError:
    """Return ``terms`` together, integrated out; at most one of their sizes is not known.

    information : information W of the noise about the data's means, (d, d), or its diagonal (d,).
    """
    constant = [term for term in terms if term.size is None and term.shares is None]
    others = [term for term in terms if term.size is not None or term.shares is not None]
    first = _together(constant, information)
    before = () if all(term.is_learned for term in terms) else (first,)
    if all(term.shares is None for term in others):
        second = [replace(_together(others, information, first), mixing=None)] if others else []
        return ModelError((*before, *second))
    left = information
    if constant:
        left = np.asarray(ModelError(before).information_left(jnp.asarray(left), jnp.zeros(0), {}))
    return ModelError((*before, *others), left)


def _together(terms: Sequence[Term], information: np.ndarray, before: Term | None = None) -> Term:
    """Return terms of one size without shares as one, its modes chosen such that G is diagonal.

    information : information W of the noise, of which ``before`` leaves a part.
    """
    modes = np.concatenate([np.zeros((0, len(information))), *(term.modes for term in terms)])
    weighted = times(modes, information)
    if before is not None:
        between = (weighted @ before.modes.T) / (1.0 + before.strength)
        weighted = weighted - between @ before.weights
    strength, mixing = np.linalg.eigh(weighted @ modes.T)
    visible = strength > 1e-12 * max(float(strength.max(initial=0.0)), 1e-300)
    rows = mixing[:, visible].T
    return replace(
        terms[0] if terms else Term(modes),
        modes=rows @ modes,
        weights=rows @ weighted,
        strength=strength[visible],
        mixing=rows,
        names=tuple(name for term in terms for name in term.names),
    )
