r"""Whether a displacement is an equilibrium, judged without the solver's code.

Shape functions, quadrature, strain energies and loads are implemented a second time here, from
textbooks and not from ``emulator``; the force is the derivative of each element's energy. Only the
sign of the tangent, which is additional information, comes from ``emulator``.

An answer with status converged is wrong if it has a displacement that is not finite, a
support not met to the last bit, ``J <= 0`` at a quadrature point, a residual above 1e-6 of the
forces at work, or if a claim of the case fails. A larger residual may be round-off, where strains
are of 1e-9 and less: it is then, if the displacement it stands for is below 1e-6 of the answer's or
below 1e-13 of the body's size.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import sparsax

import emulator as em

TOLERANCE = 1e-6
SMALLEST = 1e-13  # of a body's size, which positions in double precision hardly tell from none
MOST_UNKNOWNS = 2000  # of a tangent that is solved densely
EDGES = ((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3))

# Tetrahedron: the centroid; or four points, exact to degree 2. Weights sum to 1/6.
_A, _B = (5.0 + 3.0 * np.sqrt(5.0)) / 20.0, (5.0 - np.sqrt(5.0)) / 20.0
_POINTS = {
    1: (np.full((1, 3), 0.25), np.array([1.0 / 6.0])),
    2: (np.array([[_A, _B, _B], [_B, _A, _B], [_B, _B, _A], [_B, _B, _B]]), np.full(4, 1.0 / 24.0)),
}
# Triangle: Dunavant's six points, exact to degree 4. Weights sum to 1/2.
_C, _D = 0.445948490915965, 0.091576213509771
_TRIANGLE = np.array(
    [[_C, _C], [1 - 2 * _C, _C], [_C, 1 - 2 * _C], [_D, _D], [1 - 2 * _D, _D], [_D, 1 - 2 * _D]]
)
_TRIANGLE_WEIGHTS = 0.5 * np.array([0.223381589678011] * 3 + [0.109951743655322] * 3)


class UnknownError(Exception):
    """A law or a load that is not implemented here."""


class Judgement(NamedTuple):
    """A judged answer; ``wrong`` says in words what is wrong, and is empty if nothing is.

    independent : whether the force was this file's own; for laws and loads it does not know, it is
        the derivative of the package's energy.
    """

    residual: float
    independent: bool
    smallest_J: float
    wrong: str


def tetrahedron(xi: jax.Array, order: int) -> jax.Array:
    """Shape functions (4,) or (10,) at ``xi`` (3,)."""
    L = jnp.array([1.0 - xi.sum(), xi[0], xi[1], xi[2]])
    if order == 1:
        return L
    return jnp.concatenate([L * (2 * L - 1), jnp.stack([4 * L[a] * L[b] for a, b in EDGES])])


def triangle(xi: jax.Array, order: int) -> jax.Array:
    """Shape functions (3,) or (6,) at ``xi`` (2,)."""
    L = jnp.array([1.0 - xi.sum(), xi[0], xi[1]])
    if order == 1:
        return L
    middles = jnp.stack([4 * L[a] * L[b] for a, b in ((0, 1), (1, 2), (2, 0))])
    return jnp.concatenate([L * (2 * L - 1), middles])


def det(F: jax.Array) -> jax.Array:
    """Determinant of (3, 3) by the rule of Sarrus."""
    return (
        F[0, 0] * (F[1, 1] * F[2, 2] - F[1, 2] * F[2, 1])
        - F[0, 1] * (F[1, 0] * F[2, 2] - F[1, 2] * F[2, 0])
        + F[0, 2] * (F[1, 0] * F[2, 1] - F[1, 1] * F[2, 0])
    )


# ---- strain energies in kPa, from F (3, 3) and the fibre (3,) ----------------------------------
def _neo_hookean(F: jax.Array, _: Any, mu: Any, lam: Any) -> jax.Array:
    ln_J = jnp.log(det(F))
    return 0.5 * mu * (jnp.sum(F * F) - 3.0) - mu * ln_J + 0.5 * lam * ln_J**2


def _neo_hookean_engineering(F: jax.Array, f: Any, E: Any, nu: Any) -> jax.Array:
    return _neo_hookean(F, f, E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu)))


def _holzapfel_ogden(F: jax.Array, f: Any, a: Any, b: Any, a_f: Any, b_f: Any, k: Any) -> jax.Array:
    J, along = det(F), F @ f
    I1, I4 = J ** (-2 / 3) * jnp.sum(F * F), J ** (-2 / 3) * jnp.sum(along**2)
    stretch = jnp.where(I4 > 1.0, I4 - 1.0, 0.0)
    fibres = a_f / (2 * b_f) * (jnp.exp(b_f * stretch**2) - 1)
    return a / (2 * b) * (jnp.exp(b * (I1 - 3)) - 1) + fibres + k * (J**2 - 1 - 2 * jnp.log(J))


def _guccione(F: jax.Array, f: Any, C: Any, b_f: Any, b_t: Any, b_fs: Any, kappa: Any) -> jax.Array:
    # In a frame whose first axis is the fibre; Guccione's Q does not depend on turns about it.
    helper = jnp.eye(3)[jnp.argmin(jnp.abs(f))]
    s = jnp.cross(f, helper)
    s = s / jnp.sqrt(jnp.sum(s**2))
    R = jnp.stack([f, s, jnp.cross(f, s)])
    E = R @ (0.5 * (F.T @ F - jnp.eye(3))) @ R.T
    Q = (
        b_f * E[0, 0] ** 2
        + b_t * (E[1, 1] ** 2 + E[2, 2] ** 2 + 2 * E[1, 2] ** 2)
        + 2 * b_fs * (E[0, 1] ** 2 + E[0, 2] ** 2)
    )
    return 0.5 * C * (jnp.exp(Q) - 1) + 0.5 * kappa * (det(F) - 1) ** 2


def _released(F: jax.Array, f: Any, a: Any, b: Any, a_f: Any, b_f: Any, k: Any) -> jax.Array:
    J, along = det(F), F @ f
    I1, I4 = J ** (-2 / 3) * jnp.sum(F * F), J ** (-2 / 3) * jnp.sum(along**2)
    fibres = a_f / b_f * (jnp.exp(b_f * (I4 - 1) ** 2) - 1)
    return a / b * (jnp.exp(b * (I1 - 3)) - 1) + fibres + k * (J**2 - 1 - 2 * jnp.log(J))


ENERGIES: dict[str, Callable[..., jax.Array]] = {
    "neo_hookean": _neo_hookean,
    "neo_hookean_E_nu": _neo_hookean_engineering,
    "holzapfel_ogden": _holzapfel_ogden,
    "holzapfel_ogden_released": _released,
    "guccione": _guccione,
}


# ---- forces ------------------------------------------------------------------------------------
def deformation(scene: em.Scene) -> tuple[Callable[[jax.Array], jax.Array], np.ndarray, np.ndarray]:
    """``F`` at every point as a function of ``u``: (m, q, 3, 3); weights (m, q); values (q, a)."""
    order = scene.mesh.order
    points, weights = _POINTS[order]
    values = np.array([tetrahedron(jnp.asarray(xi), order) for xi in points])
    slopes = np.array([jax.jacfwd(tetrahedron)(jnp.asarray(xi), order) for xi in points])
    X = scene.mesh.nodes[scene.mesh.elements]
    jacobian = np.einsum("mai,qaj->mqij", X, slopes)
    gradients = np.einsum("qaj,mqji->mqai", slopes, np.linalg.inv(jacobian))

    def F(local: jax.Array) -> jax.Array:
        return jnp.eye(3) + jnp.einsum("mai,mqaj->mqij", local, gradients)

    return F, np.linalg.det(jacobian) * weights, values


def internal_force(scene: em.Scene, u: jax.Array, theta: jax.Array) -> jax.Array:
    """Nodal forces (n, 3) in mN of the strained elements and of the springs."""
    F, weights, _ = deformation(scene)
    if scene.law.name not in ENERGIES:
        raise UnknownError(f"law '{scene.law.name}'")
    values = scene.resolve(theta)
    arguments = [values[name] for name in scene.law.parameters]
    law, factor = ENERGIES[scene.law.name], jnp.ones(len(weights))
    if scene.regions is not None:
        if not scene.law.name.startswith("holzapfel_ogden"):
            raise UnknownError(f"regions of law '{scene.law.name}'")
        labels = np.unique(scene.regions)
        factors = jnp.array([values[f"stiffness_{label}"] for label in labels])
        factor = factors[np.searchsorted(labels, scene.regions)]
    fibres = fibres_of(scene, weights.shape)

    def energy(local: jax.Array) -> jax.Array:
        at = F(local)
        if scene.dilatation == "mean":
            J = jax.vmap(jax.vmap(det))(at)
            mean = jnp.sum(weights * J, axis=1) / jnp.sum(weights, axis=1)
            at = at * jnp.cbrt(mean[:, None] / J)[..., None, None]

        def one(f: jax.Array, fibre: jax.Array, s: jax.Array) -> jax.Array:
            if scene.regions is None:
                return law(f, fibre, *arguments)
            # At a pure volume change only the volumetric part of the energy is left.
            volume = law(jnp.cbrt(det(f)) * jnp.eye(3), fibre, *arguments)
            return s * (law(f, fibre, *arguments) - volume) + volume

        return jnp.sum(weights * jax.vmap(jax.vmap(one, (0, 0, None)))(at, fibres, factor))

    local = jnp.asarray(u)[scene.mesh.elements]
    force = _collect(scene, scene.mesh.elements, jax.grad(energy)(local))
    for support in scene.supports:
        if isinstance(support, em.supports.ElasticSupport):
            force = force + _springs(scene, support, u)
    return force


def fibres_of(scene: em.Scene, shape: tuple[int, ...]) -> jax.Array:
    """Fibres at this file's points, (m, q, 3); a scene lists its own points in another order."""
    if scene.fibres is None:
        return jnp.zeros((*shape, 3))
    here, there = (
        _POINTS[scene.mesh.order][0],
        em.geometry.quadrature_points(scene.mesh.order)[:, 1:],
    )
    apart = np.linalg.norm(here[:, None] - there, axis=-1)
    return jnp.asarray(scene.fibres_at_points[:, apart.argmin(axis=1)])


