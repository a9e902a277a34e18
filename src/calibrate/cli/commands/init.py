"""``calibrate init``: a first scene file for a mesh."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from calibrate.cli.common import DONE, emit


def register(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "init",
        help="a first scene file for your mesh",
        description="Reads a mesh (gmsh, VTU and whatever meshio reads), says which sets it has, "
        "guesses from their names and from its size, says so, and writes a commented scene file.",
        epilog="example: calibrate init ventricle.msh, then calibrate simulate ventricle.toml",
    )
    parser.add_argument("mesh", metavar="MESH", help="mesh file of tetrahedra")
    parser.add_argument(
        "--out", metavar="FILE.toml", help="scene file to write (default: beside the mesh)"
    )
    parser.add_argument(
        "--unit", metavar="mm|cm|m", help="of the mesh's coordinates (default: guessed, and said)"
    )
    parser.add_argument("--law", metavar="NAME", help="default: by whether there are fibres")


def run(arguments: argparse.Namespace) -> int:
    """Write the scene file."""
    from emulator.scenes.draft import draft

    beside = Path(arguments.mesh)
    out = arguments.out or beside.parent / f"{beside.stem or 'scene'}.toml"
    made = draft(arguments.mesh, out, unit=arguments.unit, law=arguments.law)
    mesh = made.scene.mesh
    sets = {name: len(nodes) for name, nodes in mesh.node_sets.items()}
    facets = {name: len(rows) for name, rows in mesh.facet_sets.items()}
    result = {
        "out": str(made.path),
        "nodes": len(mesh.nodes),
        "elements": len(mesh.elements),
        "node_sets": sets,
        "facet_sets": facets,
        "law": made.scene.law.name,
        "parameters": list(made.scene.parameter_names),
        "notes": list(made.notes),
    }
    lines = [
        f"{len(mesh.nodes)} nodes, {len(mesh.elements)} tetrahedra",
        f"sets: {', '.join(f'{n} ({k} facets)' for n, k in facets.items()) or 'none'}",
        *made.notes,
        f"written to {made.path}; look for CHANGE in it, then: calibrate simulate {made.path}",
    ]
    emit(result, as_json=arguments.json, text="\n".join(lines))
    return DONE
