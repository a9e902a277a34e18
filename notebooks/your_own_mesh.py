# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Your own mesh
#
# From a mesh of Gmsh, in the unit and with the names that somebody else chose, to a scene that has been checked, a picture of
# it, and an emulator. Nothing here needs Gmsh itself: a file of its format is enough. The steps are
#
# 1. see what the file holds,
# 2. draft a scene file, and read what was guessed,
# 3. check geometry, fibres and supports,
# 4. solve, and check the solution against a number worked out by hand,
# 5. ask whether the mesh is fine enough,
# 6. train an emulator.

# %%
from collections import Counter
from dataclasses import replace
from pathlib import Path

import jax
import matplotlib.pyplot as plt
import meshio
import numpy as np
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

import emulator as em

# %% [markdown]
# ## 1. A mesh file
#
# With a segmented heart you would mesh its walls in Gmsh and give three surfaces *physical groups*. The cell below stands for
# that work. It takes an ellipsoidal wall, bends it so that the apex points to one side, scales it to centimetres and writes
# Gmsh's format. Bending shifts every cross-section within its own plane, so it changes no volume; we use that below.

# %%
wall = em.generators.human_ventricle(8, 16, 2)
x, y, z = wall.nodes.T
along = (z - z.max()) / (z.min() - z.max())  # 0 at the base, 1 at the apex
bent = np.stack([x + 15.0 * along**2, y, z], axis=1)  # mm
groups = {"LV_endo": "endocardium", "LV_epi": "epicardium", "LV_base": "base"}
facets = {name: wall.facet_sets[ours] for name, ours in groups.items()}
em.write_mesh("patient.msh", replace(wall, nodes=bent / 10.0, node_sets={}, facet_sets=facets))

# %% [markdown]
# What a file must hold: tetrahedra, and triangles in named groups. meshio shows both, whatever the format (`.msh`, `.vtu`,
# `.xdmf`, Abaqus, ...).

# %%
found = meshio.read("patient.msh")
cells: Counter[str] = Counter()
for block in found.cells:
    cells[block.type] += len(block.data)
print(dict(cells))
for name, (tag, dimension) in found.field_data.items():
    count = sum(int((tags == tag).sum()) for tags in found.cell_data["gmsh:physical"])
    print(f"group {name:8s} tag {tag}, dimension {dimension}, {count} triangles")
low, high = found.points.min(axis=0), found.points.max(axis=0)
print("extent:", (high - low).round(2), "in a unit that the file does not name")

# %% [markdown]
# ## 2. A first scene file
#
# `draft` (on the command line `calibrate init`) recognises groups by their names and writes a scene file. It says what it
# guessed. Read this list: a program cannot know your unit.

# %%
guess = em.draft_scene("patient.msh", "guess.toml")
print(*guess.notes, sep="\n")

# %% [markdown]
# The first line is wrong. A heart of 8.5 mm would be a mouse's. The unit is cm, and saying so writes the mesh again in mm.

# %%
made = em.draft_scene("patient.msh", "patient.toml", unit="cm")
print(*made.notes, sep="\n")
print()
print(Path("patient.toml").read_text())

# %% [markdown]
# `order = 2` puts a node on every edge: the file's linear tetrahedra lock, as section 5 shows.
#
# The file is yours to edit. The priors of the parameters are published values, with their source; lines marked `CHANGE` were
# guessed; `axis` is the direction from apex to base. A misspelt key or set is refused in one line that names what is there:

# %%
text = Path("patient.toml").read_text()
Path("wrong.toml").write_text(
    text.replace('facet_set = "LV_endo"\n# press', 'facet_set = "endo"\n# press')
)
try:
    em.find_scene("wrong.toml")
    message = ""
except em.InputError as error:
    message = str(error)
print(message)
assert "'endo'" in message

