r"""Uniaxial and equibiaxial stretch of a specimen: the stress of every law in closed form.

Fibres along x and sheets along y are principal axes, so that a law is a function of three stretches
and the first Piola stress is diagonal, :math:`P_i = \partial W/\partial\lambda_i`. It vanishes
along directions without a prescribed stretch.

The formulas below are written out by hand in NumPy and share no code with the laws they are
compared with. :func:`verify_homogeneous` solves specimens (:mod:`emulator.specimens.specimen`) by
finite elements, one tetrahedron a state, those of one law side by side in one scene.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from emulator.fem import Simulator
from emulator.fem.energy import strain_energy
from emulator.geometry.mesh import Mesh
from emulator.mechanics.laws import find_law
from emulator.scenes import Parameter, Scene, Support
from emulator.scenes.loads.force import MN_PER_N, Force
from emulator.specimens.specimen import Specimen, specimen
from emulator.specimens.states import AXES
from emulator.verify.benchmark import Benchmark

Values = Mapping[str, float]
_APART = 2.0  # mm between the tetrahedra of two states
_VOLUME = 1.0 / 6.0  # mm3, of a tetrahedron


def pulled(law: str, stretches: Sequence[float], values: Values | None = None) -> Specimen:
    """Return a specimen of the law pulled along x, to each of the stretches, then along x and y.

    Its parameter is the law's first one; the others are constants.
    """
    numbers = SOLUTIONS[law][1] if values is None else values
    (name, value), *fixed = numbers.items()
    description, free = find_law(law), [np.nan] * len(stretches)
    return specimen(
        {"stretch_x": np.tile(stretches, 2), "stretch_y": np.array([*free, *stretches])},
        ordered=False,
        name=f"specimen of {law}",
        law=description,
        parameters=(Parameter(name, "kPa", 0.5 * value, 2.0 * value),),
        constants=dict(fixed),
        fibres=[1.0, 0.0, 0.0] if description.fibres else None,
        sheets=[0.0, 1.0, 0.0] if description.sheets else None,
    )


def tetrahedra(problem: Specimen) -> Scene:
    r"""Return a scene of a specimen's states for finite elements, which are exact of them.

    State i is a tetrahedron of nodes 4 i at the origin and 4 i + 1 to 4 i + 3 at :math:`e_x, e_y,
    e_z` (mm), of which node k moves by column k of H. Supports hold what is prescribed. A pull P
    along axis k is a dead force on :math:`e_k`, whose work :math:`V P H_{kk}` in the volume V of
    1/6 mm3 makes it P/6 mN.
    """
    H, free, pulls, _ = problem.states
    count = len(H)
    corners = np.vstack([np.zeros(3), np.eye(3)])
    nodes = (_APART * np.arange(count)[:, None, None] * np.eye(3)[0] + corners).reshape(-1, 3)
    elements = np.arange(4 * count).reshape(count, 4)
    sets, supports, forces = {"origin": elements[:, 0]}, [Support("origin")], list[Force]()
    for k, axis in enumerate(AXES):
        held, loaded = np.flatnonzero(~free[:, k]), np.flatnonzero(pulls[:, k])
        sets[axis] = elements[:, k + 1]
        supports.append(Support(axis, H[:, :, k], components=AXES.replace(axis, "")))
        if len(held):
            sets[f"{axis}.held"] = elements[held, k + 1]
            supports.append(Support(f"{axis}.held", H[held, :, k], components=axis))
        if len(loaded):
            sets[f"{axis}.pulled"] = elements[loaded, k + 1]
            along = _VOLUME / MN_PER_N * pulls[loaded, k, None] * np.eye(3)[k]
            forces.append(Force(f"{axis}.pulled", along))
    return Scene(
        name=problem.name,
        mesh=Mesh(nodes, elements, sets),
        law=problem.law,
        parameters=problem.parameters,
        constants=problem.constants,
        loads=tuple(forces),
        supports=tuple(supports),
        fibres=problem.fibres,
        sheets=problem.sheets,
    )


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


def _volume(stretches: np.ndarray, kappa: float) -> np.ndarray:
    """Return the stresses of kappa/4 (J^2 - 1 - 2 ln J)."""
    return 0.5 * kappa * (np.prod(stretches) ** 2 - 1.0) / stretches


def neo_hookean_split(stretches: np.ndarray, values: Values) -> np.ndarray:
    r""":math:`P_i = \tfrac{\mu}{2} \partial_i \bar I_1 + \tfrac{\kappa}{2}(J^2 - 1)/\lambda_i`."""
    volume = _volume(stretches, values["kappa"])
    return 0.5 * values["mu"] * _isochoric(stretches, np.ones(3))[1] + volume


def _isochoric(stretches: np.ndarray, weights: np.ndarray) -> tuple[float, np.ndarray]:
    r"""Return an isochoric measure and its derivatives in the stretches.

    .. math::
        \bar I = J^{-2/3} I, \quad I = \sum_i w_i \lambda_i^2, \quad
        \partial \bar I / \partial\lambda_i = J^{-2/3} (2 w_i \lambda_i - 2 I / 3\lambda_i)
    """
    scale, I = np.prod(stretches) ** (-2.0 / 3.0), np.sum(weights * stretches**2)  # noqa: E741
    slope = scale * (2.0 * weights * stretches - 2.0 / 3.0 * I / stretches)
    return float(scale * I), slope


def holzapfel_ogden(stretches: np.ndarray, values: Values, *, switch: bool = True) -> np.ndarray:
    r"""Fibres along x and sheets along y, where the law has them, switched off in compression.

    .. math::
        P_i = \tfrac{a}{2} e^{b(\bar I_1 - 3)} \partial_i \bar I_1 + 2\kappa (J^2 - 1)/\lambda_i
            + \sum_{k = f, s} a_k x_k\, e^{b_k x_k^2} \partial_i x_k, \quad
        x_k = \max(d (\bar I_1 - 3) + (1 - 3d)(\bar I_{4k} - 1), 0)

    with the dispersion d, 0 where the law has none. Sheets and fibres do not shear.

    switch : without it, x may be negative.
    """
    a, b, kappa, d = (values.get(name, 0.0) for name in ("a", "b", "kappa", "dispersion"))
    I1, d_I1 = _isochoric(stretches, np.ones(3))
    volume = _volume(stretches, 4.0 * kappa)
    stress = a / 2.0 * np.exp(b * (I1 - 3.0)) * d_I1 + volume
    for k, direction in zip("fs", np.eye(3), strict=False):
        if f"a_{k}" in values:
            measure, slope = _isochoric(stretches, d + (1.0 - 3.0 * d) * direction)
            x = max(measure - 1.0, 0.0) if switch else measure - 1.0
            stress = stress + values[f"a_{k}"] * x * np.exp(values[f"b_{k}"] * x**2) * slope
    return stress


def holzapfel_ogden_released(stretches: np.ndarray, values: Values) -> np.ndarray:
    """The released form: twice the textbook's factors a and a_f, and no switch."""
    doubled = {**values, "a": 2.0 * values["a"], "a_f": 2.0 * values["a_f"]}
    return holzapfel_ogden(stretches, doubled, switch=False)


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


