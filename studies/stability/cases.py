"""Hard cases for the simulator, each a named function returning a :class:`Case`."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from emulator import NewtonOptions, Parameter, Scene, Simulator, Support
from emulator.geometry.bodies.box import box
from emulator.geometry.bodies.ellipsoid import EllipsoidalWall, land_ventricle, truncated_ellipsoid
from emulator.geometry.bodies.slab import cooks_membrane
from emulator.geometry.bodies.sphere import sphere_octant
from emulator.geometry.fibres import rule_based_fibres
from emulator.geometry.mesh import Mesh
from emulator.geometry.quadratic import to_quadratic
from emulator.geometry.tetrahedra import signed_volumes
from emulator.mechanics.laws import find_law
from emulator.scenes import BUILT_IN
from emulator.scenes.loads import KPA_PER_MMHG, CavityPressure, FollowerPressure, Gravity, Traction
from emulator.scenes.supports import ElasticSupport
from emulator.scenes.twisting_cube import twist

SEED = 7
SINGLE_STEP = NewtonOptions(min_increment=1.0)


@dataclass(frozen=True)
class Case:
    """One call of the simulator.

    scene, theta : what is simulated, where.
    start : (n, 3) mm, or from rest.
    options : controls of the solver.
    inside_jit : whether the call is made inside ``jit``, where nothing can be caught.
    claim : what must hold for a converged answer; returns what is wrong, or an empty string.
    """

    scene: Scene
    theta: Any
    start: Any = None
    options: NewtonOptions = field(default_factory=NewtonOptions)
    inside_jit: bool = False
    claim: Callable[[np.ndarray], str] = lambda _: ""


Maker = Callable[[], Case]
CASES: dict[str, tuple[str, Maker]] = {}
"""Name -> (family, function)."""


def case(family: str) -> Callable[[Maker], Maker]:
    """Register a function under its name."""

    def register(maker: Maker) -> Maker:
        CASES[maker.__name__] = (family, maker)
        return maker

    return register


def near(what: str, value: float, wanted: float, tolerance: float) -> str:
    """Empty when ``value`` is ``wanted`` within a relative ``tolerance``."""
    fine = abs(value - wanted) <= tolerance * abs(wanted)
    return "" if fine else f"{what} is {value:.6g}, should be {wanted:.6g}"


# ---- bodies ------------------------------------------------------------------------------------
_MODULI = (Parameter("mu", "kPa", 1.0, 10.0, "log"), Parameter("lam", "kPa", 1.0, 10.0, "log"))
_ENGINEERING = (Parameter("E", "kPa", 1.0, 25.0, "log"), Parameter("nu", "", 0.1, 0.4, "log"))
_CLAMPED = (Support("left"),)


def bar(
    lengths: tuple[float, float, float] = (40.0, 10.0, 10.0),
    cells: tuple[int, int, int] = (8, 2, 2),
    *,
    order: int = 1,
    engineering: bool = False,
    **rest: Any,
) -> Scene:
    """A Neo-Hookean bar along x, by default clamped at its left end."""
    mesh = rest.pop("mesh", None) or box(lengths, cells)
    return Scene(
        name="bar",
        mesh=mesh if order == 1 else to_quadratic(mesh),
        law=find_law("neo_hookean_E_nu" if engineering else "neo_hookean"),
        parameters=_ENGINEERING if engineering else _MODULI,
        **{"supports": _CLAMPED, **rest},
    )


def moduli(mu: float = 5.0, lam: float = 5.0) -> np.ndarray:
    """Theta of a bar."""
    return np.array([mu, lam])


DOWN = Gravity(direction=(0.0, 0.0, -1.0))


def moved(scene: Scene, ends: dict[str, np.ndarray | tuple[float, float, float]]) -> Scene:
    """``scene`` with node sets moved by so many mm."""
    supports = tuple(Support(name, np.asarray(shift, float)) for name, shift in ends.items())
    return replace(scene, supports=supports)


def jittered(mesh: Mesh, amount: float) -> Mesh:
    """Inner nodes moved at random; moves are halved until all volumes are positive."""
    rng = np.random.default_rng(SEED)
    spacing = np.ptp(mesh.nodes, axis=0).min() / 4
    shift = amount * spacing * rng.uniform(-1.0, 1.0, mesh.nodes.shape)
    shift[np.unique(mesh.surface)] = 0.0
    whole = np.abs(signed_volumes(mesh.nodes, mesh.elements))
    for _ in range(60):
        volumes = signed_volumes(mesh.nodes + shift, mesh.elements)
        bad = np.unique(mesh.elements[volumes < 1e-4 * whole])
        if not bad.size:
            break
        shift[bad] *= 0.8
    return replace(mesh, nodes=mesh.nodes + shift)


# ---- nearly incompressible ---------------------------------------------------------------------
def _incompressible(nu: float, order: int, dilatation: str) -> Case:
    scene = bar(order=order, engineering=True, loads=(DOWN,), dilatation=dilatation)

    def volume_kept(u: np.ndarray) -> str:
        change = _volume(scene, u) / _volume(scene, 0 * u) - 1
        return "" if abs(change) < 1e-3 else f"volume changes by {change:.1e}"

    return Case(scene, np.array([15.0, nu]), claim=volume_kept)


def _volume(scene: Scene, u: np.ndarray) -> float:
    """Volume inside the faces of the corners, mm3; of quadratic elements, nearly."""
    return float(signed_volumes(scene.mesh.nodes + u, scene.mesh.elements).sum())


for _nu, (_kind, _order, _dilatation) in itertools.product(
    (0.4999, 0.49999),
    (("linear", 1, "pointwise"), ("quadratic", 2, "pointwise"), ("mean", 2, "mean")),
):
    CASES[f"nu_{_nu}_{_kind}".replace(".", "_")] = (
        "nearly incompressible",
        partial(_incompressible, _nu, _order, _dilatation),
    )


def _cook(nu: float, factor: float) -> Case:
    E = 422.5 * 2 * (1 + nu)
    mesh = cooks_membrane((6, 6), thickness=4.0, order=2)
    supports = (Support("left"), Support("all", components="z"))
    loads = (Traction("right", (0.0, 62.5 * factor, 0.0)),)
    scene = bar(
        mesh=mesh, engineering=True, supports=supports, loads=loads, dilatation="mean", order=1
    )
    return Case(scene, np.array([E, nu]))


@case("nearly incompressible")
def cook_mean_nu_0_49999() -> Case:
    return _cook(0.49999, 1.0)


@case("nearly incompressible")
def cook_mean_nu_0_49999_ten_times() -> Case:
    return _cook(0.49999, 10.0)


# ---- corners of the parameter boxes ------------------------------------------------------------
@cache
def built_in(name: str) -> Scene:
    return BUILT_IN[name]()


def corners(count: int) -> list[tuple[int, ...]]:
    """All corners of a box of up to 3 sides; of more, both diagonal ends and six at random."""
    every = list(itertools.product((0, 1), repeat=count))
    if count <= 3:
        return every
    rng = np.random.default_rng(SEED)
    picked = rng.choice(np.arange(1, len(every) - 1), 6, replace=False)
    return [every[0], every[-1], *(every[k] for k in sorted(picked))]


def _corner(name: str, corner: tuple[int, ...], stretch: float) -> Case:
    scene = built_in(name)
    position = 0.5 + stretch * (np.array(corner, float) - 0.5)
    return Case(scene, np.asarray(scene.from_unit(jnp.asarray(position))))


for _name in BUILT_IN:
    for _bits in corners(len(BUILT_IN[_name]().parameters)):
        _label = f"{_name}_" + "".join("lh"[bit] for bit in _bits)
        CASES[_label] = ("corners of the boxes", partial(_corner, _name, _bits, 1.0))
        CASES[_label + "_outside"] = (
            "twice outside the boxes",
            partial(_corner, _name, _bits, 2.0),
        )


# ---- ventricles --------------------------------------------------------------------------------
_HUMAN_WALL = EllipsoidalWall(23.0, 58.0, 34.0, 65.0, base=20.0)
_THIN_WALL = EllipsoidalWall(33.0, 64.0, 34.0, 65.0, base=20.0)
_PRESSURE = Parameter("pressure", "kPa", 4 * KPA_PER_MMHG, 10 * KPA_PER_MMHG)


@cache
def ventricle(*, thin: bool = False, order: int = 1, dilatation: str = "pointwise") -> Scene:
    """A human-sized ventricle, Holzapfel-Ogden, pressure in mmHg to kPa as its only parameter."""
    wall, layers = (_THIN_WALL, 1) if thin else (_HUMAN_WALL, 2)
    rings, around = (5, 12) if order == 2 else (10, 24)
    mesh = truncated_ellipsoid(wall, rings, around, layers, order)
    return Scene(
        name="ventricle",
        mesh=mesh,
        law=find_law("holzapfel_ogden"),
        parameters=(_PRESSURE,),
        loads=(CavityPressure("endocardium"),),
        supports=(Support("base"),),
        constants={
            "a": 0.3,
            "b": 3.0,
            "a_f": 6.0,
            "b_f": 3.0,
            "kappa": 25.0 if dilatation == "pointwise" else 1e4,
        },
        fibres=rule_based_fibres(mesh),
        dilatation=dilatation,
    )


def mmHg(value: float) -> np.ndarray:
    return np.array([value * KPA_PER_MMHG])


def grows(scene: Scene, sign: float) -> Callable[[np.ndarray], str]:
    """The cavity gains volume under pressure and loses it under suction."""

    def claim(u: np.ndarray) -> str:
        facets = scene.mesh.facet_set("endocardium")[:, :3]

        def volume(x: np.ndarray) -> float:
            a, b, c = x[facets].swapaxes(0, 1)
            return -float(np.einsum("ki,ki->k", a, np.cross(b, c)).sum()) / 6.0

        change = volume(scene.mesh.nodes + u) - volume(scene.mesh.nodes)
        return "" if change * sign > 0.0 else f"cavity volume changes by {change:.3g} mm3"

    return claim


@case("ventricles")
def ventricle_8_mmHg() -> Case:
    return Case(ventricle(), mmHg(8.0), claim=grows(ventricle(), 1.0))


@case("ventricles")
def ventricle_30_mmHg() -> Case:
    return Case(ventricle(), mmHg(30.0), claim=grows(ventricle(), 1.0))


@case("ventricles")
def ventricle_100_mmHg() -> Case:
    return Case(ventricle(), mmHg(100.0), claim=grows(ventricle(), 1.0))


@case("ventricles")
def ventricle_1000_mmHg() -> Case:
    return Case(ventricle(), mmHg(1000.0), claim=grows(ventricle(), 1.0))


@case("ventricles")
def ventricle_30_mmHg_single_step() -> Case:
    return Case(ventricle(), mmHg(30.0), options=SINGLE_STEP, claim=grows(ventricle(), 1.0))


@case("ventricles")
def ventricle_suction_5_mmHg() -> Case:
    return Case(ventricle(), mmHg(-5.0), claim=grows(ventricle(), -1.0))


@case("ventricles")
def ventricle_suction_30_mmHg() -> Case:
    return Case(ventricle(), mmHg(-30.0), claim=grows(ventricle(), -1.0))


@case("ventricles")
def ventricle_started_from_suction() -> Case:
    start = _simulator(ventricle(), NewtonOptions()).solve(mmHg(-3.0)).displacement
    return Case(ventricle(), mmHg(10.0), start, claim=grows(ventricle(), 1.0))


@case("ventricles")
def ventricle_suction_started_from_30_mmHg() -> Case:
    start = _simulator(ventricle(), NewtonOptions()).solve(mmHg(30.0)).displacement
    return Case(ventricle(), mmHg(-3.0), start, claim=grows(ventricle(), -1.0))


@case("ventricles")
def ventricle_one_element_thick() -> Case:
    scene = ventricle(thin=True)
    return Case(scene, mmHg(8.0), claim=grows(scene, 1.0))


@case("ventricles")
def ventricle_one_element_thick_30_mmHg() -> Case:
    scene = ventricle(thin=True)
    return Case(scene, mmHg(30.0), claim=grows(scene, 1.0))


@case("ventricles")
def ventricle_one_element_thick_suction() -> Case:
    """Past buckling: a thin shell under outside pressure."""
    scene = ventricle(thin=True)
    return Case(scene, mmHg(-1.0), claim=grows(scene, -1.0))


@case("ventricles")
def ventricle_incompressible_mean() -> Case:
    scene = ventricle(order=2, dilatation="mean")
    return Case(scene, mmHg(10.0), claim=grows(scene, 1.0))


@case("ventricles")
def ventricle_incompressible_mean_30_mmHg() -> Case:
    scene = ventricle(order=2, dilatation="mean")
    return Case(scene, mmHg(30.0), claim=grows(scene, 1.0))


def guccione(mesh: Mesh, fibres: np.ndarray, **rest: Any) -> Scene:
    """Guccione's law with C as its only parameter."""
    return Scene(
        name="guccione",
        mesh=mesh,
        law=find_law("guccione"),
        parameters=(Parameter("C", "kPa", 1.0, 10.0, "log"),),
        fibres=fibres,
        **rest,
    )