# %% [markdown]
# ## 3. Is it the body you meant?
#
# A volume is the best first check: it scales with the cube of a wrong unit, and you know it from the images. Here we know it in
# closed form, for bending has not changed it. The facets of a coarse mesh cut a few percent off.

# %%
scene = em.find_scene("patient.toml")
scene

# %%
cavity = em.geometry.Cavity(scene.mesh, "LV_endo")
exact = em.generators.HUMAN.cavity_volume / 1000.0
print(f"cavity {cavity.rest:.1f} mL, of the ellipsoid {exact:.1f} mL")
assert 0.95 < cavity.rest / exact < 1.0

corners = scene.mesh.nodes[scene.mesh.corners]
volumes = np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6.0
edges = np.linalg.norm(corners[:, [0, 0, 0, 1, 1, 2]] - corners[:, [1, 2, 3, 2, 3, 3]], axis=-1)
quality = 6.0 * np.sqrt(2.0) * volumes / np.sqrt((edges**2).mean(axis=1)) ** 3  # 1: regular
print(f"element quality: smallest {quality.min():.2f}, median {np.median(quality):.2f}")
assert quality.min() > 0.1

# %% [markdown]
# Quality is 1 for a regular tetrahedron and 0 for a flat one. Below about 0.1, mend the mesh before you look at any result.
#
# Now look at the groups and the fibres. Are the colours where their names say? The rule of the scene file lays fibres in the
# wall, at an angle to the circumference that falls from 60 degrees inside to -60 outside. We measure that angle with vectors
# of our own.

# %%
deep = em.geometry.wall_depth(
    scene.mesh, ("LV_endo",), ("LV_epi",)
)  # 0 inside, 1 outside, and the normal
around = np.cross([0.0, 0.0, 1.0], deep.normal)
around /= np.linalg.norm(around, axis=-1, keepdims=True)
upwards = np.cross(deep.normal, around)
sine = np.sum(scene.fibres * upwards, axis=-1)  # at each of an element's four points
cosine = np.sum(scene.fibres * around, axis=-1)
angle = np.degrees(np.arctan(sine / cosine))
assert np.abs(angle - (60.0 - 120.0 * deep.value)).max() < 1e-6


def view(axes, nodes, title):
    low, high = nodes.min(axis=0) - 2.0, nodes.max(axis=0) + 2.0
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set(xlabel="x (mm)", ylabel="y (mm)", zlabel="z (mm)", title=title)
    axes.set_box_aspect(high - low)
    axes.tick_params(labelsize=7)


colours = {"LV_endo": "#D55E00", "LV_epi": "#56B4E9", "LV_base": "#F0E442"}
figure = plt.figure(figsize=(7.2, 3.3), layout="constrained")
left = figure.add_subplot(121, projection="3d", azim=-80.0, elev=25.0)
triangles, shades = [], []
for name, colour in colours.items():
    corner = scene.mesh.nodes[scene.mesh.facet_sets[name][:, :3]]
    corner = corner[corner.mean(axis=1)[:, 1] > 0.0]  # the half behind the long axis
    triangles += list(corner)
    shades += [colour] * len(corner)
    left.plot([], [], "s", color=colour, label=name)
left.add_collection3d(Poly3DCollection(triangles, facecolors=shades, edgecolor="0.3", lw=0.2))
view(left, scene.mesh.nodes, "groups, front half cut away")
left.legend(loc="lower left", fontsize=8, frameon=False)
right = figure.add_subplot(122)
right.plot([0, 1], [60, -60], color="0.6", lw=3, label="asked for")
right.plot(
    deep.value.ravel(), angle.ravel(), ".", color="#0072B2", ms=2, label="points of elements"
)
right.set(xlabel="depth in the wall (0 inside, 1 outside)", ylabel="helix angle (degrees)")
right.legend(frameon=False)
plt.show()

# %% [markdown]
# ## 4. A solution, and a number to hold it against
#
# The scene is solved at the centre of the parameters' box.