def polynomial(stretches: np.ndarray, values: Values) -> np.ndarray:
    r"""Powers of the first isochoric invariant, and the second.

    .. math::
        P_i = \sum_k k c_k (\bar I_1 - 3)^{k-1} \partial_i \bar I_1 + c_{01}\, \partial_i \bar I_2
    """
    I1, d_I1 = _isochoric(stretches, np.ones(3))
    powers = {
        1: values.get("c_1", values.get("c_10", 0.0)),
        **{k: values.get(f"c_{k}", 0.0) for k in (2, 3)},
    }
    stress = sum(k * c * (I1 - 3.0) ** (k - 1) for k, c in powers.items()) * d_I1
    squares = stretches**2
    I2, scale = np.prod(squares) * np.sum(1.0 / squares), np.prod(stretches) ** (-4.0 / 3.0)
    d_I2 = scale * (2.0 * stretches * (np.sum(squares) - squares) - 4.0 / 3.0 * I2 / stretches)
    return stress + values.get("c_01", 0.0) * d_I2 + _volume(stretches, values["kappa"])


def ogden(stretches: np.ndarray, values: Values) -> np.ndarray:
    r"""Powers of the isochoric stretches, less the mean of the three.

    .. math:: P_i = \sum_p \frac{2\mu_p}{\alpha_p \lambda_i}
        \Big(\bar\lambda_i^{\alpha_p} - \tfrac13 \sum_k \bar\lambda_k^{\alpha_p}\Big)
    """
    isochoric = stretches * np.prod(stretches) ** (-1.0 / 3.0)
    stress = _volume(stretches, values["kappa"])
    for k in range(1, 4):
        if f"mu_{k}" in values:
            powers = isochoric ** values[f"alpha_{k}"]
            factor = 2.0 * values[f"mu_{k}"] / values[f"alpha_{k}"]
            stress = stress + factor * (powers - powers.mean()) / stretches
    return stress


