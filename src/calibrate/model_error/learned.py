r"""The forward map's own error, learned from FEM runs, so that a poor map widens the posterior.

The map's data :math:`g(x)` differ from FEM's by :math:`e(x) = g_\text{FEM}(x) - g(x)`. The error is
treated as noise whose covariance depends on the unknowns x,

.. math:: y = g(x) + e(x) + \varepsilon, \qquad
          e(x) \sim N\left(0,\ \alpha(x)^2\, A^T A\right)

(the approximation error of Kaipio and Somersalo 2007, with a size that varies). It is learned from
n FEM runs at draws of the prior: :math:`\alpha(x_j) \propto |W^{1/2} e_j|`, with W the information
of the noise about its mean, is interpolated between the runs by a Gaussian kernel on
:math:`\log \alpha`, its width chosen by leaving runs out; and :math:`A^T A` is the mean of
:math:`e_j e_j^T / \hat\alpha_{-j}(x_j)^2`, with each run's size predicted from the others, so that
sizes that are hard to predict make the error larger.

The error has no mean: it does not correct the map, it says how far to believe it. Where the runs
were on a finer mesh, the error is the mesh's as well, and FEM on the mesh is allowed the same.
"""

from __future__ import annotations

import numpy as np

from calibrate.model_error.marginal import Amplitude, ModelError

_MODES = 12
_WIDTHS = np.geomspace(0.05, 2.0, 12)  # kernel widths in standardised unknowns


def fit(
    unknowns: np.ndarray, errors: np.ndarray, information: np.ndarray, *, of_mesh: bool = False
) -> ModelError:
    """Return the error that FEM runs show.

    Parameters
    ----------
    unknowns : the unknowns at which FEM was run, (n, q).
    errors : FEM's data less the map's, all observations raveled, (n, d).
    information : the information W of the noise about its mean, (d, d).
    of_mesh : whether FEM was run on a finer mesh.
    """
    root = np.linalg.cholesky(information)  # W = root root^T
    centre, scale = unknowns.mean(axis=0), np.maximum(unknowns.std(axis=0), 1e-12)
    x, whitened = (unknowns - centre) / scale, errors @ root
    norms = np.linalg.norm(whitened, axis=1)
    log_sizes = np.log(np.maximum(norms, 1e-12 * max(float(norms.max()), 1e-300)))
    width = min(_WIDTHS, key=lambda w: _misfit(x, log_sizes, w))
    shapes = whitened / np.exp(_left_out(x, log_sizes, width))[:, None]
    _, singular, right = np.linalg.svd(shapes / np.sqrt(len(shapes)), full_matrices=False)
    used = np.arange(len(singular)) < _MODES
    used &= singular > 1e-6 * max(float(singular[0]), 1e-300)
    rows = singular[used, None] * right[used]  # A root, orthogonal
    return ModelError(
        weights=rows @ root.T,
        strength=singular[used] ** 2,
        modes=np.linalg.solve(root.T, rows.T).T,
        amplitude=Amplitude(x, log_sizes, float(width), centre, scale),
        of_mesh=of_mesh,
    )


def _left_out(x: np.ndarray, values: np.ndarray, width: float) -> np.ndarray:
    """Return leave-one-out predictions of ``values`` (n,) at ``x`` (n, q) by kernel regression."""
    squared = np.sum((x[:, None] - x[None]) ** 2, axis=-1) / width**2
    np.fill_diagonal(squared, np.inf)
    weights = np.exp(-0.5 * (squared - squared.min(axis=1, keepdims=True)))
    return weights @ values / weights.sum(axis=1)


def _misfit(x: np.ndarray, values: np.ndarray, width: float) -> float:
    return float(np.mean((_left_out(x, values, width) - values) ** 2))
