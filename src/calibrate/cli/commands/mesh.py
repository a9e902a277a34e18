"""``calibrate mesh``: a ventricle's wall between two surfaces."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from calibrate.cli.common import DONE, check_vtu, emit


def register(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "mesh",
        help="tetrahedra between the two surfaces of a left ventricle",
        description="Cuts both surfaces at the base, meshes the wall between them by Gmsh and "
        "names endocardium, epicardium and base, for calibrate init. Surfaces are STL, PLY or OBJ: "
        "open at the base, or closed, with --axis and a base plane.",
        epilog="example: calibrate mesh --endocardium endo.stl --epicardium epi.stl --out lv.vtu, "
        "then calibrate init lv.vtu",
    )
    for name in ("endocardium", "epicardium"):
        parser.add_argument(f"--{name}", required=True, metavar="FILE", help="triangles")
    parser.add_argument("--out", required=True, metavar="FILE.vtu", help="mesh to write, in mm")
    parser.add_argument(
        "--size", type=float, metavar="MM", help="edges (default: 0.7 of the median thickness)"
    )
    parser.add_argument(
        "--order", type=int, default=2, choices=(1, 2), help="of the elements (default: 2, curved)"
    )
    three = {"nargs": 3, "type": float, "metavar": ("X", "Y", "Z")}
    parser.add_argument(
        "--axis", **three, help="from apex to base, across the base plane (default: by the rims)"
    )
    parser.add_argument(
        "--base-height", type=float, metavar="MM", help="of the base plane along the axis"
    )
    parser.add_argument("--base-point", **three, help="a point of the base plane instead, mm")
    parser.add_argument(
        "--smooth",
        type=int,
        default=0,
        metavar="N",
        help="times of Taubin's filter; 20 for surfaces of voxels (default: 0)",
    )
    parser.add_argument(
        "--unit", default="mm", metavar="mm|cm|m", help="of the surfaces' coordinates (default: mm)"
    )
    parser.add_argument("--picture", metavar="FILE.png", help="the mesh, by the wall's thickness")


def run(arguments: argparse.Namespace) -> int:
    """Write the mesh, and the picture."""
    from emulator.core.store import check_folder
    from emulator.geometry.io import write_mesh
    from emulator.geometry.two_surfaces import mesh_wall

    check_vtu(arguments.out)
    if arguments.picture is not None:
        check_folder(Path(arguments.picture).parent)
    made = mesh_wall(
        arguments.endocardium,
        arguments.epicardium,
        size=arguments.size,
        order=arguments.order,
        axis=arguments.axis,
        base_height=arguments.base_height,
        base_point=arguments.base_point,
        smooth=arguments.smooth,
        unit=arguments.unit,
    )
    write_mesh(arguments.out, made.mesh)
    result = {
        "out": arguments.out,
        "nodes": len(made.mesh.nodes),
        "elements": len(made.mesh.elements),
        "size": made.size,
        "axis": made.axis,
        "base": made.base,
        "thickness": made.thickness._asdict(),
        "cavity": dict(zip(("mesh", "surface"), made.cavity, strict=True)),
        "wall": dict(zip(("mesh", "surface"), made.wall, strict=True)),
        "cut_off": made.cut_off,
        "moved": made.moved,
        "quality": made.quality._asdict(),
    }
    lines = [*made.sentences(), f"written to {arguments.out}, then: calibrate init {arguments.out}"]
    if arguments.picture is not None:
        from calibrate.figures.drawing import save
        from calibrate.figures.evaluation import surface_figure

        title = f"{Path(arguments.out).stem}: {result['nodes']} nodes"
        figure = surface_figure(made.mesh, made.local_thickness(), title, "wall thickness (mm)")
        save(figure, arguments.picture)
        lines.append(f"picture: {arguments.picture}")
    emit(result, as_json=arguments.json, text="\n".join(lines))
    return DONE