def external_force(scene: em.Scene, u: jax.Array, theta: jax.Array) -> jax.Array:
    """Nodal forces (n, 3) in mN of the loads."""
    values = scene.resolve(theta)
    force = jnp.zeros((len(scene.mesh.nodes), 3))
    for load in scene.loads:
        if isinstance(load, em.loads.Gravity):
            _, weights, shapes = deformation(scene)
            along = np.asarray(load.direction) / np.linalg.norm(load.direction)
            # g/cm3 times m/s2 is 1e-3 kPa/mm.
            body = 1e-3 * load.density * load.acceleration * along
            local = jnp.einsum("mq,qa,i->mai", weights, shapes, body)
            force = force + _collect(scene, scene.mesh.elements, local)
        elif isinstance(load, em.loads.Traction):
            facets, area, N = _surface(scene, load.facet_set, None)
            size = jnp.linalg.norm(area, axis=-1)
            local = jnp.einsum("kq,qa,i->kai", size, N, jnp.asarray(load.traction))
            force = force + _collect(scene, facets, local)
        elif isinstance(load, em.loads.CavityPressure | em.loads.FollowerPressure):
            facets, area, N = _surface(scene, load.facet_set, u)
            p = values[load.parameter] if load.pressure is None else load.pressure
            force = force + _collect(scene, facets, -p * jnp.einsum("kqi,qa->kai", area, N))
        else:
            raise UnknownError(f"load {type(load).__name__}")
    return force