def fung(stretches: np.ndarray, values: Values) -> np.ndarray:
    r"""Fibres along x, sheets along y: :math:`P_i = C e^Q (B E)_i \lambda_i` and a matrix."""
    b = {k: values.get(f"b_{k}", 0.0) for k in range(1, 7)}
    B = np.array([[b[1], b[4], b[6]], [b[4], b[2], b[5]], [b[6], b[5], b[3]]])
    E = (stretches**2 - 1.0) / 2.0
    stress = values["C"] * np.exp(E @ B @ E) * (B @ E) * stretches
    matrix = 0.5 * values["mu"] * _isochoric(stretches, np.ones(3))[1]
    return stress + matrix + _volume(stretches, values["kappa"])


def two_families(stretches: np.ndarray, values: Values) -> np.ndarray:
    """Two families of fibres at an angle from x in the plane of x and y, which do not shear."""
    d, beta = values.get("dispersion", 0.0), np.deg2rad(values["angle"])
    weights = d + (1.0 - 3.0 * d) * np.array([np.cos(beta) ** 2, np.sin(beta) ** 2, 0.0])
    measure, slope = _isochoric(stretches, weights)
    x = max(measure - 1.0, 0.0)
    fibres = 2.0 * values["k_1"] * x * np.exp(values["k_2"] * x**2) * slope
    matrix = 0.5 * values["c"] * _isochoric(stretches, np.ones(3))[1]
    return matrix + fibres + _volume(stretches, values["kappa"])


def may_newman(stretches: np.ndarray, values: Values) -> np.ndarray:
    """Fibres along x."""
    I1, d_I1 = _isochoric(stretches, np.ones(3))
    I4, d_I4 = _isochoric(stretches, np.array([1.0, 0.0, 0.0]))
    x, y = I1 - 3.0, np.sqrt(I4) - 1.0
    Q = values["c_1"] * x**2 + values["c_2"] * y**4
    slope = 2.0 * values["c_1"] * x * d_I1 + 2.0 * values["c_2"] * y**3 / np.sqrt(I4) * d_I4
    stress = values["c_0"] * np.exp(Q) * slope + 0.5 * values["mu"] * d_I1
    return stress + _volume(stretches, values["kappa"])


def invariant_terms(stretches: np.ndarray, values: Values) -> np.ndarray:
    """Fibres along x and sheets along y, which do not shear."""
    x, d_x = _isochoric(stretches, np.ones(3))
    I2, d_I2 = _isochoric(1.0 / stretches, np.ones(3))  # the second of F is the first of 1 / F
    x, d_y = x - 3.0, -d_I2 / stretches**2
    slope_x = values["I1"] / 2.0 + values["I1_2"] * x + values["I1_e"] / 2.0 * np.exp(10.0 * x)
    stress = slope_x * d_x + (values["I2"] / 2.0 + values["I2_2"] * (I2 - 3.0)) * d_y
    for k, direction in zip("fs", np.eye(3), strict=False):
        measure, slope = _isochoric(stretches, direction)
        z = max(measure - 1.0, 0.0)
        steep = values[f"{k}_2"] * z + values.get(f"{k}_3", 0.0) * z**2
        stress += (steep + values[f"{k}_e"] * z * np.exp(20.0 * z**2)) * slope
    return stress + _volume(stretches, values["kappa"])