def _exponents(b_f: float, b_t: float, b_fs: float, kappa: float) -> dict[str, float]:
    return {"b_f": b_f, "b_t": b_t, "b_fs": b_fs, "kappa": kappa}


def along_x(mesh: Mesh) -> np.ndarray:
    return np.tile([1.0, 0.0, 0.0], (len(mesh.elements), 1))


@case("ventricles")
def land_beam() -> Case:
    """Problem 1 of Land et al. (2015); 5 % too soft on a mesh this coarse."""
    mesh = to_quadratic(box((10.0, 1.0, 1.0), (20, 2, 2)))
    scene = guccione(
        mesh,
        along_x(mesh),
        loads=(FollowerPressure("bottom", 0.004),),
        supports=_CLAMPED,
        constants=_exponents(8.0, 2.0, 4.0, 1e4),
        dilatation="mean",
    )
    tip = int(np.argmin(np.linalg.norm(mesh.nodes - [10.0, 0.5, 1.0], axis=1)))
    return Case(
        scene,
        np.array([2.0]),
        claim=lambda u: near("height of the tip", 1.0 + u[tip, 2], 4.17, 0.07),
    )


@cache
def land_ellipsoid_scene(pressure: float) -> Scene:
    mesh = land_ventricle(rings=5, around=12, layers=1, order=2)
    return guccione(
        mesh,
        along_x(mesh),
        loads=(CavityPressure("endocardium", pressure),),
        supports=(Support("base"),),
        constants=_exponents(1.0, 1.0, 1.0, 1e5),
        dilatation="mean",
    )