def _surface(
    scene: em.Scene, name: str, u: jax.Array | None
) -> tuple[np.ndarray, jax.Array, np.ndarray]:
    """Facets (k, a); weighted area vectors (k, q, 3) of the deformed surface; values (q, a)."""
    facets, order = scene.mesh.facet_set(name), scene.mesh.order
    N = np.array([triangle(jnp.asarray(xi), order) for xi in _TRIANGLE])
    slopes = np.array([jax.jacfwd(triangle)(jnp.asarray(xi), order) for xi in _TRIANGLE])
    x = jnp.asarray(scene.mesh.nodes if u is None else scene.mesh.nodes + u)[facets]
    tangents = jnp.einsum("qad,kai->kqdi", slopes, x)
    area = jnp.cross(tangents[:, :, 0], tangents[:, :, 1])
    return facets, area * _TRIANGLE_WEIGHTS[:, None], N


def _springs(scene: em.Scene, support: em.supports.ElasticSupport, u: jax.Array) -> jax.Array:
    facets, area, N = _surface(scene, support.facet_set, None)
    size = jnp.linalg.norm(area, axis=-1, keepdims=True)
    at = jnp.einsum("qa,kai->kqi", N, jnp.asarray(u)[facets])
    if support.direction == "normal":
        normal = area / size
        at = normal * jnp.sum(at * normal, axis=-1, keepdims=True)
    local = support.stiffness * jnp.einsum("kqi,qa->kai", size * at, N)
    return _collect(scene, facets, local)


