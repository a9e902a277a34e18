"""``calibrate sensitivity``: which parameter moves which observation."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calibrate.cli.output import DONE, emit, table
from calibrate.cli.words import (
    add_forward,
    add_scene,
    add_scheduler,
    add_seed,
    answer,
    checked_forward_options,
    scene_of,
    scheduler_word,
)
from emulator.core.errors import InputError, check_seed
from emulator.core.store import check_folder

if TYPE_CHECKING:
    import xarray as xr

    from emulator.scenes.scene import Scene


_METHODS = ("sobol", "morris", "derivatives")
# By method: the heads of a table's columns, and what is in them; blanks keep heads apart.
_COLUMNS = {
    "sobol": {
        "first": "first_together",
        "+-": "first_together_half_width",
        "total": "total_together",
        "+- ": "total_together_half_width",
    },
    "morris": {"mean absolute effect": "mu_star_together"},
    "derivatives": {"total index at most": "bound_on_total_together"},
}
_SAMPLES = {"sobol": 512, "morris": 64, "derivatives": 256}


def add_sensitivity(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "sensitivity",
        help="which parameter moves which observation",
        description="Shares of each observation's variance over the prior (Sobol' indices), "
        "screening of many parameters (Morris), or bounds from exact derivatives.",
        epilog="example: calibrate sensitivity left_ventricle --observe volume --field --out DIR",
    )
    add_scene(parser)
    parser.add_argument(
        "--observe", metavar="WHAT", help="as for infer, e.g. volume or landmarks:24+volume"
    )
    parser.add_argument(
        "--field", action="store_true", help="the displacement of every node, and a map of it"
    )
    parser.add_argument(
        "--method",
        choices=_METHODS,
        default="sobol",
        help="sobol (default): shares of the variance; morris: mean effects, for many parameters; "
        "derivatives: bounds on the shares, and combinations of parameters that matter",
    )
    parser.add_argument(
        "--samples",
        type=int,
        metavar="N",
        help="sobol evaluates N (p + 2) theta, a power of two (default 512); morris N (p + 1) "
        "(64); derivatives N (256)",
    )
    parser.add_argument(
        "--prior",
        default="box",
        metavar="NAME|FILE",
        help="box (uniform over the range, on its scale), or a population's .json file without "
        "correlations",
    )
    parser.add_argument(
        "--group",
        nargs="+",
        default=[],
        metavar="NAME=A,B",
        help="vary parameters together, e.g. matrix=a,b fibres=a_f,b_f",
    )
    add_forward(parser)
    parser.add_argument("--emulator", metavar="NAME|DIR", help="default: the one shipped")
    add_scheduler(parser, "with --forward fem, the FEM runs")
    add_seed(parser, "the design, of random landmarks and of FEM runs")
    parser.add_argument(
        "--out", metavar="DIR", help="write sensitivity.nc, figures, and the map as VTU"
    )
    answer(parser, run_sensitivity)


def run_sensitivity(arguments: argparse.Namespace) -> int:
    """Analyse a scene's forward map, print the indices and write them."""
    from calibrate.analysis.sensitivity import sensitivity
    from calibrate.measurements import parse_observation
    from calibrate.priors import prior_of
    from calibrate.project.run import with_absolute_paths
    from emulator import Simulator
    from emulator.surrogates.protocol import Ingredients
    from emulator.surrogates.registry import build_forward, check_scheduler

    check_seed(arguments.seed, "sensitivity")
    check_scheduler(arguments.forward, arguments.scheduler)
    scheduler = scheduler_word(arguments)
    scene = scene_of(arguments)
    if arguments.out:
        check_folder(arguments.out)
    observe = arguments.observe and parse_observation(scene, arguments.observe, arguments.seed)
    options = checked_forward_options(arguments)
    groups = _groups(arguments.group)
    entries = {"emulator": arguments.emulator, "prior": arguments.prior}
    emulator, prior = with_absolute_paths(entries).values()
    ingredients = Ingredients(scene, Simulator(scene), emulator, arguments.seed, progress=False)
    forward = build_forward(arguments.forward, ingredients, options)
    indices = sensitivity(
        forward,
        observe or None,
        prior=prior_of(prior, scene),
        method=arguments.method,
        samples=_SAMPLES[arguments.method] if arguments.samples is None else arguments.samples,
        groups=groups,
        field=arguments.field,
        seed=arguments.seed,
        scheduler=scheduler,
    )
    if arguments.out:
        write(indices, scene, Path(arguments.out))
    report: dict[str, Any] = {str(name): value for name, value in indices.attrs.items()}
    report |= {name: _plain(node.to_dataset()) for name, node in indices.children.items()}
    emit(arguments, report, sensitivity_summary(indices))
    return DONE