@case("ventricles")
def land_ellipsoid() -> Case:
    """Problem 2 of Land et al. (2015), coarse."""
    scene = land_ellipsoid_scene(10.0)
    apex = int(scene.mesh.node_set("apex_endocardium")[0])
    height = scene.mesh.nodes[apex, 2]
    return Case(
        scene,
        np.array([10.0]),
        claim=lambda u: near("height of the apex", height + u[apex, 2], -26.53, 0.03),
    )


@case("ventricles")
def land_ellipsoid_three_times() -> Case:
    return Case(land_ellipsoid_scene(30.0), np.array([10.0]))


# ---- exponentials near overflow ----------------------------------------------------------------
def _pulled_fibres(law: str, stretch: float, constants: dict[str, float]) -> Scene:
    mesh = box((10.0, 5.0, 5.0), (4, 2, 2))
    parameters = (Parameter(*(("C", "kPa", 0.1, 10.0) if law == "guccione" else _A_BOX)),)
    ends = (Support("left"), Support("right", np.array([10.0 * (stretch - 1.0), 0.0, 0.0])))
    return Scene("fibres", mesh, find_law(law), parameters, (), ends, constants, along_x(mesh))


_A_BOX = ("a", "kPa", 0.1, 10.0)


@case("exponentials")
def holzapfel_ogden_b_200() -> Case:
    constants = {"b": 200.0, "a_f": 1.0, "b_f": 200.0, "kappa": 100.0}
    return Case(_pulled_fibres("holzapfel_ogden", 1.3, constants), np.array([1.0]))


