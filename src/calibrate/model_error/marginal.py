r"""Gaussian errors of a model's data besides its noise, integrated out in closed form.

.. math:: y = g(x) + V(x)^T z + \varepsilon, \qquad z \sim N(0, I_r), \qquad
          \varepsilon \sim N(0, W^{-1})

with the unknowns x, the predicted data g of all observations (d numbers), the information W (d, d)
of the noise, and modes V (r, d) in the unit of the data: what one standard deviation of each
:math:`z_i` changes. Every error that correlates numbers is a set of modes,

.. math:: V_i(x) = \alpha_i(x)\, \left(A_i + B_i \circ g(x)\right),

with known A and B. Modes B are shares of the prediction, such as a load cell's gain. The size
:math:`\alpha_i` is 1, or a function of the unknowns learned from FEM runs (:class:`Amplitude`), or
a number that is inferred under a half-normal prior.

Elimination without exchanges, :math:`I + V W V^T = L P L^T` with pivots P and a unit lower
triangular L, gives all that is needed. With the reduced rows :math:`R = L^{-1} V W` the log
likelihood of the residual r = y - g changes by

.. math:: \tfrac12 \sum_i \left[\frac{(R_i r)^2}{P_i} - \log P_i\right]

(Woodbury's identity and the matrix determinant lemma), and of the information about the means

.. math:: W - R^T P^{-1} R

is left. Where B = 0 and the size is common to all modes, the modes are chosen such that
:math:`G = A W A^T` is diagonal, once: then L = I, :math:`P = I + \alpha^2 G`, and a likelihood of d
numbers costs one product with the modes. These are the *fixed* modes, whose size is known or
learned, and after them the *sized* ones, whose size is inferred, beside the information that the
fixed modes leave. Where a mode is a share of the prediction, all that are not fixed *vary*, and are
eliminated anew for each x.

Shares are of the prediction g and not of the data y: the noise of the data would be scaled in the
modes, too, so that smaller predictions would err less, and a scale of n numbers with share s would
be fitted too low by the factor :math:`1 + (n - 1) s^2` (Peelle's puzzle; D'Agostini 1994).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from jax.flatten_util import ravel_pytree

from calibrate.noise.protocol import PLAUSIBLE
from emulator.core.errors import InputError
from emulator.core.gaussian_process import kernel_mean
from emulator.core.small_matrices import eliminate
from emulator.surrogates.protocol import fingerprint_of

Means = Mapping[str, jax.Array]
"""Data without noise by the observation's name."""

