r"""Proper orthogonal decomposition (POD) and Gaussian processes: a reduced model of FEM runs.

FEM displacements are projected on their leading principal modes,
:math:`u(\theta) \approx \bar u + \sum_k c_k(\theta)\, \phi_k`, and each coefficient is a Gaussian
process of theta's position in its box. scikit-learn fits the processes; the mean they predict,
:math:`c_k = k_k(x, X)\, \alpha_k`, is written in JAX so that it differentiates.

Where the response is smooth, length scales are long and the :math:`\alpha_k` large, of both signs:
float64 is needed, or nothing is left of their sum (docs/experiments.md, "Nine millimetres in
float32").
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError
from emulator.core.gaussian_process import squared_exponential
from emulator.core.machine import require_float64
from emulator.fem.campaign import Runs, run_campaign
from emulator.fem.campaign.designs import sobol
from emulator.scenes.scene import Scene, all_nodes
from emulator.surrogates.protocol import (
    Arrays,
    ForwardKind,
    ForwardMap,
    Ingredients,
    Option,
    Options,
    Prediction,
    fingerprint_of,
    inside_only,
    rows_of,
)

# Variance added to each process, whose coefficients have variance 1: FEM has no noise.
_JITTER = 1e-10
# The arrays of a reduced model.
_ARRAYS = ("nodes", "mean", "modes", "inputs", "lengths", "weights")


@dataclass(frozen=True, eq=False)
class ReducedForward:
    """A fitted reduced model.

    scene, nodes : the scene, and the nodes (k,) whose displacement is returned.
    mean : the mean of the runs, (k, 3) mm.
    modes : the modes, each times its coefficient's standard deviation over the runs, (r, k, 3) mm.
    inputs : the theta of the FEM runs as positions in the box, (c, p).
    lengths : the length scales of each process, (r, p).
    weights : the amplitude times alpha of each process, (r, c).
    """

    scene: Scene
    nodes: np.ndarray
    mean: jax.Array
    modes: jax.Array
    inputs: jax.Array
    lengths: jax.Array
    weights: jax.Array

    kind = "reduced"

    @property
    def label(self) -> str:
        """The method, and the number of FEM runs it was fitted to."""
        return f"POD + GP of {len(self.inputs)} FEM runs"

    @cached_property
    def fingerprint(self) -> str:
        """Short hash of the scene and of every array."""
        arrays = (getattr(self, name) for name in _ARRAYS)
        return fingerprint_of(self.kind, self.scene.fingerprint, *arrays)

    def __call__(self, theta: jax.Array) -> jax.Array:
        """Return the displacement (k, 3) mm at ``theta`` (p,); refuse to do so in float32."""
        require_float64("a reduced model")
        gap = (self.scene.to_unit(theta) - self.inputs)[None] / self.lengths[:, None]
        correlations = squared_exponential(jnp.sum(gap**2, axis=-1))
        coefficients = jnp.sum(self.weights * correlations, axis=-1)
        u = self.mean + jnp.tensordot(coefficients, self.modes, axes=1)
        return self.scene.on_supports(u, theta, self.nodes)

    def evaluate(self, theta: jax.Array) -> Prediction:
        """Return the displacement, and whether ``theta`` is inside the box of the FEM runs."""
        return inside_only(self, theta)

    def at(self, nodes: np.ndarray) -> ReducedForward:
        """Return the map restricted to ``nodes``, all of which must be among its own."""
        r = rows_of(self, nodes)
        return replace(self, nodes=self.nodes[r], mean=self.mean[r], modes=self.modes[:, r])


def fit_reduced(scene: Scene, runs: Runs, *, truncation: float = 1e-9) -> ReducedForward:
    """Fit the reduced model to FEM runs; :class:`InputError` where there are fewer than 3.

    truncation : the fraction of the largest singular value below which modes are left out.
    """
    if len(runs.theta) < 3:
        raise InputError(f"a reduced model needs 3 FEM runs or more; there are {len(runs.theta)}")
    snapshots = np.asarray(runs.displacement)
    mean = snapshots.mean(axis=0)
    flat, root = (snapshots - mean).reshape(len(snapshots), -1), np.sqrt(len(snapshots))
    left, size, right = np.linalg.svd(flat, full_matrices=False)
    significant = size > truncation * size[0]
    inputs = np.asarray(scene.to_unit(runs.theta))
    processes = [_fit_one(inputs, column) for column in (left[:, significant] * root).T]
    modes = right[significant] * size[significant, None] / root
    return ReducedForward(
        scene=scene,
        nodes=all_nodes(scene),
        mean=jnp.asarray(mean),
        modes=jnp.asarray(modes.reshape(-1, *mean.shape)),
        inputs=jnp.asarray(inputs),
        lengths=jnp.asarray([lengths for lengths, _ in processes]),
        weights=jnp.asarray([weights for _, weights in processes]),
    )


def _fit_one(inputs: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the length scales (p,) and weights (c,) of one coefficient (c,) of unit variance."""
    from sklearn.exceptions import ConvergenceWarning  # slow to import, and only for a fit
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel

    kernel = ConstantKernel(10.0, (1e-2, 1e8)) * RBF(np.ones(inputs.shape[1]), (5e-2, 1e2))
    process = GaussianProcessRegressor(
        kernel, alpha=_JITTER, n_restarts_optimizer=1, random_state=0
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # lengths may reach their bounds
        process.fit(inputs, values)
    fitted = process.kernel_
    return np.atleast_1d(fitted.k2.length_scale), fitted.k1.constant_value * process.alpha_


def _build(ingredients: Ingredients, options: Options) -> ForwardMap:
    thetas = sobol(ingredients.scene, options["fem_runs"], ingredients.seed)
    runs = run_campaign(ingredients.fem, thetas, progress=ingredients.progress)
    return fit_reduced(ingredients.fem.scene, runs)


def _from_arrays(scene: Scene, arrays: Arrays) -> ReducedForward:
    nodes, *rest = (arrays[name] for name in _ARRAYS)
    return ReducedForward(scene, nodes, *map(jnp.asarray, rest))


REDUCED = ForwardKind(
    "reduced",
    "POD and Gaussian processes of a few FEM runs",
    _build,
    (Option("fem_runs", 30, "FEM runs that the reduced model is fitted to", least=3),),
    lambda forward: {name: np.asarray(getattr(forward, name)) for name in _ARRAYS},
    _from_arrays,
)
