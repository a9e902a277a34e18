r"""A separable network taught its modes first, by variable projection, then their coefficients.

What it is taught are *snapshots*: of every FEM run i the displacement less the centre's, and the
slopes along the axes of the unit box, which its tangent gives for a tenth of a run,

.. math:: d_i = u_i - u_c, \qquad d_{ij} = \sqrt{\gamma}\; \partial u_i / \partial x_j,

in the inner product of the objective ``gradients`` (F-DD),

.. math:: \langle v, w \rangle = \frac1{n s^2} \sum_\text{nodes} v \cdot w
    + \frac1{|\Omega| s_F^2} \int_\Omega \nabla v : \nabla w \, dX .

**Modes.** The eigenvectors of the snapshots' Gram matrix, each as long as the root of its
eigenvalue, are the targets :math:`t_k`. A mode is linear in the last layer of the trunk,
:math:`\varphi_k = H w_k`, with H (n, h) the trunk's last hidden layer and a column of ones. So
:math:`w_k` is not searched but solved for, at every step (Golub and Pereyra 1973), and only the
processor and the trunk below descend: since w minimises, the derivative of

.. math:: \min_w \sum_k |t_k - H w_k|^2 \quad\text{with respect to } H \text{ is }\quad
    -2 \sum_k K (t_k - H w_k)\, w_k^T

with w held, K the matrix of the inner product. No theta enters: a step costs one processor pass.
Steps are as long in every direction of a layer's weights
(:func:`~emulator.training.step.orthogonal_steps`).

**Coefficients.** The modes are kept, the snapshots projected on them, and the branch is fitted to
values and slopes of all runs at once,

.. math:: \frac1c \sum_i \Big[ |c(x_i) - a_i|_G^2
    + \gamma \sum_j |\partial_j c(x_i) - a_{ij}|_G^2 \Big], \qquad
    G_{kl} = \langle \varphi_k, \varphi_l \rangle,

by Adam and then by L-BFGS.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import scipy.linalg
import scipy.sparse as sp
from flax import nnx

from emulator.core.progress import counting
from emulator.fem.campaign import Runs
from emulator.scenes.scene import Scene
from emulator.surrogates.network.part import Network
from emulator.surrogates.network.pignn import Architecture
from emulator.training.blocked import Blocked
from emulator.training.objectives import Scales
from emulator.training.step import in_branch

ARCHITECTURE = Architecture(
    steps=3,
    latent=24,
    hidden=(64, 64),
    decoder="separable",
    modes=40,
    trunk=(64, 512),
    branch=(128, 128, 128),
)
"""Smaller messages than the paper's, a wide last layer of the trunk, which costs a least-squares
solve, and a deep branch (docs/experiments.md, "A network alone")."""

_SLOPES = 0.1  # gamma: positions have a variance of 1/12 in the unit box
_RIDGE = 1e-9  # of the mean square of the hidden layer; weights beyond are noise in float32
_ZERO = 1e-12  # of the sum of the modes' squares
_MEMORY = 20  # steps that L-BFGS remembers
_AT_ONCE = 50  # of its iterations, between two looks at the progress

Weights = nnx.State


class Taught(NamedTuple):
    """What the branch is fitted to.

    modes : (r, n, 3) in units of the network's scale. values : (c, r). slopes : (c, p, r).
    products : (r, r), of the modes.
    """

    modes: jax.Array
    values: jax.Array
    slopes: jax.Array
    products: jax.Array


@dataclass(frozen=True, eq=False)
class Modal:
    """Teaches ``network`` of ``scene`` the runs, whose sensitivities are needed.

    scales : s and s_F of the inner product; s is the network's scale, too.
    slopes : gamma above.
    """

    scene: Scene
    network: Network
    runs: Runs
    scales: Scales
    slopes: float = _SLOPES

    def __post_init__(self) -> None:
        # Now, because what is first wanted inside jit would be traced there.
        self._product, self._groups, self._pulled  # noqa: B018

    @cached_property
    def _product(self) -> Blocked:
        """K (n, n)."""
        n, rule = len(self.scene.mesh.nodes), self.scene.discretisation
        weight = (self.scales.displacement / self.scales.gradient) ** 2 / rule.weights.sum()
        return Blocked.of(sp.csr_matrix(weight * rule.laplacian() + sp.identity(n) / n))

    def weighted(self, fields: jax.Array) -> jax.Array:
        """K times ``fields`` (n, ...), in units of the scale."""
        return (self._product @ fields.reshape(len(fields), -1)).reshape(fields.shape)

    @cached_property
    def _snapshots(self) -> tuple[np.ndarray, np.ndarray]:
        """Deviations (c, n, 3) and slopes (c, p, n, 3) by position, in units of the scale."""
        scene, runs, s = self.scene, self.runs, self.scales.displacement
        position = jax.vmap(scene.to_unit)(runs.theta)
        jacobian = np.asarray(jax.vmap(jax.jacfwd(scene.from_unit))(position))
        free = ~scene.held
        deviations = np.where(free, np.asarray(runs.displacement - runs.displacement[0]), 0.0)
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
        found = (flat @ vectors[:, order]).reshape(n, 3, -1)
        found = np.where(energies[order] > _ZERO * energies.max(), found, 0.0)
        return jnp.asarray(np.pad(found, ((0, 0), (0, 0), (0, most - len(order)))))

    @cached_property
    def _pulled(self) -> jax.Array:
        """K times the targets, (n, 3, r)."""
        return jax.jit(self.weighted)(self.targets)

    @cached_property
    def _groups(self) -> list[tuple[list[int], jax.Array]]:
        """Components held at the same nodes, with 1 at their free ones (n, 1)."""
        free = (~self.scene.held).astype(float)
        _, kind = np.unique(free, axis=1, return_inverse=True)
        groups = [[int(k) for k in np.flatnonzero(kind == g)] for g in np.unique(kind)]
        return [(group, jnp.asarray(free[:, group[:1]])) for group in groups]

    def _hidden(self, weights: Weights) -> jax.Array:
        """H (n, h): the trunk's last hidden layer and a column of ones."""
        network = nnx.merge(self.network.definition, weights)
        H = network.decoder.features(network.processor(self.network.graph)).astype(float)
        return jnp.concatenate([H, jnp.ones((len(H), 1))], axis=1)

    def _project(self, H: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Last layer (h, 3, r), its misfit as a part of the targets', and the derivative in H."""
        W = jnp.zeros((H.shape[1], 3, self.targets.shape[-1]))
        misfit, pull, size = jnp.zeros(()), jnp.zeros_like(H), jnp.zeros(())
        for components, free in self._groups:
            mine, wanted = free * H, self.targets[:, components].reshape(len(H), -1)
            weighted = free * self.weighted(mine)
            pulled = free * self._pulled[:, components].reshape(len(H), -1)
            gram = mine.T @ weighted
            gram += _RIDGE * jnp.trace(gram) / len(gram) * jnp.eye(len(gram))
            factor = jax.scipy.linalg.cho_factor(gram)
            w = jax.scipy.linalg.cho_solve(factor, weighted.T @ wanted)
            force = pulled - weighted @ w  # of what is left
            misfit += jnp.vdot(wanted - mine @ w, force)
            size += jnp.vdot(wanted, pulled)
            pull -= 2.0 * (force @ w.T)
            W = W.at[:, jnp.array(components)].set(w.reshape(len(gram), len(components), -1))
        return W, misfit / size, pull / size

    def _settled(self, weights: Weights) -> Weights:
        """``weights`` with the last layer solved for."""
        return self._with_last(weights, self._project(self._hidden(weights))[0])

    def _with_last(self, weights: Weights, W: jax.Array) -> Weights:
        network = nnx.merge(self.network.definition, weights)
        last = network.decoder.trunk.layers[-1]
        flat = W.reshape(len(W), -1).astype(jnp.float32)
        last.kernel.set_value(flat[:-1])
        last.bias.set_value(flat[-1])
        return nnx.state(network)

    def descend(
        self, weights: Weights, number: jax.Array, *kept: jax.Array
    ) -> tuple[jax.Array, Weights, Weights]:
        """Misfit, its gradient, and the weights it is of; with ``kept``, of the branch alone."""
        del number  # every step sees all runs
        if kept:
            value, gradient = jax.value_and_grad(self._branch_misfit)(weights, Taught(*kept))
            return value, gradient, weights
        H, back = jax.vjp(self._hidden, weights)
        W, misfit, pull = self._project(H)
        # Of the logarithm: the misfit falls by many decades, and so would the gradient.
        (gradient,) = back(pull / misfit)
        return misfit, gradient, self._with_last(weights, W)

    def keep(self, weights: Weights) -> Taught:
        """The modes of ``weights`` and the snapshots' coefficients in them."""
        deviations, slopes = self._snapshots
        kept = jax.jit(lambda w: self.network.prepare(self._settled(w))[1])(weights)
        free = ~self.scene.held
        modes = np.moveaxis(np.asarray(kept, dtype=float) * free, 0, -1)  # (n, 3, r)
        weighted = np.asarray(jax.jit(self.weighted)(jnp.asarray(modes)))
        flat, weighted = (fields.reshape(-1, modes.shape[-1]) for fields in (modes, weighted))
        products = flat.T @ weighted
        # Modes beyond the rank of the snapshots are zero.
        safe = products + _ZERO * np.trace(products) * np.eye(len(products))

        def coefficients(fields: np.ndarray) -> jax.Array:
            pulled = fields.reshape(-1, len(flat)) @ weighted
            found = scipy.linalg.solve(safe, pulled.T, assume_a="pos").T
            return jnp.asarray(found.reshape(*fields.shape[:-2], -1), dtype=jnp.float32)

        values, along = coefficients(deviations), coefficients(slopes)
        return Taught(kept, values, along, jnp.asarray(products, dtype=jnp.float32))

    def _branch_misfit(self, weights: Weights, taught: Taught) -> jax.Array:
        """The misfit of the coefficients as a part of the snapshots', ()."""
        decoder = nnx.merge(self.network.definition, weights).decoder

        def branch(position: jax.Array) -> jax.Array:
            return decoder.coefficients(self.network.normalise(position))

        x = self.scene.to_unit(self.runs.theta)
        value, slope = jax.vmap(lambda x: (branch(x), jax.jacfwd(branch)(x)))(x)
        squares = lambda e: jnp.sum((e @ taught.products) * e)  # noqa: E731
        left = squares(value - taught.values)
        left += self.slopes * squares(jnp.swapaxes(slope, 1, 2).astype(jnp.float32) - taught.slopes)
        return left / (squares(taught.values) + self.slopes * squares(taught.slopes))

    def finish(self, weights: Weights, iterations: int, *, progress: bool = False) -> Weights:
        """``weights`` with the last layer solved for and the branch led on by L-BFGS."""
        weights = jax.jit(self._settled)(weights)
        taught = self.keep(weights)
        branch, joined = _split(weights)

        def misfit(branch: Any) -> jax.Array:
            return self._branch_misfit(joined(branch), taught)

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
        best, least = branch, float(measure(branch))
        with counting(desc="L-BFGS", total=iterations, disable=not progress) as bar:
            for _ in range(iterations // _AT_ONCE):
                carry, _ = many(carry)
                now = float(measure(carry[0]))
                if not now < least:  # round-off is all that is left, or a line search that failed
                    break
                best, least = carry[0], now
                bar.update(_AT_ONCE)
                bar.set_postfix(loss=f"{least:.3e}")
        return joined(best)


def _split(weights: Weights) -> tuple[list[jax.Array], Callable[[list[jax.Array]], Weights]]:
    """Weights of the branch, and what puts them back among the others."""
    leaves, structure = jax.tree_util.tree_flatten_with_path(weights)
    mine = [in_branch(path) for path, _ in leaves]

    def joined(branch: list[jax.Array]) -> Weights:
        new = iter(branch)
        values = [next(new) if own else leaf for own, (_, leaf) in zip(mine, leaves, strict=True)]
        return jax.tree.unflatten(structure, values)

    return [leaf for own, (_, leaf) in zip(mine, leaves, strict=True) if own], joined