def write(indices: xr.DataTree, scene: Scene, folder: Path) -> None:
    """Write the indices as netCDF, their figures, and indices of the nodes as VTU."""
    import numpy as np

    from calibrate.analysis.sensitivity import FIELD
    from calibrate.figures.sensitivity import draw
    from emulator.core.store import write_netcdf
    from emulator.geometry.io import write_nodal

    write_netcdf(folder / "sensitivity.nc", indices)
    draw(indices, scene, folder)
    if FIELD in indices.children:
        data = indices[FIELD].to_dataset()
        nodal: dict[str, np.ndarray] = {}
        for name in {"first", "total", "mu_star", "bound_on_total"} & set(map(str, data)):
            for label, values in zip(
                data[data[name].dims[0]].values, data[name].values, strict=True
            ):
                nodal[f"{name} {label}"] = np.nan_to_num(values)
        write_nodal(folder / "sensitivity.vtu", scene.mesh, nodal)


def sensitivity_summary(indices: xr.DataTree) -> str:
    """Return a table for each observation."""
    lines = []
    for name, node in indices.children.items():
        data = node.to_dataset()
        count = data.sizes["output"]
        numbers = f"{count} numbers, " if count > 1 else ""
        lines.append(f"{name} ({numbers}{data.attrs['unit']})")
        columns = _COLUMNS[indices.attrs["method"]]
        names = list(columns.values())
        header = [str(data[names[0]].dims[0]), *(head.rstrip() for head in columns)]
        rows = [
            (str(label), *(round(float(data[n][k]), 4) for n in names))
            for k, label in enumerate(data[data[names[0]].dims[0]].values)
        ]
        lines.append(table(header, rows))
        if indices.attrs["method"] == "derivatives":
            lines.append(_active(data))
    return "\n".join(lines)


def _active(data: xr.Dataset) -> str:
    """Return the direction of theta along which the observation changes most, in words."""
    values, vectors = data["active_value"].values, data["active_direction"].values
    if not values.sum() > 0.0:
        return "nothing changes along any direction"
    terms = " ".join(
        f"{weight:+.2f} {name}"
        for name, weight in zip(data["parameter"].values, vectors[:, 0], strict=True)
    )
    share = 100.0 * values[0] / values.sum()
    return f"{share:.0f} % of the squared slopes along {terms} (in the unit box)"


def _plain(data: xr.Dataset) -> dict[str, Any]:
    """Return indices of all numbers together, and of each where they are few, as plain JSON."""
    few = data.sizes["output"] <= 100
    result: dict[str, Any] = {"unit": data.attrs["unit"], "evaluations": data.attrs["evaluations"]}
    for name, values in data.variables.items():
        if few or "output" not in values.dims:
            result[str(name)] = values.values.tolist()
    return result


def _groups(words: list[str]) -> dict[str, list[str]]:
    """Read words ``NAME=A,B``: the parameters of each group by its name."""
    groups = {}
    for word in words:
        name, mark, members = word.partition("=")
        if not mark or not name or not all(members.split(",")):
            raise InputError(f"--group {word}: write NAME=A,B, e.g. matrix=a,b")
        if name in groups:
            raise InputError(f"--group {name} is given twice")
        groups[name] = members.split(",")
    return groups
