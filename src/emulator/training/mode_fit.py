r"""Fitting a separable network: its modes by variable projection, then their coefficients.

The network is fitted to *snapshots*: of every FEM run i the displacement less the centre's, and the
slopes along the axes of the unit box, which its tangent gives for a tenth of a run,

.. math:: d_i = u_i - u_c, \qquad d_{ij} = \sqrt{\gamma}\; \partial u_i / \partial x_j,

in the inner product of displacements and their gradients (the paper's F-DD),

.. math:: \langle v, w \rangle = \frac1{n s^2} \sum_\text{nodes} v \cdot w
    + \frac1{|\Omega| s_F^2} \int_\Omega \nabla v : \nabla w \, dX .

**Modes.** The eigenvectors of the snapshots' Gram matrix, each as long as the root of its
eigenvalue, are the targets :math:`t_k`. A mode is linear in the last layer of the trunk,
:math:`\varphi_k = H w_k`, with H (n, h) the trunk's last hidden layer and a column of ones. So
:math:`w_k` is solved for at every step (Golub and Pereyra 1973), and only the processor and the
trunk below descend: since w minimises, the derivative of

.. math:: \min_w \sum_k |t_k - H w_k|^2 \quad\text{with respect to } H \text{ is }\quad
    -2 \sum_k K (t_k - H w_k)\, w_k^T

at fixed w, with K the matrix of the inner product. No theta enters: a step costs one processor
pass. Steps are as long in every direction of a layer's weights
(:func:`~emulator.training.optimiser.orthogonal_steps`).

**Coefficients.** The snapshots are projected on the modes, and the branch, :math:`c(x) = h(x) B`
with h its last hidden layer and a one, is fitted to values and slopes of all runs at once,

.. math::
    \min_B \frac1c \sum_i \Big[ |h(x_i) B - a_i|_G^2
    + \gamma \sum_j |\partial_j h(x_i) B - a_{ij}|_G^2 \Big], \qquad
    G_{kl} = \langle \varphi_k, \varphi_l \rangle .

B, which does not depend on G, is solved for at every step as well, and the layers below descend by
L-BFGS on the logarithm of the misfit.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
import optax
import scipy.linalg
import scipy.sparse as sp
from flax import nnx
from scipy.sparse.csgraph import reverse_cuthill_mckee

from emulator.core.display import counting
from emulator.fem.campaign import Runs
from emulator.scenes.scene import Scene
from emulator.surrogates.network import Network
from emulator.surrogates.network.pignn import MLP
from emulator.training.optimiser import Weights

_SLOPES = 0.1  # gamma: positions have a variance of 1/12 in the unit box
_RIDGE = 1e-9  # over the hidden layer's mean square; larger weights are noise in float32
_ZERO = 1e-12  # relative to the sum of the modes' squares
_MEMORY = 20  # steps that L-BFGS remembers
_AT_ONCE = 50  # iterations of L-BFGS between two evaluations of the misfit
_ROWS = 32  # rows of a block of the product, by trial


class BranchTargets(NamedTuple):
    """The coefficients to which the branch is fitted.

    values, slopes : the snapshots' coefficients in the modes, (c, r) and (c, p, r).
    products : the inner products of the modes, (r, r).
    """

    values: jax.Array
    slopes: jax.Array
    products: jax.Array

    def misfit(self, coefficients: jax.Array, wanted: jax.Array) -> jax.Array:
        """Return the squared distance of coefficients (s, r) to ``wanted``, over its square, ()."""
        square = lambda e: jnp.sum((e @ self.products) * e)  # noqa: E731
        return square(coefficients - wanted) / square(wanted)


class Scales(NamedTuple):
    """Root mean square differences of runs from the centre's: s, mm, and s_F, dimensionless."""

    displacement: float
    gradient: float


def scales_of(scene: Scene, runs: Runs) -> Scales:
    """Return the scales of ``runs``, the one at the centre first."""
    deviation = np.asarray(runs.displacement[1:] - runs.displacement[0])
    return Scales(
        displacement=float(np.sqrt(np.mean(np.sum(deviation**2, axis=-1)))),
        gradient=float(jnp.sqrt(mean_square_gradient(scene, jnp.asarray(deviation)))),
    )


