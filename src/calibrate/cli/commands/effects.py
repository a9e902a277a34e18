"""``calibrate effects``: what of a scene can be left out."""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING, Any

from calibrate.cli.common import DONE, add_scene, emit, scene_words, table

if TYPE_CHECKING:
    from calibrate.analysis.effects import Measured, Recommendation


def register(commands: Any) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "effects",
        help="which effects a scene can do without",
        description="Solves the scene with and without each effect it could do without (gravity, "
        "fibres, a pressure that follows the wall, quadratic elements, springs ...) and recommends "
        "which to leave out, so that what is observed changes by no more than a tolerance.",
        epilog="example: calibrate effects left_ventricle --observe landmarks:24+volume "
        "--tolerance 0.5mm 1mL",
    )
    add_scene(parser)
    parser.add_argument(
        "--observe", required=True, metavar="WHAT", help="as for infer, e.g. landmarks:24+volume"
    )
    parser.add_argument(
        "--tolerance",
        required=True,
        nargs="+",
        metavar="VALUE",
        help="change that is allowed, with its unit, one for each unit observed, e.g. 0.5mm 1mL",
    )
    parser.add_argument(
        "--samples", type=int, default=6, metavar="N", help="theta to solve at (default 6)"
    )
    parser.add_argument("--seed", type=int, default=0)


def run(arguments: argparse.Namespace) -> int:
    """Measure, and recommend."""
    from calibrate.analysis.effects import recommend, tolerances
    from calibrate.measurements import observations, parse_observation
    from emulator.catalogue import find_scene
    from emulator.core.errors import check_seed

    check_seed(arguments.seed, "effects")
    scene = find_scene(*scene_words(arguments))
    observe = observations(parse_observation(scene, arguments.observe, arguments.seed))
    found = recommend(
        scene,
        observe,
        tolerances(arguments.tolerance, observe),
        samples=arguments.samples,
        seed=arguments.seed,
        say=lambda what: None if arguments.json else print(what, "...", file=sys.stderr),
    )
    emit(report(found), as_json=arguments.json, text=summary(found))
    return DONE


def report(found: Recommendation) -> dict[str, Any]:
    """Everything measured, as plain JSON."""
    return {
        "leave_out": [
            {"effect": name, "remedy": found.effects[name].remedy} for name in found.left_out
        ],
        "tolerance": dict(found.tolerance),
        "units": dict(found.units),
        "whole": _plain(found.whole),
        "alone": [_plain(each) for each in found.alone],
        "chosen": _plain(found.chosen),
    }


def _plain(measured: Measured) -> dict[str, Any]:
    plain = vars(measured) | {"left_out": list(measured.left_out)}
    return plain | {"changes": dict(measured.changes)}


def summary(found: Recommendation) -> str:
    """A table, and the recommendation in words."""
    header = [
        "without",
        *(f"{name}, {unit}" for name, unit in found.units.items()),
        "time",
        "unknowns",
    ]
    rows = [
        (
            ", ".join(each.left_out),
            *(each.changes[name] for name in found.units),
            f"{each.ratio:.2f} x",
            each.unknowns,
        )
        for each in found.alone
    ]
    whole = found.whole
    lines = [
        f"the scene as it is: {whole.seconds:.3g} s a solve, {whole.unknowns} unknowns",
        "largest change where one effect is left out:",
        table(header, rows),
    ]
    if not found.left_out:
        return "\n".join([*lines, "keep everything: no effect can go and save time"])
    chosen = found.chosen
    changes = ", ".join(
        f"{name} by {chosen.changes[name]:.2g} of {found.tolerance[name]:g} {unit} allowed"
        for name, unit in found.units.items()
    )
    lines.append(f"leave out {', '.join(found.left_out)}:")
    lines += [f"  {found.effects[name].remedy}" for name in found.left_out]
    lines.append(
        f"at theta that had no part in the choice this changes {changes}, and a solve takes "
        f"{chosen.ratio:.2f} of the time"
    )
    return "\n".join(lines)
