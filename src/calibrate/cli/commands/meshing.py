"""``calibrate mesh``: tetrahedra within surfaces of a heart or an organ, or of labels."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path
from typing import Any

from calibrate.cli import words
from calibrate.cli.words import Answer, command, option
from emulator.core.errors import InputError
from emulator.core.store import check_folder

_PLACE = {"nargs": 3, "type": float, "metavar": ("X", "Y", "Z")}


@command(
    option("--endocardium", "FILE", "triangles"),
    option("--epicardium", "FILE", "triangles"),
    option(
        "--right",
        "FILE",
        "right ventricle's endocardium, where the epicardium wraps both ventricles",
    ),
    option(
        "--ventricles",
        choices=("both", "left"),
        help="of a heart with --right: mesh both, or the left wall alone (default: both)",
    ),
    option("--surface", "FILE", "triangles around a whole body, such as an organ, instead"),
    option(
        "--image",
        "FILE",
        "labels instead, NIfTI (.nii, .nii.gz) or NRRD: of a body, --label; of a left ventricle, "
        "--blood and --myocardium, or --myocardium alone; the axis and the base plane are seen",
    ),
    option("--label", "N", "of the image: the body's, one or more", nargs="+", type=int),
    option("--blood", "N", "of the image: the cavity's", nargs="+", type=int),
    option("--myocardium", "N", "of the image: the wall's", nargs="+", type=int),
    option(
        "--blur",
        "MM",
        "of the image: sd of the Gaussian that takes off the steps of voxels (default: 0.7 of a "
        "voxel)",
        type=float,
    ),
    option("--out", "FILE.vtu", "mesh to write, in mm", required=True),
    option(
        "--size",
        "MM",
        "edges (default: 0.7 of the median thickness; of both ventricles, for some 10 000 nodes; "
        "of a body, for some 5000)",
        type=float,
    ),
    option(
        "--order", type=int, default=2, choices=(1, 2), help="of the elements (default: 2, curved)"
    ),
    option(
        "--axis", **_PLACE, help="from apex to base, across the base plane (default: by the rims)"
    ),
    option("--base-height", "MM", "of the base plane along the axis", type=float),
    option("--base-point", **_PLACE, help="a point of the base plane instead, mm"),
    option(
        "--smooth",
        "N",
        "times of Taubin's filter; 20 for surfaces of voxels (default: 0)",
        type=int,
        default=0,
    ),
    option("--unit", "mm|cm|m|um", "of the surfaces' coordinates (default: mm)", default="mm"),
    option("--picture", "FILE.png", "the mesh, by the wall's thickness"),
    help="tetrahedra between the surfaces of a left ventricle, or of both, or within an organ",
    description="Cuts both surfaces at the base, meshes the wall between them by Gmsh and "
    "names endocardium, epicardium and base, for calibrate init. Surfaces are STL, PLY, OBJ or "
    "VTK's PolyData: open at the base, or closed, with --axis and a base plane. With --right, both "
    "ventricles are meshed, open at their valves. An image of labels gives the surfaces, too.",
    epilog="example: calibrate mesh --endocardium endo.stl --epicardium epi.stl --out lv.vtu, "
    "then calibrate init lv.vtu",
)
def mesh(arguments: Namespace) -> Answer:
    """Mesh the wall or the body, and write the mesh and its picture."""
    words.check_vtu(arguments.out)
    if arguments.picture is not None:
        check_folder(Path(arguments.picture).parent)
    _check_sources(arguments)
    if arguments.surface is not None or arguments.label is not None:
        return _mesh_solid(arguments)
    return _mesh_wall(arguments)


def _check_sources(arguments: Namespace) -> None:
    """Refuse more or less than one kind of source, and options that another kind has."""
    walls = {"endocardium", "epicardium", "right", "ventricles"}
    labels = {"label", "blood", "myocardium", "blur"}
    planes = {"axis", "base_height", "base_point"}
    present = {name for name, word in vars(arguments).items() if word is not None}
    if arguments.image is not None:
        excluded = walls | {"surface"}
        if arguments.label is not None:
            excluded |= {"blood", "myocardium", "picture"} | planes
        source = "--image --label" if arguments.label is not None else "--image"
        if arguments.unit != "mm":
            raise InputError("--unit has no effect on an image, whose header has it")
    elif arguments.surface is not None:
        source, excluded = "--surface", walls | labels | planes | {"picture"}
    else:
        source, excluded = "surfaces of walls", labels
        if not {"endocardium", "epicardium"} <= present:
            raise InputError(
                "mesh: give --endocardium and --epicardium of a wall, --surface of a body, or "
                "--image with labels"
            )
    if useless := sorted(excluded & present):
        option = useless[0].replace("_", "-")
        raise InputError(f"--{option} has no effect with {source}: leave one of them out")


def _mesh_solid(arguments: Namespace) -> Answer:
    """Mesh the body within a surface, or of labels."""
    from emulator.geometry.io import write_mesh
    from emulator.hearts.solid import mesh_solid

    source, notes = arguments.surface, list[str]()
    if arguments.image is not None:
        from emulator.hearts.images import read_labels
        from emulator.hearts.segmentation import label_surface

        image = read_labels(arguments.image)
        source, notes = label_surface(image, arguments.label, "organ", arguments.blur)
    solid = mesh_solid(source, **words.parameters(mesh_solid, arguments))
    write_mesh(arguments.out, solid.mesh)
    result = {
        "out": arguments.out,
        "nodes": len(solid.mesh.nodes),
        "elements": len(solid.mesh.elements),
        "size": solid.size,
        "volume": dict(zip(("mesh", "surface"), solid.volumes, strict=True)),
        "folded": solid.folded[0],
        "notes": notes,
        "quality": solid.quality._asdict(),
    }
    lines = [*notes, *solid.sentences()]
    lines.append(f"written to {arguments.out}, then: calibrate init {arguments.out}")
    return Answer(result, "\n".join(lines))


def _wall_sources(arguments: Namespace) -> tuple[dict[str, Any], list[str]]:
    """Return the arguments of ``mesh_wall`` that an image of labels has, and notes."""
    from emulator.hearts.images import read_labels
    from emulator.hearts.segmentation import label_surface, left_ventricle

    image = read_labels(arguments.image)
    if arguments.myocardium is None:
        raise InputError(
            f"{image.name}: name its labels, --label N of a body, or --blood N --myocardium N of a "
            f"left ventricle; labels: {image.listed()}"
        )
    if arguments.blood is None:
        muscle, notes = label_surface(image, arguments.myocardium, "the muscle", arguments.blur)
        return {"endocardium": muscle, "epicardium": muscle}, notes
    ventricle = left_ventricle(image, arguments.blood, arguments.myocardium, arguments.blur)
    sources = {"endocardium": ventricle.endocardium, "epicardium": ventricle.epicardium}
    plane = {"axis": ventricle.axis.tolist(), "base_point": ventricle.base.tolist()}
    if all(getattr(arguments, name) is None for name in ("axis", "base_height", "base_point")):
        sources |= plane
    elif arguments.axis is None:
        sources["axis"] = plane["axis"]
    return sources, list(ventricle.notes)


def _mesh_wall(arguments: Namespace) -> Answer:
    """Mesh the wall between surfaces, or of labels."""
    from emulator.geometry.io import write_mesh
    from emulator.hearts.heart import mesh_wall

    out, picture = arguments.out, arguments.picture
    sources, notes = ({}, []) if arguments.image is None else _wall_sources(arguments)
    wall = mesh_wall(**words.parameters(mesh_wall, arguments) | sources)
    write_mesh(out, wall.mesh)
    names = ("mesh", "surface")
    result = {
        "out": out,
        "nodes": len(wall.mesh.nodes),
        "elements": len(wall.mesh.elements),
        "size": wall.size,
        "axis": wall.axis,
        "base": wall.base,
        "thickness": wall.thickness._asdict(),
        "cavities": {
            name: dict(zip(names, volumes, strict=True)) for name, volumes in wall.cavities.items()
        },
        "wall": dict(zip(names, wall.wall, strict=True)),
        **dict(zip(("cut_off", "cut_off_ml"), wall.cut_off, strict=True)),
        "moved": wall.shift,
        "folded": wall.folded[0],
        "notes": notes,
        "warnings": list(wall.warnings),
        "quality": wall.quality._asdict(),
    }
    lines = [*notes, *wall.sentences(), f"written to {out}, then: calibrate init {out}"]
    if picture is not None:
        from calibrate.figures import save
        from calibrate.figures.evaluation import surface_figure

        title = f"{Path(out).stem}: {result['nodes']} nodes"
        figure = surface_figure(wall.mesh, wall.local_thickness(), title, "wall thickness (mm)")
        save(figure, picture)
        result["picture"] = picture
        lines.append(f"picture: {picture}")
    return Answer(result, "\n".join(lines))
