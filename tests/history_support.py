"""A cube that goes through a history, in a scene file beside its mesh."""

import meshio

from emulator.geometry.generators.box import box

CUBE = """
law = "neo_hookean_split"
mesh = "cube.vtu"
history = "history.csv"
viscosity = {kind = "prony"}
node_sets = {left = {axis = "x", at = 0.0}, front = {axis = "y", at = 0.0}, floor = {axis = "z", \
at = 0.0}, end = {axis = "x", at = 1.0}}
facet_sets = {right = {axis = "x", at = 1.0}}
[[supports]]
node_set = "left"
components = "x"
[[supports]]
node_set = "front"
components = "y"
[[supports]]
node_set = "floor"
components = "z"
"""
BY_GRIP = """
[[supports]]
node_set = "end"
components = "x"
displacement = [0.2, 0.0, 0.0]
amount = "pull"
"""


def write_cube(folder, scene, table):
    """Write mesh, history and scene file; return the path of the latter."""
    mesh = box((1.0, 1.0, 1.0), (1, 1, 1), 1)
    meshio.write(folder / "cube.vtu", meshio.Mesh(mesh.nodes, [("tetra", mesh.elements)]))
    (folder / "history.csv").write_text(table)
    (folder / "cube.toml").write_text(scene)
    return folder / "cube.toml"
