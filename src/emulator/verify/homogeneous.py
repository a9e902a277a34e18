r"""Uniaxial and equibiaxial stretch of a cube: the solution of every law in closed form.

The cube's edges, its fibres along x and its sheets along y, are the principal axes, so that a law
is a function of three stretches and the first Piola stress is diagonal,
:math:`P_i = \partial W/\partial\lambda_i`. Directions without a prescribed stretch are free,
:math:`P_i = 0`. Under uniaxial stretch this is one equation for both lateral stretches; with sheets
the two differ, and there are two equations.

The formulas below are written out by hand in NumPy and share no code with the laws they are
compared with. :func:`verify_homogeneous` solves the same cubes by finite elements.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import brentq

from emulator.fem import Simulator
from emulator.fem.energy import strain_energy
from emulator.geometry.generators.box import box
from emulator.mechanics.laws import find_law
from emulator.scenes import Parameter, Scene, Support
from emulator.verify.benchmark import Benchmark

Values = Mapping[str, float]


@dataclass(frozen=True)
class Homogeneous:
    """Principal stretches and first Piola stresses in kPa along x (the fibres), y and z."""

    stretches: tuple[float, float, float]
    stresses: tuple[float, float, float]


def uniaxial(law: str, stretch: float, values: Values) -> Homogeneous:
    """Stretch a cube along x, free along y and z; ``values`` are the law's parameters."""
    if not find_law(law).sheets:
        return _solve(law, values, lambda free: (stretch, free, free))
    stress = PRINCIPAL_STRESS[law]

    def across(z: float) -> float:
        """Return the stretch along y (the sheets) at which the stress along y vanishes."""
        return _root(lambda y: float(stress(np.array([stretch, y, z]), values)[1]))

    return _solve(law, values, lambda free: (stretch, across(free), free))


def equibiaxial(law: str, stretch: float, values: Values) -> Homogeneous:
    """Stretch a cube along x and y, free along z; ``values`` are the law's parameters."""
    return _solve(law, values, lambda free: (stretch, stretch, free))


def _solve(
    law: str, values: Values, stretches: Callable[[float], tuple[float, float, float]]
) -> Homogeneous:
    """Find the free stretch along z at which the stress along z vanishes."""
    stress = PRINCIPAL_STRESS[law]
    state = stretches(_root(lambda free: float(stress(np.array(stretches(free)), values)[2])))
    first, second, third = map(float, stress(np.array(state), values))
    return Homogeneous(state, (first, second, third))


def _root(stress: Callable[[float], float]) -> float:
    """Return the stretch at which ``stress``, which grows with it, is zero."""
    low = high = 1.0
    while stress(low) > 0.0:
        low *= 0.95
    while stress(high) < 0.0:
        high *= 1.05
    return low if low == high else brentq(stress, low, high, xtol=1e-15, rtol=1e-15)


# ---- principal stresses: functions of the stretches (3,) that return kPa, (3,) -------------------
def neo_hookean(stretches: np.ndarray, values: Values) -> np.ndarray:
    r""":math:`P_i = \mu (\lambda_i - 1/\lambda_i) + \lambda \ln J / \lambda_i`."""
    mu, lam = _lame(values)
    return mu * (stretches - 1.0 / stretches) + lam * np.log(np.prod(stretches)) / stretches


def small_strain(stretches: np.ndarray, values: Values) -> np.ndarray:
    r""":math:`P_i = 2\mu\, \varepsilon_i + \lambda \sum_k \varepsilon_k`."""
    (mu, lam), strain = _lame(values), stretches - 1.0
    return 2.0 * mu * strain + lam * np.sum(strain)


def _lame(values: Values) -> tuple[float, float]:
    """Return Lamé's constants in kPa, also from Young's modulus and Poisson's ratio."""
    if "E" not in values:
        return values["mu"], values["lam"]
    E, nu = values["E"], values["nu"]
    return E / 2.0 / (1.0 + nu), E * nu / (1.0 + nu) / (1.0 - 2.0 * nu)


def neo_hookean_split(stretches: np.ndarray, values: Values) -> np.ndarray:
    r""":math:`P_i = \tfrac{\mu}{2} \partial_i \bar I_1 + \tfrac{\kappa}{2}(J^2 - 1)/\lambda_i`."""
    volume = 0.5 * values["kappa"] * (np.prod(stretches) ** 2 - 1.0) / stretches
    return 0.5 * values["mu"] * _isochoric(stretches)[2] + volume


