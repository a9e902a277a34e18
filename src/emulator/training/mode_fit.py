r"""Fitting a separable network: its modes by variable projection, then their coefficients.

The network is fitted to *snapshots*: of every FEM run i the displacement less the centre's, and the
slopes along the axes of the unit box, which its tangent gives for a tenth of a run,

.. math:: d_i = u_i - u_c, \qquad d_{ij} = \sqrt{\gamma}\; \partial u_i / \partial x_j,

in the inner product of the objective ``gradients`` (F-DD),

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

**Coefficients.** The modes are frozen, the snapshots projected on them, and the branch is fitted to
values and slopes of all runs at once,

.. math:: \frac1c \sum_i \Big[ |c(x_i) - a_i|_G^2
    + \gamma \sum_j |\partial_j c(x_i) - a_{ij}|_G^2 \Big], \qquad
    G_{kl} = \langle \varphi_k, \varphi_l \rangle,

by Adam and then by L-BFGS.
"""

from __future__ import annotations

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
from emulator.training.objectives import Scales
from emulator.training.optimiser import Weights

_SLOPES = 0.1  # gamma: positions have a variance of 1/12 in the unit box
_RIDGE = 1e-9  # over the hidden layer's mean square; larger weights are noise in float32
_ZERO = 1e-12  # relative to the sum of the modes' squares
_MEMORY = 20  # steps that L-BFGS remembers
_AT_ONCE = 50  # iterations of L-BFGS between two evaluations of the misfit
_ROWS = 32  # rows of a block of the product, by trial


class BranchTargets(NamedTuple):
    """The coefficients to which the branch is fitted.

    modes : the frozen modes, (r, n, 3) in units of the network's scale.
    values, slopes : the snapshots' coefficients in them, (c, r) and (c, p, r).
    products : the inner products of the modes, (r, r).
    """

    modes: jax.Array
    values: jax.Array
    slopes: jax.Array
    products: jax.Array


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
            gram = features.T @ weighted_features
            gram += _RIDGE * jnp.trace(gram) / len(gram) * jnp.eye(len(gram))
            factor = jax.scipy.linalg.cho_factor(gram)
            w = jax.scipy.linalg.cho_solve(factor, weighted_features.T @ targets)
            weighted_residual = weighted_targets - weighted_features @ w
            misfit += jnp.vdot(targets - features @ w, weighted_residual)
            size += jnp.vdot(targets, weighted_targets)
            derivative -= 2.0 * (weighted_residual @ w.T)
            W = W.at[:, jnp.array(components)].set(w.reshape(len(gram), len(components), -1))
        return W, misfit / size, derivative / size

    def _with_solved_layer(self, weights: Weights) -> Weights:
        return self._with_last_layer(weights, self._project(self._hidden(weights))[0])

    def _with_last_layer(self, weights: Weights, W: jax.Array) -> Weights:
        network = nnx.merge(self.network.definition, weights)
        last = network.decoder.trunk.layers[-1]
        flat = W.reshape(len(W), -1).astype(jnp.float32)
        last.kernel.set_value(flat[:-1])
        last.bias.set_value(flat[-1])
        return nnx.state(network)

    def descend(
        self, weights: Weights, number: jax.Array, *frozen: jax.Array
    ) -> tuple[jax.Array, Weights, Weights]:
        """Return the misfit, its gradient, and the weights that both belong to.

        frozen : the entries of :class:`BranchTargets`; with them, the misfit is the branch's alone.
        """
        del number  # every step takes all runs
        if frozen:
            targets = BranchTargets(*frozen)
            value, gradient = jax.value_and_grad(self._branch_misfit)(weights, targets)
            return value, gradient, weights
        H, back = jax.vjp(self._hidden, weights)
        W, misfit, derivative = self._project(H)
        # The logarithm's gradient keeps its size while the misfit falls by many decades.
        (gradient,) = back(derivative / misfit)
        return misfit, gradient, self._with_last_layer(weights, W)

    def branch_targets(self, weights: Weights) -> BranchTargets:
        """Return the modes of ``weights`` and the snapshots' coefficients in them."""
        deviations, slopes = self._snapshots
        prepared = jax.jit(lambda w: self.network.prepare(self._with_solved_layer(w))[1])(weights)
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
            return jnp.asarray(solution.reshape(*fields.shape[:-2], -1), dtype=jnp.float32)

        values, along = coefficients(deviations), coefficients(slopes)
        return BranchTargets(prepared, values, along, jnp.asarray(products, dtype=jnp.float32))

    def _branch_misfit(self, weights: Weights, targets: BranchTargets) -> jax.Array:
        """Return the misfit of the coefficients relative to the snapshots', ()."""
        decoder = nnx.merge(self.network.definition, weights).decoder

        def branch(position: jax.Array) -> jax.Array:
            return decoder.branch(self.network.normalise(position))

        x = self.scene.to_unit(self.runs.theta)
        value, slope = jax.vmap(lambda x: (branch(x), jax.jacfwd(branch)(x)))(x)
        squares = lambda e: jnp.sum((e @ targets.products) * e)  # noqa: E731
        misfit = squares(value - targets.values)
        slope_error = jnp.swapaxes(slope, 1, 2).astype(jnp.float32) - targets.slopes
        misfit += self.slopes * squares(slope_error)
        return misfit / (squares(targets.values) + self.slopes * squares(targets.slopes))

    def finish(self, iterations: int, weights: Weights, progress: bool) -> Weights:
        """Return ``weights`` with the last layer solved for and the branch fitted by L-BFGS.

        It ends where the misfit no longer falls, by round-off or by a line search that failed.
        """
        weights = jax.jit(self._with_solved_layer)(weights)
        targets = self.branch_targets(weights)
        branch, rest = nnx.split_state(weights, lambda path, _: "branch" in path, ...)

        def misfit(branch: Any) -> jax.Array:
            return self._branch_misfit(nnx.merge_state(rest, branch), targets)

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
        with counting(desc="L-BFGS", total=iterations, disable=not progress) as bar:
            for _ in range(iterations // _AT_ONCE):
                carry, _ = many(carry)
                value = float(measure(carry[0]))
                if not value < least:
                    break
                best_branch, least = carry[0], value
                bar.update(_AT_ONCE)
                bar.set_postfix(loss=f"{least:.3e}")
        return nnx.merge_state(rest, best_branch)


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