def _collect(scene: em.Scene, nodes: np.ndarray, local: jax.Array) -> jax.Array:
    return jnp.zeros((len(scene.mesh.nodes), 3)).at[nodes].add(local)


# ---- judgements --------------------------------------------------------------------------------
def residual(scene: em.Scene, u: jax.Array, theta: jax.Array) -> tuple[float, bool]:
    """Residual over the free components, relative to the forces at work.

    Also whether it was computed without the package's energy.
    """
    u = jnp.asarray(u)
    try:
        internal, external = internal_force(scene, u, theta), external_force(scene, u, theta)
        return relative(scene, internal, external), True
    except UnknownError:
        internal = jax.grad(em.fem.strain_energy(scene))(u, theta)
        out_of_balance = jax.grad(em.fem.potential_energy(scene))(u, theta)
        return relative(scene, internal, internal - out_of_balance), False


def relative(scene: em.Scene, internal: jax.Array, external: jax.Array) -> float:
    """Norm of the free part of the difference over the sum of the norms."""
    # Divided by their largest first: the squares of forces of 1e200 mN overflow.
    top = max(float(jnp.max(jnp.abs(internal))), float(jnp.max(jnp.abs(external))), 1e-300)
    internal, external = internal / top, external / top
    free = jnp.where(scene.held, 0.0, internal - external)
    scale = jnp.linalg.norm(internal) + jnp.linalg.norm(external)
    return float(jnp.linalg.norm(free) / jnp.where(scale > 0.0, scale, 1.0))


def is_round_off(scene: em.Scene, u: jax.Array, theta: jax.Array) -> bool:
    """Whether the displacement that the residual stands for, by this file's tangent, is nothing."""
    free = np.flatnonzero(~scene.held.ravel())
    if len(free) > MOST_UNKNOWNS:
        return False

    def left(values: jax.Array) -> jax.Array:
        v = jnp.asarray(u).reshape(-1).at[free].set(values).reshape(-1, 3)
        out = internal_force(scene, v, theta) - external_force(scene, v, theta)
        return out.reshape(-1)[free]

    at = jnp.asarray(u).reshape(-1)[free]
    try:
        r, K = left(at), jax.jacfwd(left)(at)
        correction = np.abs(np.linalg.solve(np.asarray(K), np.asarray(r))).max()
    except (UnknownError, np.linalg.LinAlgError):
        return False
    nodes = scene.mesh.nodes
    extent = (nodes.max(axis=0) - nodes.min(axis=0)).max()
    return bool(correction <= max(TOLERANCE * np.abs(u).max(), SMALLEST * extent))


def smallest_volume_ratio(scene: em.Scene, u: jax.Array) -> float:
    """Least ``J`` at a quadrature point."""
    F, _, _ = deformation(scene)
    return float(jnp.min(jax.vmap(jax.vmap(det))(F(jnp.asarray(u)[scene.mesh.elements]))))


def judge(scene: em.Scene, u: jax.Array, theta: jax.Array, claim: str | None = None) -> Judgement:
    """Judge an answer that converged; ``claim`` says what the case itself found wrong."""
    if not bool(jnp.all(jnp.isfinite(u))):
        return Judgement(float("nan"), False, float("nan"), "displacement not finite")
    missed = np.abs(np.asarray(u) - scene.held_displacement)[scene.held]
    error, independent = residual(scene, u, theta)
    least = smallest_volume_ratio(scene, u)
    wrong = [
        text
        for text, bad in (
            (
                f"residual {error:.1e}",
                not error <= TOLERANCE and not is_round_off(scene, u, theta),
            ),
            (f"J = {least:.1e}", not least > 0.0),
            ("support missed", bool(missed.size and missed.max() > 0.0)),
            (claim or "", bool(claim)),
        )
        if bad
    ]
    return Judgement(error, independent, least, "; ".join(wrong))


def is_stable(simulator: em.Simulator, u: jax.Array, theta: jax.Array) -> bool | None:
    """Whether the tangent is positive definite; ``None`` where loads have no potential."""
    system = simulator.system
    if system.forces:
        return None
    values = system.tangent(u, theta)
    if not bool(jnp.all(jnp.isfinite(values))):
        return None
    try:  # Cholesky exists for positive definite matrices only
        x = sparsax.solve(
            system.pattern.rows, system.pattern.columns, values, jnp.ones(system.pattern.size)
        )
        return bool(jnp.all(jnp.isfinite(x)))
    except Exception as error:  # its class differs with where jax notices
        if "positive definite" not in str(error):
            raise
        return False
