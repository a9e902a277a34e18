r"""The forward map's own error in the likelihood, so that a poor map widens the posterior.

The map's data :math:`g(x)` differ from FEM's by :math:`e(x) = g_\text{FEM}(x) - g(x)`. The error is
treated as noise whose covariance depends on the unknowns x,

.. math:: y = g(x) + e(x) + \varepsilon, \qquad
          e(x) \sim N\left(0,\ \alpha(x)^2\, V V^T\right)

(the approximation error of Kaipio and Somersalo 2007, with a size that varies). It is learned from
n FEM runs at draws of the prior: :math:`\alpha(x_j) \propto |W^{1/2} e_j|`, with W the information
of the noise about its mean, is interpolated between the runs by a Gaussian kernel on
:math:`\log \alpha`, its width chosen by leaving runs out; and :math:`V V^T` is the mean of
:math:`e_j e_j^T / \hat\alpha_{-j}(x_j)^2`, with each run's size predicted from the others, so that
sizes that are hard to predict make the error larger.

The error is marginalised in closed form (:mod:`calibrate.statistical_model.error_modes`). It has no
mean: it does not correct the map, it says how far to believe it.

Where the runs were on a finer mesh, the error is the mesh's as well, and FEM on the mesh is allowed
the same.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from calibrate.statistical_model.error_modes import ErrorModes

_MODES = 12
_WIDTHS = np.geomspace(0.05, 2.0, 12)  # of the kernel, in standardised unknowns


class Runs(NamedTuple):
    """What FEM showed the map to be wrong by.

    x : (n, q) unknowns, standardised. errors : (n, d), FEM less map, whitened by the noise.
    """

    x: np.ndarray
    errors: np.ndarray


@dataclass(frozen=True, eq=False)
class ApproximationError(ErrorModes):
    """The map's error as noise; :func:`fit` makes it.

    x, log_sizes, width : runs (n, q), the logarithms of their sizes (n,), and the kernel's width.
    centre, scale : (q,) that standardise the unknowns.
    of_mesh : whether it was learned on a finer mesh, so that FEM on the map's mesh has it, too.
    """

    x: np.ndarray
    log_sizes: np.ndarray
    width: float
    centre: np.ndarray
    scale: np.ndarray
    of_mesh: bool = False

    def size(self, unknowns: jax.Array) -> jax.Array:
        r"""The size :math:`\alpha`, (), at ``unknowns`` (q,)."""
        at = (unknowns - self.centre) / self.scale
        return jnp.exp(_interpolate(at, self.x, self.log_sizes, self.width))

    @property
    def of_fem(self) -> bool:
        """Where it is the mesh's as well."""
        return self.of_mesh

    @property
    def with_mesh(self) -> bool:
        """As it was learned."""
        return self.of_mesh

    def arrays(self) -> dict[str, np.ndarray]:
        """All it consists of, by name; ``of_mesh`` where it is."""
        kept = {field.name: np.asarray(getattr(self, field.name)) for field in fields(self)}
        return kept if self.of_mesh else {n: a for n, a in kept.items() if n != "of_mesh"}

    @classmethod
    def restore(cls, arrays: Mapping[str, np.ndarray]) -> ApproximationError:
        """The error model with these :meth:`arrays`."""
        names = [field.name for field in fields(cls) if field.name != "of_mesh"]
        values: dict[str, Any] = {name: arrays[name] for name in names}
        return cls(**{**values, "width": float(values["width"])}, of_mesh="of_mesh" in arrays)


jax.tree_util.register_dataclass(
    ApproximationError,
    ["weights", "strength", "modes", "x", "log_sizes", "width", "centre", "scale"],
    ["of_mesh"],
)


def fit(
    unknowns: np.ndarray, errors: np.ndarray, information: np.ndarray, *, of_mesh: bool = False
) -> ApproximationError:
    """The error model of FEM runs.

    Parameters
    ----------
    unknowns : (n, q), where FEM was run.
    errors : (n, d), FEM's data less the map's, all observations raveled.
    information : (d, d), of the noise about its mean.
    of_mesh : whether FEM was run on a finer mesh.
    """
    root = np.linalg.cholesky(information)  # W = root root^T
    centre, scale = unknowns.mean(axis=0), np.maximum(unknowns.std(axis=0), 1e-12)
    runs = Runs((unknowns - centre) / scale, errors @ root)
    norms = np.linalg.norm(runs.errors, axis=1)
    log_sizes = np.log(np.maximum(norms, 1e-12 * max(float(norms.max()), 1e-300)))
    width = min(_WIDTHS, key=lambda w: _misfit(runs.x, log_sizes, w))
    shapes = runs.errors / np.exp(_without(runs.x, log_sizes, width))[:, None]
    _, singular, right = np.linalg.svd(shapes / np.sqrt(len(shapes)), full_matrices=False)
    kept = np.arange(len(singular)) < _MODES
    kept &= singular > 1e-6 * max(float(singular[0]), 1e-300)
    whitened = singular[kept, None] * right[kept]  # rows of V^T root, orthogonal
    return ApproximationError(
        weights=whitened @ root.T,
        strength=singular[kept] ** 2,
        modes=np.linalg.solve(root.T, whitened.T).T,
        x=runs.x,
        log_sizes=log_sizes,
        width=float(width),
        centre=centre,
        scale=scale,
        of_mesh=of_mesh,
    )


def _interpolate(at: jax.Array, x: np.ndarray, values: np.ndarray, width: float) -> jax.Array:
    """Kernel average (), of ``values`` (n,) at ``x`` (n, q): between the least and the greatest."""
    nearness = -0.5 * jnp.sum(((at - x) / width) ** 2, axis=-1)
    return jax.nn.softmax(nearness) @ values


def _without(x: np.ndarray, values: np.ndarray, width: float) -> np.ndarray:
    """Each value (n,) predicted from the others."""
    squared = np.sum((x[:, None] - x[None]) ** 2, axis=-1) / width**2
    np.fill_diagonal(squared, np.inf)
    nearness = -0.5 * (squared - squared.min(axis=1, keepdims=True))
    weights = np.exp(nearness)
    return weights @ values / weights.sum(axis=1)


def _misfit(x: np.ndarray, values: np.ndarray, width: float) -> float:
    return float(np.mean((_without(x, values, width) - values) ** 2))