@case("exponentials")
def holzapfel_ogden_b_1000_stretch_2() -> Case:
    constants = {"b": 1000.0, "a_f": 1.0, "b_f": 1000.0, "kappa": 100.0}
    return Case(_pulled_fibres("holzapfel_ogden", 2.0, constants), np.array([1.0]))


@case("exponentials")
def guccione_b_f_100() -> Case:
    scene = _pulled_fibres("guccione", 1.5, _exponents(100.0, 50.0, 50.0, 100.0))
    return Case(scene, np.array([1.0]))


@case("exponentials")
def guccione_b_f_100_stretch_3() -> Case:
    """Q reaches 1600: exp overflows at 710."""
    scene = _pulled_fibres("guccione", 3.0, _exponents(100.0, 50.0, 50.0, 100.0))
    return Case(scene, np.array([1.0]))


@case("exponentials")
def guccione_started_where_exp_overflows() -> Case:
    scene = replace(
        _pulled_fibres("guccione", 1.0, _exponents(100.0, 50.0, 50.0, 100.0)),
        supports=_CLAMPED,
        loads=(DOWN,),
    )
    start = np.where(scene.held, 0.0, scene.mesh.nodes * [3.0, 0.0, 0.0])
    return Case(scene, np.array([1.0]), start)


@case("exponentials")
def guccione_load_at_the_end_of_the_exponent() -> Case:
    """A traction so large that only Q near 700 balances it; no tissue carries it."""
    scene = replace(
        _pulled_fibres("guccione", 1.0, _exponents(20.0, 10.0, 10.0, 100.0)),
        supports=_CLAMPED,
        loads=(Traction("right", (1e12, 0.0, 0.0)),),
    )
    return Case(scene, np.array([1.0]))


# ---- twists ------------------------------------------------------------------------------------
def _twisted(degrees: float, *, started: bool) -> Case:
    mesh = box((40.0, 10.0, 10.0), (16, 4, 4))
    centre = np.array([0.0, 5.0, 5.0])
    right = mesh.node_set("right")
    scene = moved(
        bar(mesh=mesh), {"left": (0, 0, 0), "right": twist(mesh.nodes[right], centre, degrees)}
    )
    start = None
    if started:
        turn = degrees * mesh.nodes[:, 0] / 40.0
        start = np.vstack(
            [twist(x[None], centre, d) for x, d in zip(mesh.nodes, turn, strict=True)]
        )
        start = np.where(scene.held, scene.held_displacement, start)
    return Case(scene, moduli(), start)


for _degrees in (90, 180, 270, 360):
    CASES[f"twist_{_degrees}_from_rest"] = (
        "twists",
        partial(_twisted, float(_degrees), started=False),
    )