def mean_square_gradient(scene: Scene, difference: jax.Array) -> jax.Array:
    """Return the mean over fields and volume of ``|F(u) - F(v)|^2``, ().

    difference : u - v, (b, n, 3) mm. F is linear in the displacement, so that one gradient of the
        difference is enough.
    """
    weights = scene.discretisation.weights
    H = jax.vmap(lambda d: scene.gradients(d))(difference)
    squares = jnp.sum(H * H, axis=(-2, -1))
    return jnp.sum(weights * jnp.mean(squares, axis=0)) / jnp.sum(weights)


@dataclass(frozen=True, eq=False)
class ModeFit:
    """The fit of a network's modes and coefficients to runs with sensitivities.

    scene, network : the scene, and its untrained network.
    runs : the runs that the network is fitted to, the one at the centre first.
    scales : the scales s and s_F of the inner product; s is the network's scale, too.
    slopes : the weight gamma of the slopes.
    """

    scene: Scene
    network: Network
    runs: Runs
    scales: Scales
    slopes: float = _SLOPES

    def __post_init__(self) -> None:
        # Evaluated here, because a first evaluation inside jit would be traced.
        self._product, self._components, self._weighted_targets  # noqa: B018

    @cached_property
    def _product(self) -> BlockedMatrix:
        """The matrix K (n, n) of the inner product."""
        n, rule = len(self.scene.mesh.nodes), self.scene.discretisation
        weight = (self.scales.displacement / self.scales.gradient) ** 2 / rule.weights.sum()
        return BlockedMatrix.of(sp.csr_matrix(weight * rule.laplacian() + sp.identity(n) / n))

    def weighted(self, fields: jax.Array) -> jax.Array:
        """Return K times ``fields`` (n, ...), in units of the scale."""
        return (self._product @ fields.reshape(len(fields), -1)).reshape(fields.shape)

    @cached_property
    def _snapshots(self) -> tuple[np.ndarray, np.ndarray]:
        """Deviations (c, n, 3) and slopes (c, p, n, 3) in position, in units of the scale."""
        scene, runs, s = self.scene, self.runs, self.scales.displacement
        free = ~scene.held
        deviations = np.where(free, np.asarray(runs.displacement - runs.displacement[0]), 0.0)
        jacobian = np.asarray(jax.vmap(jax.jacfwd(scene.from_unit))(scene.to_unit(runs.theta)))
        slopes = np.einsum("cpna,cpq->cqna", np.asarray(runs.sensitivities), jacobian)
        return deviations / s, np.where(free, slopes, 0.0) / s

    @cached_property
    def targets(self) -> jax.Array:
        """The modes to learn, (n, 3, r); zero beyond the rank of the snapshots."""
        deviations, slopes = self._snapshots
        n, most = deviations.shape[1], self.network.architecture.modes
        rows = np.concatenate([deviations, np.sqrt(self.slopes) * slopes.reshape(-1, n, 3)])
        rows = np.moveaxis(rows / np.sqrt(len(deviations)), 0, -1)
        weighted = np.asarray(jax.jit(self.weighted)(jnp.asarray(rows)))
        flat = rows.reshape(3 * n, -1)
        energies, vectors = np.linalg.eigh(flat.T @ weighted.reshape(3 * n, -1))
        order = np.argsort(energies)[::-1][:most]
        modes = (flat @ vectors[:, order]).reshape(n, 3, -1)
        modes = np.where(energies[order] > _ZERO * energies.max(), modes, 0.0)
        return jnp.asarray(np.pad(modes, ((0, 0), (0, 0), (0, most - len(order)))))

    @cached_property
    def _weighted_targets(self) -> jax.Array:
        """K times the targets, (n, 3, r)."""
        return jax.jit(self.weighted)(self.targets)

    @cached_property
    def _components(self) -> list[tuple[list[int], jax.Array]]:
        """Components that are fixed at the same nodes, with 1 at their free nodes, (n, 1)."""
        free = (~self.scene.held).astype(float)
        _, kind = np.unique(free, axis=1, return_inverse=True)
        groups = [[int(k) for k in np.flatnonzero(kind == g)] for g in np.unique(kind)]
        return [(group, jnp.asarray(free[:, group[:1]])) for group in groups]

    def _hidden(self, weights: Weights) -> jax.Array:
        """Return H (n, h): the trunk's last hidden layer and a column of ones."""
        network = nnx.merge(self.network.definition, weights)
        H = network.decoder.trunk.hidden(network.processor(self.network.graph)).astype(float)
        return jnp.concatenate([H, jnp.ones((len(H), 1))], axis=1)

    def _project(self, H: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Return the last layer (h, 3, r), the relative misfit, and its derivative in H (n, h)."""
        W = jnp.zeros((H.shape[1], 3, self.targets.shape[-1]))
        misfit, derivative, size = jnp.zeros(()), jnp.zeros_like(H), jnp.zeros(())
        for components, free in self._components:
            features = free * H
            targets = self.targets[:, components].reshape(len(H), -1)
            weighted_features = free * self.weighted(features)
            weighted_targets = free * self._weighted_targets[:, components].reshape(len(H), -1)
            w = _with_ridge(features.T @ weighted_features, weighted_features.T @ targets)
            weighted_residual = weighted_targets - weighted_features @ w
            misfit += jnp.vdot(targets - features @ w, weighted_residual)
            size += jnp.vdot(targets, weighted_targets)
            derivative -= 2.0 * (weighted_residual @ w.T)
            W = W.at[:, jnp.array(components)].set(w.reshape(len(w), len(components), -1))
        return W, misfit / size, derivative / size

    def _with_solved_layer(self, weights: Weights) -> Weights:
        return self._with_last_layer(weights, self._project(self._hidden(weights))[0])

    def _with_last_layer(self, weights: Weights, W: jax.Array, *, branch: bool = False) -> Weights:
        """Return ``weights`` with W (h, ...) as the last layer of the trunk, or of the branch."""
        copy = jax.tree.map(lambda w: w, weights)  # not the caller's variables
        network = nnx.merge(self.network.definition, copy)
        last = (network.decoder.branch if branch else network.decoder.trunk).layers[-1]
        flat = W.reshape(len(W), -1).astype(jnp.float32)
        last.kernel.set_value(flat[:-1])
        last.bias.set_value(flat[-1])
        return nnx.state(network)

    def descend(self, weights: Weights, number: jax.Array) -> tuple[jax.Array, Weights, Weights]:
        """Return the modes' misfit, its gradient, and the weights that both belong to."""
        del number  # every step takes all runs
        H, back = jax.vjp(self._hidden, weights)
        W, misfit, derivative = self._project(H)
        # The logarithm's gradient keeps its size while the misfit falls by many decades.
        (gradient,) = back(derivative / misfit)
        return misfit, gradient, self._with_last_layer(weights, W)

    def branch_targets(self, weights: Weights) -> BranchTargets:
        """Return the snapshots' coefficients in the modes of ``weights``."""
        deviations, slopes = self._snapshots
        prepared = jax.jit(lambda w: self.network.prepare(w)[1])(weights)
        free = ~self.scene.held
        modes = np.moveaxis(np.asarray(prepared, dtype=float) * free, 0, -1)  # (n, 3, r)
        weighted = np.asarray(jax.jit(self.weighted)(jnp.asarray(modes)))
        flat, weighted = (fields.reshape(-1, modes.shape[-1]) for fields in (modes, weighted))
        products = flat.T @ weighted
        # Modes beyond the rank of the snapshots are zero.
        safe = products + _ZERO * np.trace(products) * np.eye(len(products))

        def coefficients(fields: np.ndarray) -> jax.Array:
            right = fields.reshape(-1, len(flat)) @ weighted
            solution = scipy.linalg.solve(safe, right.T, assume_a="pos").T
            return jnp.asarray(solution.reshape(*fields.shape[:-2], -1))

        return BranchTargets(coefficients(deviations), coefficients(slopes), jnp.asarray(products))

    def _branch_rows(self, branch: MLP, targets: BranchTargets) -> tuple[jax.Array, jax.Array]:
        """Return h (s, h) and the targets of h B (s, r): values, then weighted slopes."""

        def hidden(position: jax.Array) -> jax.Array:
            return jnp.append(branch.hidden(self.network.normalise(position)), 1.0)

        x = self.scene.to_unit(self.runs.theta)
        values, slopes = jax.vmap(lambda x: (hidden(x), jax.jacfwd(hidden)(x)))(x)

        def rows(values: jax.Array, slopes: jax.Array) -> jax.Array:
            flat = slopes.reshape(-1, values.shape[1])
            return jnp.concatenate([values, np.sqrt(self.slopes) * flat]).astype(float)

        return rows(values, jnp.swapaxes(slopes, 1, 2)), rows(targets.values, targets.slopes)

    def _fit_branch(self, weights: Weights, targets: BranchTargets) -> tuple[jax.Array, jax.Array]:
        """Return the branch's last layer B (h, r), solved for, and the relative misfit, ().

        The misfit's derivative goes through B: because of the ridge, B is not quite its minimum.
        """
        branch = nnx.merge(self.network.definition, weights).decoder.branch
        features, wanted = self._branch_rows(branch, targets)
        B = _with_ridge(features.T @ features, features.T @ wanted)
        return B, targets.misfit(features @ B, wanted)

    def finish(self, iterations: int, deadline: float, weights: Weights, progress: bool) -> Weights:
        """Return ``weights`` with both last layers solved for and the branch fitted by L-BFGS.

        It ends where the misfit no longer falls, by round-off or by a line search that failed, or
        at the ``deadline`` on the performance counter.
        """
        weights = jax.jit(self._with_solved_layer)(weights)
        targets = self.branch_targets(weights)
        single, rest = nnx.split_state(weights, lambda path, _: "branch" in path, ...)
        branch = jax.tree.map(lambda w: w.astype(float), single)  # for the line search

        def misfit(branch: Any) -> jax.Array:
            return jnp.log(self._fit_branch(nnx.merge_state(rest, branch), targets)[1])

        solver = optax.lbfgs(memory_size=_MEMORY)
        both = optax.value_and_grad_from_state(misfit)

        def iterate(carry: Any, _: None) -> tuple[Any, jax.Array]:
            branch, state = carry
            value, gradient = both(branch, state=state)
            updates, state = solver.update(
                gradient, state, branch, value=value, grad=gradient, value_fn=misfit
            )
            return (optax.apply_updates(branch, updates), state), value

        many = jax.jit(lambda carry: jax.lax.scan(iterate, carry, None, length=_AT_ONCE))
        carry, measure = (branch, solver.init(branch)), jax.jit(misfit)
        best_branch, least = branch, float(measure(branch))
        with counting(desc="fit of coefficients", total=iterations, disable=not progress) as bar:
            for _ in range(iterations // _AT_ONCE):
                carry, _ = many(carry)
                value = float(measure(carry[0]))
                if not value < least:
                    break
                best_branch, least = carry[0], value
                bar.update(_AT_ONCE)
                bar.set_postfix_str(f"misfit {np.exp(0.5 * least):.1e} of their size")
                if time.perf_counter() > deadline:
                    break
        single = jax.tree.map(lambda w: w.astype(jnp.float32), best_branch)
        weights = nnx.merge_state(rest, single)
        B, _ = jax.jit(self._fit_branch)(weights, targets)
        return self._with_last_layer(weights, B, branch=True)


def _with_ridge(gram: jax.Array, right: jax.Array) -> jax.Array:
    """Return the solution (h, k) of normal equations, ``gram`` (h, h) with a little ridge."""
    ridge = _RIDGE * jnp.trace(gram) / len(gram) * jnp.eye(len(gram))
    return jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(gram + ridge), right)


class BlockedMatrix(NamedTuple):
    """A sparse matrix (n, n) whose product with many columns is a few dense products.

    Rows are taken in blocks of neighbours (reverse Cuthill-McKee), each with the columns in which
    it has entries. A row of a mesh's matrix shares most of them with its neighbours, so that a
    tenth of a block is nonzero and the product runs at the speed of dense ones.

    columns : the columns of each block, (b, w), filled up with 0.
    values : the entries of the blocks, (b, rows, w).
    order : the position of each row among the rows of the blocks, (n,).
    """

    columns: jax.Array
    values: jax.Array
    order: jax.Array

    @classmethod
    def of(cls, matrix: sp.csr_matrix) -> Self:
        """Return a symmetric ``matrix`` (n, n) in blocks."""
        permutation = reverse_cuthill_mckee(matrix, symmetric_mode=True)
        groups = [permutation[k : k + _ROWS] for k in range(0, len(permutation), _ROWS)]
        column_numbers = [np.unique(matrix[rows].indices) for rows in groups]
        width = max(map(len, column_numbers))
        columns = np.zeros((len(groups), width), dtype=np.int32)
        values = np.zeros((len(groups), _ROWS, width))
        for k, (rows, present) in enumerate(zip(groups, column_numbers, strict=True)):
            columns[k, : len(present)] = present
            values[k, : len(rows), : len(present)] = matrix[rows][:, present].toarray()
        order = np.argsort(permutation, kind="stable")
        return cls(*map(jnp.asarray, (columns, values, order)))

    def __matmul__(self, fields: jax.Array) -> jax.Array:
        """Return the matrix times ``fields`` (n, k)."""
        rows = jax.lax.map(lambda block: block[1] @ fields[block[0]], (self.columns, self.values))
        return rows.reshape(-1, fields.shape[1])[self.order]