def _isochoric(stretches: np.ndarray) -> tuple[np.ndarray, ...]:
    r"""Return ``(I1 - 3, I4 - 1)``, both isochoric, and their derivatives in the stretches.

    .. math::
        \partial \bar I_1 / \partial\lambda_i &= J^{-2/3} (2\lambda_i - 2 I_1 / 3\lambda_i) \\
        \partial \bar I_4 / \partial\lambda_i &=
            J^{-2/3} (2\lambda_1 \delta_{i1} - 2 \lambda_1^2 / 3\lambda_i)
    """
    scale = np.prod(stretches) ** (-2.0 / 3.0)
    I1, I4 = np.sum(stretches**2), stretches[0] ** 2
    along = np.array([2.0 * stretches[0], 0.0, 0.0])
    d_I1 = scale * (2.0 * stretches - 2.0 / 3.0 * I1 / stretches)
    d_I4 = scale * (along - 2.0 / 3.0 * I4 / stretches)
    return scale * I1 - 3.0, scale * I4 - 1.0, d_I1, d_I4


def holzapfel_ogden_isotropic(stretches: np.ndarray, values: Values) -> np.ndarray:
    r""":math:`P_i^{iso} = \tfrac{a}{2} e^{b(\bar I_1 - 3)} \partial_i \bar I_1 +
    2\kappa (J^2 - 1)/\lambda_i`.
    """  # noqa: D205
    a, b, kappa = (values[name] for name in ("a", "b", "kappa"))
    I1, _, d_I1, _ = _isochoric(stretches)
    volume = 2.0 * kappa * (np.prod(stretches) ** 2 - 1.0) / stretches
    return a / 2.0 * np.exp(b * I1) * d_I1 + volume


def holzapfel_ogden(stretches: np.ndarray, values: Values, *, switch: bool = True) -> np.ndarray:
    r"""Fibres with the dispersion d, 0 where the law has none, switched off in compression.

    .. math::
        P_i = P_i^{iso} + a_f x\, e^{b_f x^2} \left[d\, \partial_i \bar I_1
          + (1 - 3d)\, \partial_i \bar I_4\right], \quad
        x = \max(d (\bar I_1 - 3) + (1 - 3d)(\bar I_4 - 1), 0)

    switch : without it, x may be negative.
    """
    d, a_f, b_f = values.get("dispersion", 0.0), values["a_f"], values["b_f"]
    I1, I4, d_I1, d_I4 = _isochoric(stretches)
    x = float(d * I1 + (1.0 - 3.0 * d) * I4)
    x = max(x, 0.0) if switch else x
    slope = d * d_I1 + (1.0 - 3.0 * d) * d_I4
    return holzapfel_ogden_isotropic(stretches, values) + a_f * x * np.exp(b_f * x**2) * slope


def holzapfel_ogden_released(stretches: np.ndarray, values: Values) -> np.ndarray:
    """The released form: twice the textbook's factors a and a_f, and no switch."""
    doubled = {**values, "a": 2.0 * values["a"], "a_f": 2.0 * values["a_f"]}
    return holzapfel_ogden(stretches, doubled, switch=False)


def holzapfel_ogden_orthotropic(stretches: np.ndarray, values: Values) -> np.ndarray:
    r"""Sheets along y; without shear between them and the fibres.

    .. math::
        P_i = P_i^{HO} + a_s x\, e^{b_s x^2} \partial_i \bar I_{4s}, \quad
        x = \max(\bar I_{4s} - 1, 0)
    """
    order = [1, 0, 2]  # the sheets take the position of the fibres
    _, I4, _, d_I4 = _isochoric(stretches[order])
    x = max(float(I4), 0.0)
    sheets = values["a_s"] * x * np.exp(values["b_s"] * x**2) * d_I4[order]
    return holzapfel_ogden(stretches, values) + sheets


def guccione(stretches: np.ndarray, values: Values) -> np.ndarray:
    r"""Fibres along x.

    .. math::
        P_i = C e^Q b_i E_i \lambda_i + \kappa (J - 1) J / \lambda_i, \quad
        E_i = (\lambda_i^2 - 1)/2, \quad Q = \sum_i b_i E_i^2, \quad b = (b_f, b_t, b_t)
    """
    b = np.array([values["b_f"], values["b_t"], values["b_t"]])
    E, J = (stretches**2 - 1.0) / 2.0, np.prod(stretches)
    matrix = values["C"] * np.exp(np.sum(b * E**2)) * b * E * stretches
    return matrix + values["kappa"] * (J - 1.0) * J / stretches


PRINCIPAL_STRESS: dict[str, Callable[[np.ndarray, Values], np.ndarray]] = {
    "neo_hookean": neo_hookean,
    "neo_hookean_E_nu": neo_hookean,
    "neo_hookean_split": neo_hookean_split,
    "small_strain": small_strain,
    "small_strain_E_nu": small_strain,
    "holzapfel_ogden": holzapfel_ogden,
    "holzapfel_ogden_unswitched": partial(holzapfel_ogden, switch=False),
    "holzapfel_ogden_isotropic": holzapfel_ogden_isotropic,
    "holzapfel_ogden_dispersed": holzapfel_ogden,
    "holzapfel_ogden_dispersed_unswitched": partial(holzapfel_ogden, switch=False),
    "holzapfel_ogden_released": holzapfel_ogden_released,
    "holzapfel_ogden_orthotropic": holzapfel_ogden_orthotropic,
    "guccione": guccione,
}