_unswitched = partial(holzapfel_ogden, switch=False)
_FIBRES = {"a": 2.0, "b": 3.0, "a_f": 5.0, "b_f": 4.0}
_SHEETS = {"a_s": 3.0, "b_s": 4.0, "a_fs": 1.0, "b_fs": 2.0}
_RELEASED = {"a": 1.0, "b": 3.0, "a_f": 2.5, "b_f": 4.0}
_DISPERSED = {**_FIBRES, "dispersion": 0.1, "kappa": 50.0}
_OGDEN = {"mu_1": 2.0, "alpha_1": 1.5, "mu_2": 1.0, "alpha_2": -3.0, "mu_3": 0.5, "alpha_3": 8.0}
_MATRIX = {"mu": 1.0, "kappa": 50.0}
_FUNG = dict(
    zip(
        (f"b_{k}" for k in range(1, 10)), (8.0, 4.0, 3.0, 2.0, 1.0, 1.5, 3.0, 2.0, 2.5), strict=True
    )
)
_FAMILIES = {"c": 3.0, "k_1": 2.0, "k_2": 2.5, "angle": 40.0}
SOLUTIONS: dict[str, tuple[Callable[[np.ndarray, Values], np.ndarray], dict[str, float]]] = {
    "neo_hookean": (neo_hookean, {"mu": 10.0, "lam": 30.0}),
    "neo_hookean_E_nu": (neo_hookean, {"E": 30.0, "nu": 0.4}),
    "neo_hookean_split": (neo_hookean_split, {"mu": 10.0, "kappa": 60.0}),
    "small_strain": (small_strain, {"mu": 10.0, "lam": 30.0}),
    "small_strain_E_nu": (small_strain, {"E": 30.0, "nu": 0.4}),
    "holzapfel_ogden": (holzapfel_ogden, {**_FIBRES, "kappa": 50.0}),
    "holzapfel_ogden_unswitched": (_unswitched, {**_FIBRES, "kappa": 50.0}),
    "holzapfel_ogden_isotropic": (holzapfel_ogden, {"a": 2.0, "b": 3.0, "kappa": 50.0}),
    "holzapfel_ogden_dispersed": (holzapfel_ogden, _DISPERSED),
    "holzapfel_ogden_dispersed_unswitched": (_unswitched, _DISPERSED),
    "holzapfel_ogden_released": (holzapfel_ogden_released, {**_RELEASED, "kappa": 50.0}),
    "holzapfel_ogden_orthotropic": (holzapfel_ogden, {**_FIBRES, **_SHEETS, "kappa": 50.0}),
    "guccione": (guccione, {"C": 2.0, "b_f": 8.0, "b_t": 2.0, "b_fs": 4.0, "kappa": 50.0}),
    "mooney_rivlin": (polynomial, {"c_10": 2.0, "c_01": 1.0, "kappa": 40.0}),
    "yeoh": (polynomial, {"c_1": 2.0, "c_2": 0.5, "c_3": 0.3, "kappa": 40.0}),
    "ogden_1": (ogden, {"mu_1": 3.0, "alpha_1": 5.0, "kappa": 40.0}),
    "ogden_2": (ogden, {"mu_1": 3.0, "alpha_1": 5.0, "mu_2": 1.0, "alpha_2": -2.0, "kappa": 40.0}),
    "ogden_3": (ogden, {**_OGDEN, "kappa": 40.0}),
    "fung_planar": (fung, {"C": 2.0, "b_1": 8.0, "b_2": 4.0, "b_4": 2.0, "b_7": 3.0, **_MATRIX}),
    "fung_orthotropic": (fung, {"C": 2.0, **_FUNG, **_MATRIX}),
    "holzapfel_gasser_ogden": (two_families, {**_FAMILIES, "kappa": 25.0}),
    "gasser_ogden_holzapfel": (two_families, {**_FAMILIES, "dispersion": 0.1, "kappa": 25.0}),
    "may_newman": (may_newman, {"c_0": 0.5, "c_1": 2.0, "c_2": 8.0, **_MATRIX}),
    "invariant_terms": (
        invariant_terms,
        {
            "I1": 1.0,
            "I1_2": 2.0,
            "I1_e": 0.5,
            "I2": 1.5,
            "I2_2": 2.5,
            "f_2": 3.0,
            "f_3": 4.0,
            "f_e": 0.7,
            "s_2": 3.5,
            "s_e": 0.6,
            "fs_2": 2.2,
            "fs_e": 0.4,
            "kappa": 25.0,
        },
    ),
}
"""Principal stresses of each law, and parameters, by which every term of the law contributes and
volume changes are resisted as in tissue."""

_STRETCHES = (0.85, 1.2)
_TOLERANCE = 1e-8  # relative to the stress along x; the solver leaves 1e-10
_SOURCE = "closed form in principal stretches, written out in emulator.verify.homogeneous"


def verify_homogeneous(laws: Sequence[str] = tuple(SOLUTIONS)) -> list[Benchmark]:
    """Compare FEM's stress along x in kPa with the formula's, and the formula's along z with 0."""
    rows = []
    for law in laws:
        formula, values = SOLUTIONS[law]
        for name, stretches, stress in zip(_NAMES, *_by_fem(law), strict=True):
            expected = formula(stretches, values)
            tolerance = _TOLERANCE * abs(float(expected[0]))
            for what, measured, reference in (
                ("stress along x", float(stress), float(expected[0])),
                ("stress along z", float(expected[2]), 0.0),
            ):
                row = Benchmark(f"{law}: {name}: {what}", measured, reference, tolerance, _SOURCE)
                rows.append(row)
    return rows


_NAMES = [f"{test}, stretch {s:g}" for test in ("uniaxial", "equibiaxial") for s in _STRETCHES]


def _by_fem(law: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the stretches (4, 3) of the specimens, and their stress (4,) along x."""
    scene = tetrahedra(pulled(law, _STRETCHES))
    theta = jnp.array([next(iter(SOLUTIONS[law][1].values()))])
    u = Simulator(scene).solve(theta).require_converged(scene.name).displacement
    H = np.asarray(scene.gradients(u))[:, 0]
    # The force on the corner at e_x is the stress times the volume, over 1 mm.
    force = np.asarray(jax.grad(strain_energy(scene))(u, theta))[scene.mesh.elements[:, 1], 0]
    volume = scene.discretisation.weights.sum(axis=1)
    return 1.0 + np.diagonal(H, axis1=1, axis2=2), force / volume
