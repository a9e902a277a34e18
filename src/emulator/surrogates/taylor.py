r"""The equilibrium as a Taylor series in the parameters, from one FEM solution and one factor.

Along :math:`x` (theta's position in its box) the equilibrium satisfies
:math:`r(u(x), x) = 0` identically. Differentiating once, twice, three times,

.. math::
    K u_{,a} = -r_{,a}, \qquad
    K u_{,ab} = -\left.\partial^2_{\epsilon_1 \epsilon_2}
        r(u_0 + \epsilon_1 u_{,a} + \epsilon_2 u_{,b},\;
          x_0 + \epsilon_1 e_a + \epsilon_2 e_b)\right|_0

and so on with the path's own mixed terms. Every order uses the tangent :math:`K` of the first, so
beyond one solve a series costs residuals differentiated along paths, and back-substitutions. On a
ventricle with five parameters, over the whole box, orders 1, 2, 3 and 4 leave a median error of
0.20, 0.047, 0.010 and 0.003 mm; at the corners, near the series' radius of convergence, the error
is much larger.

Where the displacement is a sum, as of a body whose mesh is loaded (:mod:`emulator.fem.loaded`), the
terms of each summand follow from the terms of earlier summands.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import combinations, combinations_with_replacement
from math import comb, factorial, prod
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from emulator.core.errors import InputError, SolverError
from emulator.fem.assembly import System
from emulator.fem.compiled import compiled
from emulator.fem.derivatives import Equations
from emulator.fem.simulator import Simulator
from emulator.fem.unloading import Unloader
from emulator.surrogates.part import ArrayPart, CachedPart

Terms = dict[tuple[int, ...], np.ndarray]
"""Derivatives (n, 3) mm by the parameters in which they are taken, in order."""

_MOST_TERMS = 200  # in one order; 18 parameters have 171 of order 2 and 1140 of order 3


@dataclass(frozen=True, eq=False)
class Expansion(ArrayPart):
    """Taylor series of a scene's equilibrium about one theta, a part of an emulator.

    centre : the position in the unit box about which the series is taken, (p,).
    displacement : the equilibrium at the centre, (n, 3) mm.
    indices : the parameters in which each term is differentiated, -1 for none, (t, order); sorted
        by order.
    derivatives : the derivatives with respect to position, (t, n, 3) mm.
    """

    centre: np.ndarray
    displacement: jax.Array
    indices: np.ndarray
    derivatives: jax.Array

    def monomials(self, position: jax.Array) -> jax.Array:
        """Return the factor of each derivative at ``position`` (..., p), shape (..., t)."""
        return monomials(self.indices, position - self.centre)

    def __call__(self, position: jax.Array) -> jax.Array:
        """Return the displacement (..., n, 3) mm at ``position`` (..., p) in the unit box."""
        return self.displacement + jnp.tensordot(self.monomials(position), self.derivatives, axes=1)

    @property
    def order(self) -> int:
        """Order of the highest derivative."""
        return int(np.max(np.sum(self.indices >= 0, axis=1), initial=0))

    def cache(self, nodes: np.ndarray) -> CachedPart:
        """Return the series over ``nodes`` (k,): its derivatives are the modes."""
        offset, modes = np.asarray(self.displacement)[nodes], np.asarray(self.derivatives)[:, nodes]
        return CachedPart(offset, modes, self.monomials)

    def less(self, part: CachedPart) -> Expansion:
        """Subtract the series of ``part`` about this centre, over all nodes.

        Added to the part, it has the same derivatives there as FEM.
        """
        derivative, centre = part.coefficients, jnp.asarray(self.centre)
        known: Terms = {(): np.asarray(derivative(centre))}
        for degree in range(1, self.order + 1):
            derivative = jax.jacfwd(derivative)
            tensor = np.moveaxis(np.asarray(jax.jit(derivative)(centre)), 0, -1)
            for term in combinations_with_replacement(range(len(centre)), degree):
                known[term] = tensor[term]
        modes = np.asarray(part.modes)
        fields = [
            np.tensordot(known[tuple(int(k) for k in row if k >= 0)], modes, axes=1)
            for row in self.indices
        ]
        return replace(
            self,
            displacement=self.displacement - part.offset - np.tensordot(known[()], modes, axes=1),
            derivatives=self.derivatives - np.stack(fields) if fields else self.derivatives,
        )

    def rounded(self) -> Expansion:
        """Return the series rounded to float32, so that a file of half the size loses nothing."""
        u, derivatives = rounded(self.displacement), rounded(self.derivatives)
        return replace(self, displacement=u, derivatives=derivatives)


def rounded(array: jax.Array) -> jax.Array:
    """Return the array in float64, its numbers rounded to float32."""
    return array.astype(jnp.float32).astype(jnp.float64)


def constant(position: np.ndarray, displacement: jax.Array) -> Expansion:
    """Return the series of order 0: ``displacement`` (n, 3) everywhere."""
    return Expansion(
        np.asarray(position),
        jnp.asarray(displacement),
        np.zeros((0, 1), dtype=int),
        jnp.zeros((0, *displacement.shape)),
    )


def monomials(indices: np.ndarray, step: jax.Array) -> jax.Array:
    """Return the Taylor monomials (..., t) of ``step`` (..., p), divided by the factorials.

    The term of ``u,aab`` is ``s_a s_a s_b / (2! 1!)``: each multi-index stands once.
    """
    if not len(indices):
        return jnp.zeros((*step.shape[:-1], 0))
    ones = jnp.ones((*step.shape[:-1], 1))
    powers = jnp.concatenate([step, ones], axis=-1)[..., indices]  # index -1 is the one
    counts = [np.unique(row[row >= 0], return_counts=True)[1] for row in indices]
    factorials = np.array([prod(map(factorial, c)) for c in counts], dtype=float)
    return jnp.prod(powers, axis=-1) / factorials


def expand(
    simulator: Simulator | Unloader, theta: jax.Array | None = None, order: int = 3
) -> Expansion:
    """Return the Taylor series of the equilibrium about ``theta`` (p,), by default the centre.

    Parameters
    ----------
    simulator : the simulator, or an ``Unloader`` for the series of the stress-free shape.
    order : the order, 1 to 4; the series stops before an order with more than 200 terms.

    Raises
    ------
    InputError
        ``order`` is another, or ``theta`` has the wrong shape.
    SolverError
        No equilibrium was found at ``theta``, or it has no derivatives.
    """
    theta = simulator.scene.centre if theta is None else theta
    u = simulator.solve(theta).require_converged("the expansion's centre").displacement
    return expand_at(simulator, u, theta, order)


def expand_at(
    simulator: Simulator | Unloader, u: jax.Array, theta: jax.Array, order: int
) -> Expansion:
    """Return :func:`expand` about a known equilibrium ``u`` (n, 3) mm at ``theta`` (p,)."""
    if order not in (1, 2, 3, 4):
        raise InputError(f"expansion of order {order}; give 1 to 4")
    scene, theta, u = simulator.scene, jnp.asarray(theta, dtype=float), jnp.asarray(u, dtype=float)
    position = scene.to_unit(theta)
    chain = simulator.equations(u, theta)
    count = len(position)
    known: list[Terms] = [{} for _ in chain]
    for degree in range(1, order + 1):
        if comb(count + degree - 1, degree) > _MOST_TERMS:
            break
        terms = list(combinations_with_replacement(range(count), degree))
        for k, equations in enumerate(chain):
            system = equations.system
            forces, prescribed = _forces(chain[: k + 1], position, terms, known)
            derivatives = np.add(_solve(system, equations.tangent, forces), prescribed)
            if not np.isfinite(derivatives).all():
                raise SolverError(
                    f"scene '{scene.name}': derivatives of order {degree} in theta are not finite"
                )
            known[k].update(zip(terms, derivatives, strict=True))
    if not known[0]:
        return constant(np.asarray(position), u)
    indices = np.array([[*term, *(-1,) * (order - len(term))] for term in known[0]])
    total = sum(np.stack(list(h.values())) for h in known)
    return Expansion(np.asarray(position), u, indices, jnp.asarray(total))


@compiled
def _solve(system: System, tangent: jax.Array, forces: jax.Array) -> jax.Array:
    """Return the responses (t, n, 3) to ``forces`` (t, f)."""
    return jax.vmap(system.extend, in_axes=1)(-system.solve(tangent, forces.T))


def _forces(
    chain: tuple[Equations, ...],
    position: jax.Array,
    terms: list[tuple[int, ...]],
    known: list[Terms],
) -> tuple[jax.Array, jax.Array]:
    """Return the mixed derivative (t, f) of the last residual of ``chain`` along each path.

    The path leaves out the term itself; the terms before it are in ``known``. The second result is
    the derivative of prescribed displacements, (t, n, 3), or zeros (t, 1, 1) where theta moves no
    support. Terms are taken one by one (``lax.map``): the paths of all would not fit into memory.
    """
    degree, last = len(terms[0]), chain[-1]
    scene = last.system.scene
    # The path holds one term for every proper subset of the multi-index, and those of the
    # displacements also one for the full multi-index.
    proper = [s for size in range(1, degree) for s in combinations(range(degree), size)]
    with_full_index = [*proper, tuple(range(degree))]
    subsets = [with_full_index if equations is not last else proper for equations in chain]
    paths = [_places(terms, parts, here) for parts, here in zip(subsets, known, strict=False)]
    nothing = np.zeros((0, *last.u.shape))
    fields = [np.stack(list(h.values())) if h else nothing for h in known[: len(chain)]]
    moving = bool(scene.prescribed.per_unit)

    def one(
        argument: tuple[jax.Array, list[jax.Array]], fields: Any
    ) -> tuple[jax.Array, jax.Array]:
        directions, paths = argument

        def along(*steps: jax.Array) -> tuple[jax.Array, jax.Array]:
            displacements = []
            for equations, parts, path, values in zip(chain, subsets, paths, fields, strict=True):
                v = equations.u
                for part, place in zip(parts, path, strict=True):
                    v = v + prod((steps[k] for k in part), start=jnp.ones(())) * values[place]
                displacements.append(v)
            x = position + sum(s * d for s, d in zip(steps, directions, strict=True))
            theta = scene.from_unit(x)
            if not moving:
                return last.residual(theta, *displacements), jnp.zeros((1, 1))
            v = scene.on_supports(displacements[-1], theta)
            return last.residual(theta, *displacements[:-1], v), jnp.where(scene.held, v, 0.0)

        return _mixed_derivative(along, degree)()

    directions = np.stack([np.eye(len(position))[list(term)] for term in terms])
    return jax.jit(lambda d, p, k: jax.lax.map(lambda argument: one(argument, k), (d, p)))(
        directions, paths, fields
    )


def _places(terms: list[tuple[int, ...]], parts: list[tuple[int, ...]], known: Terms) -> np.ndarray:
    """Return the indices (t, parts) in ``known`` of the derivatives in each part of each term."""
    places = {term: k for k, term in enumerate(known)}
    rows = [[places[tuple(term[k] for k in part)] for part in parts] for term in terms]
    return np.array(rows, dtype=int).reshape(len(terms), len(parts))


def _mixed_derivative(function: Callable[..., Any], degree: int) -> Callable[[], Any]:
    """Return the derivative of ``function`` once in each of its ``degree`` scalars, at zero."""
    if degree == 0:
        return function
    derivative = lambda *rest: jax.jvp(  # noqa: E731
        lambda last: function(*rest, last), (jnp.zeros(()),), (jnp.ones(()),)
    )[1]
    return _mixed_derivative(derivative, degree - 1)