for _degrees in (180, 360, 540):
    CASES[f"twist_{_degrees}_started_twisted"] = (
        "twists",
        partial(_twisted, float(_degrees), started=True),
    )


@case("twists")
def twist_and_pull() -> Case:
    wrung = _twisted(120.0, started=False)
    support = wrung.scene.supports[1]
    assert isinstance(support, Support)
    shift = np.asarray(support.displacement) + np.array([40.0, 0.0, 0.0])
    return Case(moved(wrung.scene, {"left": (0, 0, 0), "right": shift}), moduli())


# ---- buckling ----------------------------------------------------------------------------------
def _column(shortening: float, tilt: float = 0.0) -> Case:
    """Slenderness 20, both ends clamped: Euler's critical shortening is 4 pi^2 / 1200 = 3.3 %."""
    scene = bar((100.0, 5.0, 5.0), (30, 2, 2))
    if tilt:
        nodes = scene.mesh.nodes.copy()
        nodes[:, 2] += tilt * np.sin(np.pi * nodes[:, 0] / 100.0) ** 2
        scene = replace(scene, mesh=replace(scene.mesh, nodes=nodes))
    scene = moved(scene, {"left": (0, 0, 0), "right": (-100.0 * shortening, 0, 0)})
    return Case(scene, moduli())


@case("buckling")
def column_perfect_10_percent() -> Case:
    return _column(0.10)


@case("buckling")
def column_perfect_40_percent() -> Case:
    return _column(0.40)


@case("buckling")
def column_imperfect_10_percent() -> Case:
    case = _column(0.10, tilt=0.5)
    middle = np.abs(case.scene.mesh.nodes[:, 0] - 50.0) < 1e-9

    def bulges(u: np.ndarray) -> str:
        deflection = np.linalg.norm(u[middle, 1:].mean(axis=0))
        return "" if deflection > 10.0 else f"deflection {deflection:.2f} mm: not the bent branch"

    return replace(case, claim=bulges)


@case("buckling")
def column_imperfect_40_percent() -> Case:
    return _column(0.40, tilt=0.5)


def _loaded_column(factor: float, side: float) -> Case:
    """Dead load on the free end of a cantilever, in units of Euler's pi^2 E I / 4 L^2."""
    mu = lam = 5.0
    E = mu * (3 * lam + 2 * mu) / (lam + mu)
    critical = np.pi**2 * E * 5.0**2 / 12.0 / 4.0 / 100.0**2  # kPa
    load = Traction("right", (-factor * critical, 0.0, side * critical))
    return Case(bar((100.0, 5.0, 5.0), (30, 2, 2), loads=(load,)), moduli(mu, lam))


@case("buckling")
def column_dead_load_twice_critical() -> Case:
    return _loaded_column(2.0, 0.0)


@case("buckling")
def column_dead_load_twice_critical_pushed() -> Case:
    return _loaded_column(2.0, 0.01)


@case("buckling")
def column_dead_load_twenty_times_critical() -> Case:
    return _loaded_column(20.0, 0.01)


@case("buckling")
def plate_one_element_thick_squeezed() -> Case:
    scene = bar((100.0, 50.0, 1.0), (24, 12, 1))
    return Case(moved(scene, {"left": (0, 0, 0), "right": (-5.0, 0, 0)}), moduli())


@case("buckling")
def plate_one_element_thick_hanging() -> Case:
    return Case(bar((100.0, 50.0, 1.0), (24, 12, 1), loads=(DOWN,)), moduli(1000.0, 1000.0))


@case("buckling")
def plate_one_element_thick_hanging_soft() -> Case:
    return Case(bar((100.0, 50.0, 1.0), (24, 12, 1), loads=(DOWN,)), moduli())


@case("buckling")
def arch_snaps_through() -> Case:
    """A shallow arch, ends held, pushed down past its limit point."""
    scene = bar((100.0, 10.0, 2.0), (30, 2, 1))
    nodes = scene.mesh.nodes.copy()
    nodes[:, 2] += 8.0 * np.sin(np.pi * nodes[:, 0] / 100.0)
    scene = replace(
        scene,
        mesh=replace(scene.mesh, nodes=nodes),
        supports=(Support("left"), Support("right")),
        loads=(Traction("top", (0.0, 0.0, -0.02)),),
    )
    return Case(scene, moduli())


# ---- follower loads and limit points -----------------------------------------------------------
def _follower_plate(pressure: float) -> Case:
    scene = bar((40.0, 20.0, 2.0), (16, 8, 2), loads=(FollowerPressure("bottom", pressure),))
    return Case(scene, moduli(50.0, 50.0))


@case("follower pressure")
def follower_plate() -> Case:
    return _follower_plate(0.02)