_TEXTBOOK = {"a": 2.0, "b": 3.0, "a_f": 5.0, "b_f": 4.0}
_DISPERSED = {**_TEXTBOOK, "dispersion": 0.1, "kappa": 50.0}
_SHEETS = {"a_s": 3.0, "b_s": 4.0, "a_fs": 1.0, "b_fs": 2.0}
# Every term of each law contributes, and volume changes are resisted as in tissue.
PARAMETERS: dict[str, dict[str, float]] = {
    "neo_hookean": {"mu": 10.0, "lam": 30.0},
    "neo_hookean_E_nu": {"E": 30.0, "nu": 0.4},
    "neo_hookean_split": {"mu": 10.0, "kappa": 60.0},
    "small_strain": {"mu": 10.0, "lam": 30.0},
    "small_strain_E_nu": {"E": 30.0, "nu": 0.4},
    "holzapfel_ogden": {**_TEXTBOOK, "kappa": 50.0},
    "holzapfel_ogden_unswitched": {**_TEXTBOOK, "kappa": 50.0},
    "holzapfel_ogden_isotropic": {"a": 2.0, "b": 3.0, "kappa": 50.0},
    "holzapfel_ogden_dispersed": _DISPERSED,
    "holzapfel_ogden_dispersed_unswitched": _DISPERSED,
    "holzapfel_ogden_released": {"a": 1.0, "b": 3.0, "a_f": 2.5, "b_f": 4.0, "kappa": 50.0},
    "holzapfel_ogden_orthotropic": {**_TEXTBOOK, **_SHEETS, "kappa": 50.0},
    "guccione": {"C": 2.0, "b_f": 8.0, "b_t": 2.0, "b_fs": 4.0, "kappa": 50.0},
}

STRETCHES = (0.85, 1.2)
_TOLERANCE = 1e-8  # relative to the closed form; the solver leaves 1e-10
_SOURCE = "closed form in principal stretches, written out in emulator.verify.homogeneous"


def verify_homogeneous(laws: Sequence[str] = tuple(PARAMETERS)) -> list[Benchmark]:
    """Compare FEM cubes with the closed forms: stress along x in kPa, and the free stretch."""
    rows = []
    for law in laws:
        for kind, solve in (("uniaxial", uniaxial), ("equibiaxial", equibiaxial)):
            for stretch in STRETCHES:
                expected = solve(law, stretch, PARAMETERS[law])
                solution = _by_fem(law, kind, stretch)
                for what, k, measured, reference in (
                    ("stress along x", 0, solution.stresses, expected.stresses),
                    ("free stretch", 2, solution.stretches, expected.stretches),
                ):
                    name = f"{law}: {kind}, stretch {stretch:g}: {what}"
                    tolerance = _TOLERANCE * abs(reference[k])
                    rows.append(Benchmark(name, measured[k], reference[k], tolerance, _SOURCE))
    return rows


def cube_scene(law: str, kind: str, stretch: float) -> Scene:
    """Return a cube of 1 mm on three planes of symmetry, stretched along x, or along x and y."""
    displacement = stretch - 1.0
    supports = [
        Support("left", components="x"),
        Support("front", components="y"),
        Support("bottom", components="z"),
        Support("right", np.array([displacement, 0.0, 0.0]), components="x"),
    ]
    if kind == "equibiaxial":
        supports.append(Support("back", np.array([0.0, displacement, 0.0]), components="y"))
    mesh, description = box((1.0, 1.0, 1.0), (2, 2, 2)), find_law(law)
    varied, *fixed = PARAMETERS[law].items()
    return Scene(
        name=f"{kind} cube",
        mesh=mesh,
        law=description,
        parameters=(Parameter(varied[0], "kPa", 0.5 * varied[1], 2.0 * varied[1]),),
        supports=tuple(supports),
        constants=dict(fixed),
        fibres=np.tile([1.0, 0.0, 0.0], (len(mesh.elements), 1)) if description.fibres else None,
        sheets=np.tile([0.0, 1.0, 0.0], (len(mesh.elements), 1)) if description.sheets else None,
    )


def _by_fem(law: str, kind: str, stretch: float) -> Homogeneous:
    """Solve a cube: stretches of the corner opposite the origin, reactions of faces of 1 mm2."""
    scene = cube_scene(law, kind, stretch)
    theta = jnp.array([next(iter(PARAMETERS[law].values()))])
    solution = Simulator(scene).solve(theta).require_converged(f"{law}, {kind}")
    u = solution.displacement
    force = jax.grad(strain_energy(scene))(u, theta)
    corner = int(np.argmax(scene.mesh.nodes.sum(axis=1)))
    sets = [scene.mesh.node_set(name) for name in ("right", "back", "top")]
    first, second, third = (float(force[nodes, k].sum()) for k, nodes in enumerate(sets))
    x, y, z = (1.0 + float(u[corner, k]) for k in range(3))
    return Homogeneous((x, y, z), (first, second, third))
