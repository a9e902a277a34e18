"""The monoventricular case of Arostica et al. (2025): ellipsoid, fibres, curves, numbers; SI units.

It needs NumPy only (and Gmsh for the mesh), so that another program's interpreter reads it, too.
The wall lies between the ellipsoids that :func:`radii` has at t = 0 and 1; its long axis is x, with
the apex at x > 0.
"""

import numpy as np

BASE = -0.01  # m, where the wall is cut
SHORT, LONG = (0.025, 0.035), (0.090, 0.097)  # radii of endocardium and epicardium, m
HELIX = (-60.0, 60.0)  # degrees
POINTS = {"p0": (0.025, 0.03, 0.0), "p1": (0.0, 0.03, 0.0)}
SURFACES = ("endo", "epi", "top")
LAW = {
    "a": 59.0, "b": 8.023, "a_f": 18472.0, "b_f": 16.026, "a_s": 2481.0, "b_s": 11.12,
    "a_fs": 216.0, "b_fs": 11.436,
}  # fmt: skip
BULK, ETA, DENSITY, SWITCH = 1e6, 100.0, 1000.0, 100.0  # Pa, Pa s, kg/m3, 1
TOP, EPI = (1e5, 5e3), (1e8, 5e3)  # springs Pa/m and dashpots Pa s/m; along the normal on epi


def radii(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Short and long radius at the share t of the way through the wall."""
    short, long = (inner + (outer - inner) * t for inner, outer in (SHORT, LONG))
    return short, long


def depth(x: np.ndarray) -> np.ndarray:
    """The share t (...) of the way through the wall at points x (..., 3), by bisection."""
    low, high = np.full(x.shape[:-1], -0.5), np.full(x.shape[:-1], 1.5)
    for _ in range(60):
        t = 0.5 * (low + high)
        short, long = radii(t)
        outside = (x[..., 0] / long) ** 2 + (x[..., 1] ** 2 + x[..., 2] ** 2) / short**2 > 1.0
        low, high = np.where(outside, t, low), np.where(outside, high, t)
    return 0.5 * (low + high)


def directions(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fibres and sheets (..., 3) at points x (..., 3) of the wall."""
    t = depth(x)
    short, long = radii(t)
    across = np.hypot(x[..., 1], x[..., 2])
    u = np.arctan2(across / short, x[..., 0] / long)
    v = np.arctan2(x[..., 2], x[..., 1])
    out = short * np.cos(u)
    slopes = [-long * np.sin(u), out * np.cos(v), out * np.sin(v)]
    turns = [np.zeros_like(v), -np.sin(v), np.cos(v)]
    down, around = (_unit(np.stack(of, axis=-1)) for of in (slopes, turns))
    angle = np.radians(HELIX[0] + (HELIX[1] - HELIX[0]) * t)[..., None]
    fibre = np.sin(angle) * down + np.cos(angle) * around
    return fibre, _unit(np.cross(fibre, np.cross(down, around)))


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def curves(times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Tension and pressure in Pa at ``times`` (m,) in s, by their equations in small steps."""
    fine = np.linspace(0.0, times[-1], 20001)
    h, tension, pressure = fine[1], np.zeros(20001), np.zeros(20001)

    def step(t: float, at: float, sign: float) -> float:
        return 0.5 * (1.0 + sign * np.tanh((t - at) / 0.005))

    for k, t in enumerate(fine[:-1]):
        beats = step(t, 0.16, 1.0) * step(t, 0.484, -1.0)
        a = 5.0 * beats - 30.0 * (1.0 - beats)
        rate = -abs(a) * tension[k] + 1.5e5 * max(a, 0.0)
        tension[k + 1] = tension[k] + h * rate
        filled = step(t, 0.484, -1.0)
        ejects = step(t, 0.17, 1.0) * filled
        b = 5.0 * ejects - 30.0 * (1.0 - ejects) + 5.0 * filled + 1.0
        rate = -abs(b) * pressure[k] + 16000.0 * max(b, 0.0) + 7000.0 * filled
        pressure[k + 1] = pressure[k] + h * rate
    return np.interp(times, fine, tension), np.interp(times, fine, pressure)


def write_mesh(path: str, size: float) -> None:
    """Write the wall as linear tetrahedra of ``size`` m, its surfaces being physical groups."""
    import gmsh

    gmsh.initialize()
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        occ = gmsh.model.occ
        shells = []
        for short, long in zip(SHORT, LONG, strict=True):
            ball = occ.addSphere(0.0, 0.0, 0.0, 1.0)
            occ.dilate([(3, ball)], 0.0, 0.0, 0.0, long, short, short)
            shells.append((3, ball))
        wall, _ = occ.cut([shells[1]], [shells[0]])
        kept = occ.addBox(BASE, -1.0, -1.0, 2.0, 2.0, 2.0)
        wall, _ = occ.intersect(wall, [(3, kept)])
        occ.synchronize()
        gmsh.option.setNumber("Mesh.MeshSizeMin", size)
        gmsh.option.setNumber("Mesh.MeshSizeMax", size)
        gmsh.model.mesh.generate(2)
        groups: dict[str, list[int]] = {name: [] for name in SURFACES}
        for _, surface in gmsh.model.getEntities(2):
            nodes = np.reshape(gmsh.model.mesh.getNodes(2, surface)[1], (-1, 3))
            inner = np.median(depth(nodes)) < 0.5
            name = "top" if np.ptp(nodes[:, 0]) < 1e-6 else "endo" if inner else "epi"
            groups[name].append(surface)
        for name, surfaces in groups.items():
            gmsh.model.addPhysicalGroup(2, surfaces, name=name)
        gmsh.model.addPhysicalGroup(3, [tag for _, tag in wall], name="wall")
        gmsh.option.setNumber("Mesh.MshFileVersion", 2.2)
        gmsh.model.mesh.generate(3)
        gmsh.write(path)
    finally:
        gmsh.finalize()