@case("follower pressure")
def follower_plate_curls_up() -> Case:
    return _follower_plate(0.2)


@case("follower pressure")
def follower_plate_far_too_much() -> Case:
    return _follower_plate(20.0)


def _sphere(pressure: float) -> Case:
    """Incompressible Neo-Hookean, A = 10 and B = 15 mm, mu = 10 kPa: it bursts at 4.935 kPa."""
    mesh = sphere_octant(10.0, 15.0, (4, 2), order=2)
    planes = tuple(Support(axis, components=axis) for axis in "xyz")
    loads = (FollowerPressure("inner", pressure),)
    scene = bar(mesh=mesh, supports=planes, loads=loads, dilatation="mean")

    def stretch(u: np.ndarray) -> str:
        inner = scene.mesh.node_set("inner")
        radius = float(np.linalg.norm((scene.mesh.nodes + u)[inner], axis=1).mean())
        p = sphere_pressure(radius / 10.0)
        if pressure > 4.935 * 1.02:
            return f"equilibrium at inner radius {radius:.2f} mm, where only {p:.3f} kPa is carried"
        return near("pressure of that radius", p, pressure, 0.02)

    return Case(scene, moduli(10.0, 1e5), claim=stretch)


def sphere_pressure(inner: float) -> float:
    """Pressure in kPa at inner stretch ``inner``: mu [g(outer) - g(inner)], g = 2/l + 1/(2 l^4)."""
    outer = (1.0 + (inner**3 - 1.0) * (10.0 / 15.0) ** 3) ** (1.0 / 3.0)
    g = lambda stretch: 2.0 / stretch + 0.5 / stretch**4  # noqa: E731
    return 10.0 * (g(outer) - g(inner))


@case("follower pressure")
def sphere_4_kPa() -> Case:
    return _sphere(4.0)


@case("follower pressure")
def sphere_just_below_its_limit() -> Case:
    return _sphere(4.85)


@case("follower pressure")
def sphere_beyond_its_limit() -> Case:
    return _sphere(5.2)


@case("follower pressure")
def sphere_twice_its_limit() -> Case:
    return _sphere(10.0)


@case("follower pressure")
def sphere_sucked() -> Case:
    return _sphere(-10.0)


# ---- stiffness ---------------------------------------------------------------------------------
def _scaled(modulus: float, density: float) -> Case:
    load = Gravity(density=density, direction=(0.0, 0.0, -1.0))
    return Case(bar(loads=(load,)), moduli(5.0 * modulus, 5.0 * modulus))


def _same_shape(modulus: float) -> Case:
    case = _scaled(modulus, modulus)

    def claim(u: np.ndarray) -> str:
        usual = _scaled(1.0, 1.0)
        wanted = np.asarray(Simulator(usual.scene).solve(usual.theta).displacement)
        gap = np.abs(u - wanted).max() / np.abs(wanted).max()
        return "" if gap < 1e-6 else f"differs from the unscaled solution by {gap:.1e}"

    return replace(case, claim=claim)


@case("stiffness")
def stiff_1e9_load_to_match() -> Case:
    return _same_shape(1e9)


@case("stiffness")
def soft_1e_9_load_to_match() -> Case:
    return _same_shape(1e-9)


@case("stiffness")
def stiff_1e9_usual_load() -> Case:
    case = _scaled(1e9, 1.0)

    def claim(u: np.ndarray) -> str:
        least = np.abs(u).max()
        return "" if 0.0 < least < 1e-6 else f"deflection {least:.1e} mm"

    return replace(case, claim=claim)


@case("stiffness")
def soft_1e_9_usual_load() -> Case:
    return _scaled(1e-9, 1.0)


@case("stiffness")
def soft_1e_3_usual_load() -> Case:
    return _scaled(1e-3, 1.0)


@case("stiffness")
def moduli_1e12_apart() -> Case:
    return Case(bar(loads=(DOWN,)), moduli(5.0, 5e12))


@case("stiffness")
def gravity_hundredfold() -> Case:
    return _scaled(1.0, 100.0)


@case("stiffness")
def gravity_hundredfold_single_step() -> Case:
    return replace(_scaled(1.0, 100.0), options=SINGLE_STEP)


# ---- supports ----------------------------------------------------------------------------------
def _on_springs(stiffness: float, face: str = "top") -> Case:
    scene = bar(
        (10.0, 10.0, 10.0),
        (3, 3, 3),
        loads=(DOWN,),
        supports=(ElasticSupport(face, stiffness),),
    )
    weight = 9.81e-3 * 1000.0  # mN

    def carried(u: np.ndarray) -> str:
        facets = scene.mesh.facet_set(face)
        sunk = -stiffness * float(u[facets, 2].mean()) * 100.0
        return near("force of the springs in mN", sunk, weight, 1e-4)

    return Case(scene, moduli(), claim=carried)