# %%
simulator = em.Simulator(scene)
theta = scene.centre
for parameter, value in zip(scene.parameters, theta, strict=True):
    print(f"{parameter.name:9s}{float(value):6.3f} {parameter.unit}")
solution = simulator.solve(theta)
u = np.asarray(solution.displacement)
print(em.fem.Status(int(solution.status)).text, "in", int(solution.iterations), "iterations")
print(f"cavity {cavity.rest:.1f} mL -> {float(cavity(u[cavity.nodes])):.1f} mL")

# %% [markdown]
# *Converged* means that forces balance inside the program. Here is a balance from outside it. The forces of the tissue are the
# gradient of its strain energy. The pressure pushes each deformed triangle of the cavity along its normal; a dozen lines of NumPy
# share that among the triangle's six nodes by their shape functions. At every free node the two must be equal.

# %%
moved = scene.mesh.nodes + u
pressure = float(theta[scene.parameter_names.index("pressure")])
tissue = np.asarray(
    jax.jit(jax.grad(em.fem.strain_energy(scene)))(solution.displacement, theta)
)  # mN
wall_facets = scene.mesh.facet_sets["LV_endo"]  # ordered so that their normals leave the tissue
# Dunavant's six points of a triangle, exact to degree 4, barycentric; weights sum to 1.
p = np.array(
    [
        np.roll([1 - 2 * c, c, c], k)
        for c in (0.445948490915965, 0.091576213509771)
        for k in range(3)
    ]
)
weights = np.repeat([0.223381589678011, 0.109951743655322], 3)
following = [1, 2, 0]
shapes = np.hstack([p * (2 * p - 1), 4 * p * p[:, following]])  # corners; middles of 01, 12, 20
slopes = np.zeros((6, 6, 3))  # of each shape function in each coordinate
for k, after in enumerate(following):
    slopes[:, k, k] = 4 * p[:, k] - 1
    slopes[:, 3 + k, k], slopes[:, 3 + k, after] = 4 * p[:, after], 4 * p[:, k]
one, other = (
    np.einsum("qa,kai->kqi", slopes[..., k] - slopes[..., 0], moved[wall_facets]) for k in (1, 2)
)
area = 0.5 * np.cross(one, other)  # mm2, a vector at each point
load = np.zeros_like(moved)
np.add.at(load, wall_facets, -pressure * np.einsum("q,qa,kqi->kai", weights, shapes, area))
base = scene.mesh.node_sets["LV_base"]
free = np.setdiff1d(np.arange(len(moved)), base)
gap = np.abs(tissue - load)[free].max()
print(f"largest force out of balance: {gap:.1e} mN, largest load {np.abs(load).max():.1f} mN")
assert gap < 1e-5 * np.abs(load).max()

# %% [markdown]
# And a number for the back of an envelope. The pressure on the wall and on a lid over the opening would cancel, for they act on
# a closed surface. So the base holds the heart with the force $p A$, where $A$ is the area of the opening, a polygon that any
# mesh viewer measures.

# %%
held = (tissue - load)[base].sum(axis=0)
rim = np.intersect1d(wall_facets, base)
rx, ry, _ = (scene.mesh.nodes[rim] - scene.mesh.nodes[rim].mean(axis=0)).T
turn = np.argsort(np.arctan2(ry, rx))
rx, ry = rx[turn], ry[turn]
opening = 0.5 * abs(rx @ np.roll(ry, 1) - ry @ np.roll(rx, 1))  # mm2, the shoelace formula
print(f"force of the base {held.round(2)} mN; pressure times area {pressure * opening:.2f} mN")
assert np.abs(held - [0.0, 0.0, pressure * opening]).max() < 1e-5 * pressure * opening

