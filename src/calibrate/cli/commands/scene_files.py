"""``calibrate init``, ``mesh``, ``scenes`` and ``schema``: scenes and their files."""

from __future__ import annotations

import argparse
import textwrap
from pathlib import Path
from typing import Any

from calibrate.cli.output import DONE, emit, table
from calibrate.cli.words import answer, check_vtu
from emulator.core.store import check_folder


def add_init(commands: Any) -> None:
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
    answer(parser, run_init)


def run_init(arguments: argparse.Namespace) -> int:
    """Write the scene file, and print what the mesh has."""
    from emulator.scenes.draft import draft_scene

    mesh_path = Path(arguments.mesh)
    out = arguments.out or mesh_path.parent / f"{mesh_path.stem or 'scene'}.toml"
    scene_file = draft_scene(arguments.mesh, out, unit=arguments.unit, law=arguments.law)
    path = scene_file.path
    mesh = scene_file.scene.mesh
    sets = {name: len(nodes) for name, nodes in mesh.node_sets.items()}
    facets = {name: len(rows) for name, rows in mesh.facet_sets.items()}
    result = {
        "out": str(path),
        "nodes": len(mesh.nodes),
        "elements": len(mesh.elements),
        "node_sets": sets,
        "facet_sets": facets,
        "law": scene_file.scene.law.name,
        "parameters": list(scene_file.scene.parameter_names),
        "notes": list(scene_file.notes),
    }
    lines = [
        f"{len(mesh.nodes)} nodes, {len(mesh.elements)} tetrahedra",
        f"sets: {', '.join(f'{n} ({k} facets)' for n, k in facets.items()) or 'none'}",
        *scene_file.notes,
        f"written to {path}; look for CHANGE in it, then: calibrate simulate {path}",
    ]
    emit(arguments, result, "\n".join(lines))
    return DONE


def add_mesh(commands: Any) -> None:
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
    answer(parser, run_mesh)


def run_mesh(arguments: argparse.Namespace) -> int:
    """Mesh the wall, and write the mesh and its picture."""
    from emulator.geometry.io import write_mesh
    from emulator.geometry.two_surfaces import mesh_wall

    check_vtu(arguments.out)
    if arguments.picture is not None:
        check_folder(Path(arguments.picture).parent)
    wall = mesh_wall(
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
    write_mesh(arguments.out, wall.mesh)
    result = {
        "out": arguments.out,
        "nodes": len(wall.mesh.nodes),
        "elements": len(wall.mesh.elements),
        "size": wall.size,
        "axis": wall.axis,
        "base": wall.base,
        "thickness": wall.thickness._asdict(),
        "cavity": dict(zip(("mesh", "surface"), wall.cavity, strict=True)),
        "wall": dict(zip(("mesh", "surface"), wall.wall, strict=True)),
        "cut_off": wall.cut_off,
        "moved": wall.moved,
        "quality": wall.quality._asdict(),
    }
    lines = [*wall.sentences(), f"written to {arguments.out}, then: calibrate init {arguments.out}"]
    if arguments.picture is not None:
        from calibrate.figures.drawing import save
        from calibrate.figures.evaluation import surface_figure

        title = f"{Path(arguments.out).stem}: {result['nodes']} nodes"
        figure = surface_figure(wall.mesh, wall.local_thickness(), title, "wall thickness (mm)")
        save(figure, arguments.picture)
        lines.append(f"picture: {arguments.picture}")
    emit(arguments, result, "\n".join(lines))
    return DONE


_WIDTH = 79


def add_scenes(commands: Any) -> None:
    """Add the command."""
    answer(commands.add_parser("scenes", help="what is built in"), run_scenes)


def run_scenes(arguments: argparse.Namespace) -> int:
    """List the built-in scenes and the emulators shipped for them."""
    from emulator.scenes import BUILT_IN
    from emulator.surrogates.emulator import shipped_for

    rows: list[dict[str, Any]] = []
    for name, make in sorted(BUILT_IN.items()):
        scene = make()
        rows.append(
            {
                "name": name,
                "nodes": len(scene.mesh.nodes),
                "elements": len(scene.mesh.elements),
                "law": scene.law.name,
                "parameters": [
                    {"name": p.name, "unit": p.unit, "low": p.low, "high": p.high, "scale": p.scale}
                    for p in scene.parameters
                ],
                "emulator_shipped": name in shipped_for(name),
                "emulators": shipped_for(name),
            }
        )
    emit(arguments, rows, _text(rows))
    return DONE


def _text(rows: list[dict[str, Any]]) -> str:
    """Return a line for each scene, and under it its parameters and shipped emulators."""
    head, *lines = table(
        ("scene", "nodes", "tetrahedra", "law"),
        [(r["name"], r["nodes"], r["elements"], r["law"]) for r in rows],
        _WIDTH,
    ).splitlines()
    text_lines = [head]
    for line, row in zip(lines, rows, strict=True):
        text_lines += [line, *_wrapped("parameters", _parameters(row["parameters"]))]
        text_lines += _wrapped("emulators", row["emulators"] or ["none shipped; train one"])
    return "\n".join(text_lines)


def _wrapped(name: str, entries: list[str]) -> list[str]:
    """Return ``entries`` after ``name``, on lines that fit a terminal, no entry on two."""
    indent, joined = f"  {name}  ", ", ".join(each.replace(" ", "\0") for each in entries)
    rest = " " * len(indent)
    lines = textwrap.wrap(joined, _WIDTH, initial_indent=indent, subsequent_indent=rest)
    return [line.replace("\0", " ") for line in lines]


def _parameters(parameters: list[dict[str, Any]]) -> list[str]:
    """Return names with their ranges; of numbered ones of one range, the first and the last."""
    groups: dict[tuple[str, str], list[str]] = {}
    for p in parameters:
        about = f"{p['low']:g} to {p['high']:g} {p['unit']}".strip()
        base = p["name"].rstrip("0123456789")
        key = base if base.endswith("_") and base != p["name"] else p["name"]
        groups.setdefault((key, about), []).append(p["name"])
    return [
        f"{names[0]} ... {names[-1]} {about}" if len(names) > 1 else f"{names[0]} {about}"
        for (_, about), names in groups.items()
    ]


_FILES = ("scene", "experiment")


def add_schema(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "schema",
        help="JSON Schema of scene or experiment files, for editors",
        description="Prints the JSON Schema of scene files: their keys, kinds of laws, loads and "
        "supports, with units and descriptions; or of experiment files: kinds of noise, systematic "
        "errors, forward maps and samplers. Editors complete and check a file that begins "
        "with the line '#:schema ./scene.schema.json'.",
        epilog="examples: calibrate schema > scene.schema.json; "
        "calibrate schema experiment > experiment.schema.json",
    )
    parser.add_argument(
        "file", nargs="?", choices=_FILES, default="scene", help="kind of file (default: scene)"
    )
    answer(parser, run_schema)


def run_schema(arguments: argparse.Namespace) -> int:
    """Print the schema, which is JSON with and without ``--json``."""
    from emulator.core.store import to_json

    schema = _schema(arguments.file)
    emit(arguments, schema, to_json(schema))
    return DONE


def _schema(file: str) -> dict[str, Any]:
    if file == "scene":
        from emulator.scenes.file_schema import scene_schema

        return scene_schema()
    from calibrate.project.experiment_schema import experiment_schema

    return experiment_schema()