@case("supports")
def springs_1e_9() -> Case:
    return _on_springs(1e-9)


@case("supports")
def springs_1e_3() -> Case:
    return _on_springs(1e-3)


@case("supports")
def springs_1e_3_standing() -> Case:
    """Springs too soft for the body's weight: it topples and ends up hanging."""
    return _on_springs(1e-3, "bottom")


@case("supports")
def springs_1e12() -> Case:
    return _on_springs(1e12)


def _stretched(millimetres: float) -> Case:
    scene = bar((10.0, 10.0, 10.0), (4, 4, 4))
    return Case(moved(scene, {"left": (0, 0, 0), "right": (millimetres, 0, 0)}), moduli())


@case("supports")
def pulled_to_ten_times_its_length() -> Case:
    return _stretched(90.0)


@case("supports")
def pulled_to_a_thousand_times_its_length() -> Case:
    return _stretched(9990.0)


@case("supports")
def squeezed_to_half() -> Case:
    return _stretched(-5.0)


@case("supports")
def squeezed_to_a_hundredth() -> Case:
    return _stretched(-9.9)


@case("supports")
def squeezed_to_nothing() -> Case:
    return _stretched(-10.0)


@case("supports")
def pushed_through_itself() -> Case:
    return replace(_stretched(-25.0), claim=lambda _: "no such state exists")


@case("supports")
def traction_a_thousand_moduli() -> Case:
    return Case(bar(loads=(Traction("right", (5000.0, 0.0, 0.0)),)), moduli())


@case("supports")
def traction_pushing_a_thousand_moduli() -> Case:
    return Case(bar(loads=(Traction("right", (-5000.0, 0.0, 0.0)),)), moduli())


# ---- meshes ------------------------------------------------------------------------------------
@case("meshes")
def slivers() -> Case:
    mesh = jittered(box((40.0, 10.0, 10.0), (12, 4, 4)), 1.5)
    return Case(bar(mesh=mesh, loads=(DOWN,)), moduli())


@case("meshes")
def slivers_pulled() -> Case:
    mesh = jittered(box((40.0, 10.0, 10.0), (12, 4, 4)), 1.5)
    return Case(moved(bar(mesh=mesh), {"left": (0, 0, 0), "right": (40.0, 0, 0)}), moduli())


@case("meshes")
def slivers_quadratic() -> Case:
    mesh = to_quadratic(jittered(box((40.0, 10.0, 10.0), (8, 3, 3)), 1.5))
    return Case(bar(mesh=mesh, loads=(DOWN,)), moduli())


@case("meshes")
def elements_100_to_1() -> Case:
    return Case(bar((400.0, 4.0, 4.0), (4, 4, 4), loads=(DOWN,)), moduli(5e3, 5e3))


@case("meshes")
def elements_10000_to_1() -> Case:
    return Case(bar((4e4, 4.0, 4.0), (4, 4, 4), loads=(Gravity(1e-9),)), moduli(5e3, 5e3))


@case("meshes")
def one_cell() -> Case:
    return Case(bar((1.0, 1.0, 1.0), (1, 1, 1), loads=(Gravity(100.0),)), moduli())


@case("meshes")
def micrometre_and_kilometre() -> Case:
    """A body of 1e6 mm, with tolerances meant for millimetres."""
    return Case(bar((4e6, 1e6, 1e6), (8, 2, 2), loads=(Gravity(1e-6),)), moduli())


# ---- starts ------------------------------------------------------------------------------------
@cache
def cantilever() -> Scene:
    return bar(loads=(DOWN,))


@cache
def cantilever_solution() -> np.ndarray:
    return np.asarray(
        _simulator(cantilever(), NewtonOptions()).solve(moduli()).require_converged().displacement
    )


def as_from_rest(u: np.ndarray) -> str:
    gap = np.abs(u - cantilever_solution()).max()
    return "" if gap < 1e-6 else f"another answer than from rest, {gap:.1e} mm away"


def _started(start: Any) -> Case:
    return Case(cantilever(), moduli(), start, claim=as_from_rest)


@case("starts")
def start_inverted() -> Case:
    return _started(-2.0 * cantilever().mesh.nodes)


@case("starts")
def start_noise_a_tenth_of_an_element() -> Case:
    rng = np.random.default_rng(SEED)
    return _started(0.5 * rng.normal(size=cantilever().mesh.nodes.shape))


@case("starts")
def start_noise_of_an_element() -> Case:
    rng = np.random.default_rng(SEED)
    return _started(5.0 * rng.normal(size=cantilever().mesh.nodes.shape))


@case("starts")
def start_noise_of_a_metre() -> Case:
    rng = np.random.default_rng(SEED)
    return _started(1e3 * rng.normal(size=cantilever().mesh.nodes.shape))