# %%
half = em.geometry.boundary_facets(scene.mesh.elements[corners.mean(axis=1)[:, 1] > 0.0])[:, :3]
size = np.linalg.norm(u, axis=1)
figure = plt.figure(figsize=(7.2, 3.3), layout="constrained")
both = np.concatenate([scene.mesh.nodes, moved])
for k, (nodes, values, title) in enumerate(
    [(scene.mesh.nodes, 0.0 * size, "at rest"), (moved, size, "filled")]
):
    axes = figure.add_subplot(1, 2, k + 1, projection="3d", azim=-80.0, elev=25.0)
    shades = values[half].mean(axis=1)
    body = Poly3DCollection(nodes[half], array=shades, cmap="viridis", edgecolor="0.3", lw=0.15)
    body.set_clim(0.0, size.max())
    axes.add_collection3d(body)
    view(axes, both, title)
figure.colorbar(body, ax=figure.axes, label="displacement (mm)", shrink=0.7)
plt.show()

# %% [markdown]
# ## 5. Is the mesh fine enough?
#
# Linear tetrahedra are too stiff in tissue that hardly changes its volume: they *lock*, and a mesh that is too stiff is paid
# for with inferred stiffnesses that are too low. Here is the file's mesh as it was, and beside it what is left of the error of
# the quadratic one: its own tetrahedra cut in eight are the next finer mesh of the same body. Compare both with your
# measurement's noise.

# %%
Path("linear.toml").write_text(Path("patient.toml").read_text().replace("order = 2", "order = 1"))
stiff = em.find_scene("linear.toml")
locked = em.Simulator(stiff).solve(theta).require_converged("linear elements").displacement
plain = em.geometry.Cavity(stiff.mesh, "LV_endo")
mesh_error = em.mesh_error(simulator)
finest = em.geometry.Cavity(mesh_error.finer.scene.mesh, "LV_endo")
of_mesh = mesh_error(theta)
growth = {
    "linear": (stiff, float(plain(locked[plain.nodes])) - plain.rest),
    "quadratic": (scene, float(cavity(u[cavity.nodes])) - cavity.rest),
    "quadratic, finer": (
        mesh_error.finer.scene,
        float(finest(of_mesh.fine[finest.nodes])) - finest.rest,
    ),
}
for name, (body, grown) in growth.items():
    print(f"{name:17s}{len(body.mesh.nodes):6d} nodes, the cavity grows by {grown:.1f} mL")
print(f"of displacements the mesh's error is {float(np.median(of_mesh.err_u)):.2f} mm (median)")
assert growth["linear"][1] < 0.8 * growth["quadratic"][1]  # it locks
assert abs(growth["quadratic, finer"][1] - growth["quadratic"][1]) < 5.0

# %% [markdown]
# On the command line, `calibrate check mesh patient.toml --observe volume`. A certificate asks the finer mesh, too, at the draws of
# your posterior.
#
# ## 6. An emulator of it
#
# The recipe `mechanics` takes a Taylor series of the equilibrium at the centre of the box, and corrects it by FEM runs with
# their derivatives. Its defaults are a series of order 3 and 60 runs. Order 2 and 30 runs are quicker here.

# %%
plan = replace(em.recipe("mechanics"), order=2, simulations=30)
emulator = em.train(scene, plan, "training")
print(f"trained in {emulator.record['seconds']:.0f} s")
reference = em.fem_reference(simulator, 12)  # theta that it has not seen
errors = em.evaluate(emulator.cache(), reference.thetas, reference.displacement)
for name in ("max_u", "err_u", "err_V"):
    print(name, {k: float(f"{v:.2g}") for k, v in errors[name].items()}, errors["units"][name])
assert errors["err_u"]["median"] < 0.05

# %% [markdown]
# Read both ends. The median error is far below what an image resolves. The largest is in the softest corner of the box, where
# the heart moves most. More runs lower it; whether it matters for your data is the question that `cal.certify` answers, at the
# draws of your posterior.
#
# `em.save_emulator(emulator, "folder")` keeps the emulator. The next steps are those of the first notebook: observe, model,
# sample, certify.
