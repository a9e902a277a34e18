"""Meshes in from files, deformed bodies out to VTU, through meshio."""

from __future__ import annotations

import io
from collections.abc import Mapping
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import meshio
import numpy as np

from emulator.errors import InputError
from emulator.geometry.mesh import Mesh
from emulator.store import replacing


def read_mesh(path: str | Path) -> Mesh:
    """Linear tetrahedra from any file meshio reads, lengths taken as mm.

    Raises
    ------
    InputError
        Missing or unreadable file, no tetrahedra, or a mesh :class:`Mesh` refuses.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"mesh file {path} does not exist")
    said = io.StringIO()
    try:
        # meshio's readers raise whatever they meet, or print and exit.
        with redirect_stdout(said), redirect_stderr(said):
            found = meshio.read(path)
    except (Exception, SystemExit) as error:
        reason = said.getvalue() if isinstance(error, SystemExit) else str(error)
        reason = " ".join(reason.split())[:160] or type(error).__name__
        raise InputError(f"mesh file {path} cannot be read as a mesh: {reason}") from error
    kinds = sorted({block.type for block in found.cells})
    tetrahedra = [block.data for block in found.cells if block.type == "tetra"]
    if not tetrahedra:
        raise InputError(f"mesh file {path} has no linear tetrahedra, only {', '.join(kinds)}")
    other = [kind for kind in kinds if kind not in ("tetra", "triangle", "line", "vertex")]
    if other:
        raise InputError(f"mesh file {path} also has {', '.join(other)}; only tetra is supported")
    return Mesh(found.points, np.concatenate(tetrahedra))


def write_displacement(
    path: str | Path, mesh: Mesh, displacement: np.ndarray, cells: Mapping[str, np.ndarray] = {}
) -> None:
    """Write mesh, displacement (n, 3) mm and cell data (m, ...) as VTU, whole or not at all."""
    output = meshio.Mesh(
        mesh.nodes,
        [("tetra", mesh.elements)],
        point_data={"displacement": np.asarray(displacement)},
        cell_data={name: [np.asarray(values)] for name, values in cells.items()},
    )
    with replacing(path) as temporary:
        meshio.write(temporary, output, file_format="vtu")