@case("starts")
def start_turned_round() -> Case:
    """The body turned by half a turn about its axis, away from its support."""
    scene = cantilever()
    return _started(twist(scene.mesh.nodes, np.array([0.0, 5.0, 5.0]), 180.0))


@case("starts")
def start_stretched_a_hundredfold() -> Case:
    return _started(cantilever().mesh.nodes * [99.0, 0.0, 0.0])


@case("starts")
def start_nearly_flat() -> Case:
    return _started(cantilever().mesh.nodes * [-0.999, 0.0, 0.0])


@case("starts")
def start_opposite_load() -> Case:
    up = replace(cantilever(), loads=(Gravity(direction=(0.0, 0.0, 1.0)),))
    return _started(Simulator(up).solve(moduli()).displacement)


@case("starts")
def start_opposite_corner() -> Case:
    return _started(_simulator(cantilever(), NewtonOptions()).solve(moduli(1.0, 1.0)).displacement)


@case("starts")
def start_ten_times_the_load() -> Case:
    heavy = replace(cantilever(), loads=(Gravity(10.0),))
    return _started(Simulator(heavy).solve(moduli()).displacement)


@case("starts")
def start_of_NaN() -> Case:
    return _started(np.full(cantilever().mesh.nodes.shape, np.nan))


@case("starts")
def start_of_1e300() -> Case:
    return _started(np.full(cantilever().mesh.nodes.shape, 1e300))


@case("starts")
def start_in_float32() -> Case:
    return _started(jnp.asarray(cantilever_solution(), jnp.float32))


@case("starts")
def start_of_integers() -> Case:
    return _started(np.zeros(cantilever().mesh.nodes.shape, dtype=int))


@case("starts")
def start_of_the_wrong_shape() -> Case:
    return _started(np.zeros(3))


# ---- theta -------------------------------------------------------------------------------------
def _theta(*values: float) -> Case:
    return Case(cantilever(), np.array(values))


@case("theta")
def theta_in_float32() -> Case:
    return Case(cantilever(), jnp.asarray(moduli(), jnp.float32), claim=as_from_rest)


@case("theta")
def theta_with_NaN() -> Case:
    return _theta(5.0, np.nan)


@case("theta")
def theta_with_inf() -> Case:
    return _theta(np.inf, 5.0)


@case("theta")
def theta_zero() -> Case:
    return _theta(0.0, 0.0)


@case("theta")
def theta_zero_inside_jit() -> Case:
    return replace(_theta(0.0, 0.0), inside_jit=True)


@case("theta")
def theta_without_shear_stiffness_inside_jit() -> Case:
    return replace(_theta(0.0, 5.0), inside_jit=True)


@case("theta")
def theta_without_shear_stiffness() -> Case:
    return _theta(0.0, 5.0)


@case("theta")
def theta_without_volume_stiffness() -> Case:
    return _theta(5.0, 0.0)


def upwards(u: np.ndarray) -> str:
    return "" if u[:, 2].mean() <= 0.0 else "a hanging body that falls upwards"


@case("theta")
def theta_negative() -> Case:
    return replace(_theta(-5.0, -5.0), claim=upwards)


@case("theta")
def theta_slightly_negative_volume_stiffness() -> Case:
    return replace(_theta(5.0, -1.0), claim=upwards)


@case("theta")
def theta_1e300() -> Case:
    return _theta(1e300, 1e300)


@case("theta")
def theta_1e_300() -> Case:
    return _theta(1e-300, 1e-300)


@case("theta")
def theta_nu_half() -> Case:
    return Case(bar(engineering=True, loads=(DOWN,)), np.array([10.0, 0.5]))


@case("theta")
def theta_nu_minus_one() -> Case:
    return Case(bar(engineering=True, loads=(DOWN,)), np.array([10.0, -1.0]))


@case("theta")
def theta_nu_above_half() -> Case:
    scene = bar(engineering=True, loads=(DOWN,))
    return replace(Case(scene, np.array([10.0, 0.6])), claim=upwards)


@case("theta")
def theta_too_short() -> Case:
    return replace(_theta(5.0), claim=lambda _: "accepted one value for two parameters")


@case("theta")
def theta_too_long() -> Case:
    return replace(_theta(5.0, 5.0, 5.0), claim=lambda _: "accepted three values for two")


@cache  # cases share scenes, and each is compiled once
def _simulator(scene: Scene, options: NewtonOptions) -> Simulator:
    return Simulator(scene, options)


def solve(found: Case) -> tuple[Simulator, Any]:
    """The simulator's answer, computed when this returns."""
    simulator = _simulator(found.scene, found.options)
    call = jax.jit(simulator.solve) if found.inside_jit else simulator.solve
    solution = call(found.theta, found.start)
    return simulator, jax.block_until_ready(solution)