_SIZED, _VARYING = "sized_", "varying_"  # prefixes of the arrays of these modes
# Recorded in saved errors, because in earlier versions shares were of the data.
_SHARES = "of the prediction"


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
        squared = jnp.sum(((at - self.x) / self.width) ** 2, axis=-1)
        return jnp.exp(kernel_mean(squared, self.log_sizes))


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class SizedModes:
    """Modes with one size that is inferred, chosen such that G is diagonal.

    weights, strength, modes : as of a :class:`ModelError`, W being what its fixed modes leave.
    """

    weights: np.ndarray
    strength: np.ndarray
    modes: np.ndarray


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class VaryingModes:
    """Modes that depend on the prediction, and beside them those whose size is inferred.

    modes, shares : A and B, (r, d).
    sized : 1 for each mode whose size is inferred, 0 where it is 1, (r,).
    information : W beside these modes, (d, d), or its diagonal (d,) where it has no other entries.
    """

    modes: np.ndarray
    shares: np.ndarray
    sized: np.ndarray
    information: np.ndarray

    def at(self, size: jax.Array | float, means: jax.Array) -> jax.Array:
        """Return V (r, d) where the inferred size is ``size`` and the prediction ``means`` (d,)."""
        alpha = jnp.where(self.sized > 0.0, size, 1.0)
        return alpha[:, None] * (self.modes + self.shares * means)

    def weighted(self, V: jax.Array) -> jax.Array:
        """Return V W (r, d)."""
        diagonal = self.information.ndim == V.ndim - 1
        return V * self.information if diagonal else V @ self.information


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class ModelError:
    """All errors of a model's data besides its noise.

    weights : A W of the fixed modes, (r, d).
    strength : the diagonal of G, (r,).
    modes : A, the fixed modes at size 1, (r, d).
    amplitude : the size of the fixed modes; ``None`` for 1.
    sized : the modes whose size is inferred, and
    varying : the modes that vary; ``None`` where there are none. There are never both.
    names : names of the s unknowns z of systematic errors with known modes.
    mixing : orthogonal matrix (r, s) that makes the fixed modes of those of the named unknowns,
        less the rows of modes that no datum could tell from nothing.
    of_mesh : whether the errors were learned on a finer mesh, so that they are the mesh's as well.
    size_name, size_scale : name of the inferred size in the posterior, and the scale of its
        half-normal prior; empty and 0 where none is inferred.
    """

    weights: np.ndarray
    strength: np.ndarray
    modes: np.ndarray
    amplitude: Amplitude | None = None
    sized: SizedModes | None = None
    varying: VaryingModes | None = None
    mixing: np.ndarray | None = None
    names: tuple[str, ...] = jax.tree.static(default=())
    of_mesh: bool = jax.tree.static(default=False)
    size_name: str = jax.tree.static(default="")
    size_scale: float = jax.tree.static(default=0.0)

    @property
    def of_fem(self) -> bool:
        """Whether data differ from FEM on the map's mesh by these errors, too."""
        return self.amplitude is None or self.of_mesh

    @property
    def priors(self) -> dict[str, dist.Distribution]:
        """Prior of the size that is inferred, by its name in the posterior; empty if none is."""
        return {self.size_name: dist.HalfNormal(self.size_scale)} if self.size_name else {}

    def size(self, unknowns: jax.Array) -> jax.Array:
        """Return the size of the fixed modes, (), at ``unknowns``."""
        return jnp.ones(()) if self.amplitude is None else self.amplitude(unknowns)

    def log_ratio(self, unknowns: jax.Array, residual: Means, means: Means) -> jax.Array:
        """Return what the errors add to the log likelihood of ``residual``, data less ``means``.

        unknowns : theta's unknowns (q,), then the size of :attr:`priors` if one is inferred.
        """
        flat, _ = ravel_pytree(dict(residual))
        pivots, rows = self._eliminated(unknowns, means, flat[:, None])
        return 0.5 * jnp.sum(rows[:, 0] ** 2 / pivots - jnp.log(pivots))

    def information_left(
        self, information: jax.Array, unknowns: jax.Array, means: Means
    ) -> jax.Array:
        """Return what is left of the noise's ``information`` (d, d) about ``means``.

        It is the inverse covariance of the data given the unknowns. How the covariance itself
        depends on the unknowns is not counted.
        """
        pivots, rows = self._eliminated(unknowns, means, jnp.eye(len(information)))
        return information - (rows.T / pivots) @ rows

    def draw(self, rng_key: jax.Array, unknowns: jax.Array, means: Means) -> dict[str, jax.Array]:
        """Return data without noise that might have come: ``means`` plus a draw of the errors."""
        flat, unravel = ravel_pytree(dict(means))
        key, second = rng_key, rng_key
        V = self._not_fixed(self._inferred_size(unknowns), flat)
        if V is not None:
            key, second = jax.random.split(rng_key)
        z = jax.random.normal(key, self.strength.shape)
        perturbed = flat + self.size(unknowns) * (z @ self.modes)
        if V is not None:
            perturbed += jax.random.normal(second, (len(V),)) @ V
        return unravel(perturbed)

    def largest(self, means: Means) -> np.ndarray:
        """Return V (r, d) beside data like ``means``, an inferred size at its 99.7 % quantile."""
        flat, _ = ravel_pytree(dict(means))
        V = self._not_fixed(PLAUSIBLE * self.size_scale, flat)
        return self.modes if V is None else np.vstack([self.modes, np.asarray(V)])

    def unknowns(self, residual: Means) -> tuple[np.ndarray, np.ndarray]:
        """Return mean (s,) and covariance (s, s) of the named z given ``residual``, at one draw.

        Raises
        ------
        InputError
            Some of the errors vary with the prediction or in size.
        """
        if self.sized is not None or self.varying is not None:
            of_size = f"the size '{self.size_name}' is inferred"
            reason = of_size if self.size_name else "some are shares of what is predicted"
            raise InputError(f"what is known of errors: {reason}")
        assert self.mixing is not None
        flat = np.asarray(ravel_pytree(dict(residual))[0])
        pivots = 1.0 + self.strength
        mean = self.mixing.T @ ((self.weights @ flat) / pivots)
        learned = (self.mixing.T * (1.0 - 1.0 / pivots)) @ self.mixing
        return mean, np.eye(len(self.names)) - learned

    def _eliminated(
        self, unknowns: jax.Array, means: Means, columns: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Return the pivots P (r,), and R ``columns`` (r, m) of columns (d, m)."""
        alpha = self.size(unknowns)
        pivots, rows = 1.0 + alpha**2 * self.strength, alpha * (self.weights @ columns)
        if self.sized is not None:
            size = self._inferred_size(unknowns)
            pivots = jnp.concatenate([pivots, 1.0 + size**2 * self.sized.strength])
            rows = jnp.concatenate([rows, size * (self.sized.weights @ columns)])
        if self.varying is None:
            return pivots, rows
        flat, _ = ravel_pytree(dict(means))
        V = self.varying.at(self._inferred_size(unknowns), flat)
        VW = self.varying.weighted(V)
        more = eliminate(VW @ V.T + jnp.eye(len(V)), VW @ columns)
        return jnp.concatenate([pivots, more[0]]), jnp.concatenate([rows, more[1]])

    def _inferred_size(self, unknowns: jax.Array) -> jax.Array | float:
        return unknowns[-1] if self.size_name else 1.0

    def _not_fixed(self, size: jax.Array | float, means: jax.Array) -> jax.Array | None:
        """Return V (r, d) of all modes that are not fixed; None where there are none."""
        if self.sized is not None:
            return size * jnp.asarray(self.sized.modes)
        return None if self.varying is None else self.varying.at(size, means)

    @property
    def fingerprint(self) -> str:
        """Short hash of all that changes a likelihood."""
        return fingerprint_of(*self.arrays().values())

    def arrays(self) -> dict[str, np.ndarray]:
        """Return all that changes a likelihood, by its name in a file."""
        arrays = {n: getattr(self, n) for n in ("weights", "strength", "modes", "mixing")}
        if self.amplitude is not None:
            arrays |= vars(self.amplitude)
        for prefix, group in ((_SIZED, self.sized), (_VARYING, self.varying)):
            if group is not None:
                arrays |= {f"{prefix}{n}": v for n, v in vars(group).items()}
        if self.size_name:
            arrays["size_scale"] = np.array(self.size_scale)
        if self.of_mesh:
            arrays["of_mesh"] = True
        return {name: np.asarray(value) for name, value in arrays.items() if value is not None}

    @property
    def words(self) -> dict[str, Any]:
        """The plain JSON that :meth:`restore` needs besides arrays; empty for learned errors."""
        if self.mixing is None:
            return {}
        return {"names": self.names, "size": self.size_name, "shares": _SHARES}

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
        own: dict[str, Any] = {
            n: v for n, v in arrays.items() if not n.startswith((_SIZED, _VARYING))
        }
        of_mesh = own.pop("of_mesh", None) is not None
        size = {each.name: own.pop(each.name) for each in fields(Amplitude) if each.name in own}
        if size:
            own["amplitude"] = Amplitude(**{**size, "width": float(size["width"])})
        if sized := {n.removeprefix(_SIZED): v for n, v in arrays.items() if n.startswith(_SIZED)}:
            own["sized"] = SizedModes(**sized)
        if varying := {n.removeprefix(_VARYING): v for n, v in arrays.items() if _VARYING in n}:
            own["varying"] = VaryingModes(**varying)
        own |= {"size_scale": float(own.get("size_scale", 0.0)), "of_mesh": of_mesh}
        names = tuple(words.get("names", ()))
        return cls(**own, names=names, size_name=words.get("size") or "")


def diagonal(
    modes: np.ndarray, information: np.ndarray, fixed: ModelError | None = None
) -> tuple[np.ndarray, ...]:
    """Return fixed modes of the same covariance with a diagonal G.

    modes : the modes as they are declared, (s, d).
    information : W, (d, d), or its diagonal (d,).
    fixed : modes that come before these; W is what they leave.

    Returns
    -------
    weights, strength, modes, mixing : the fields of :class:`ModelError`.
    """
    weighted = modes * information if information.ndim == 1 else modes @ information
    if fixed is not None:
        between = (weighted @ fixed.modes.T) / (1.0 + fixed.strength)
        weighted = weighted - between @ fixed.weights
    strength, mixing = np.linalg.eigh(weighted @ modes.T)
    visible = strength > 1e-12 * max(float(strength.max(initial=0.0)), 1e-300)
    rows = mixing[:, visible].T
    return rows @ weighted, strength[visible], rows @ modes, rows
