"""``calibrate identify`` and ``effects``: what data determine, and what a scene does not need."""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING, Any

from calibrate.cli.output import DONE, emit, table
from calibrate.cli.words import add_scene, answer, scene_of
from emulator.core.errors import check_seed

if TYPE_CHECKING:
    from calibrate.analysis.effects import Measured, Recommendation


def add_identify(commands: Any) -> None:
    """Add the command, before data and after."""
    from calibrate.cli.run_words import add_run

    parser = commands.add_parser("identify", help="which parameters the data can determine")
    kinds = parser.add_subparsers(dest="kind", metavar="KIND", required=True)
    before = kinds.add_parser("before", help="of data not yet measured, from a scene")
    add_run(before, ("seed",))
    after = kinds.add_parser("after", help="of a posterior that calibrate infer wrote")
    after.add_argument("folder", metavar="DIR")
    after.add_argument(
        "--next",
        nargs="+",
        default=[],
        metavar="WHAT",
        help="measurements to compare, written as for infer --observe, with their usual noise",
    )
    after.add_argument(
        "--profile", nargs="+", default=[], metavar="NAME", help="profile likelihoods"
    )
    for kind, run in ((before, run_before), (after, run_after)):
        answer(kind, run)


def run_before(arguments: argparse.Namespace) -> int:
    """Print what the observations would determine."""
    from calibrate.analysis.expected import expected_precision
    from calibrate.analysis.identifiability import products_in_words
    from calibrate.cli.run_words import problem_of
    from calibrate.project import model_before_data

    problem = problem_of(arguments, ("seed",))
    # Errors that many numbers share are made for each data set, not at one draw of the prior.
    model = model_before_data(problem.change(systematic={}))
    expected = expected_precision(model, systematic=problem.run.systematic)
    rows = [(name, f"{100 * ratio:.3g} %") for name, ratio in expected["sd"].items()]
    lines = [table(("parameter", "expected sd / prior sd"), rows)]
    lines += products_in_words(expected["combinations"], len(rows))
    emit(arguments, expected, "\n".join(lines))
    return DONE


def run_after(arguments: argparse.Namespace) -> int:
    """Print what a posterior's data determined, and which measurement would add most."""
    from calibrate.analysis.identifiability import (
        identify,
        in_words,
        next_measurement,
        stress_band,
    )
    from calibrate.analysis.profile import profile_likelihood
    from calibrate.measurements import parse_observation
    from calibrate.project import read_posterior

    run, posterior = read_posterior(arguments.folder)
    result = identify(posterior)
    lines = [in_words(result)]
    for direction in ("fibre", "cross-fibre"):
        band = stress_band(posterior, direction, stretches=[1.1, 1.2])
        stresses = ", ".join(
            f"{m:.3g} kPa ({low:.3g} to {high:.3g}) at {s:g}"
            for s, low, m, high in zip(band.stretch, band.low, band.median, band.high, strict=True)
        )
        lines.append(f"stress along a {direction} stretch: {stresses}")
        result[f"stress {direction}"] = [a.tolist() for a in band[1:]]
    for name in arguments.profile:
        profile = profile_likelihood(posterior, name)
        lines.append(
            f"by likelihood alone, {name} is {profile.low:.4g} to {profile.high:.4g} (95 %)"
        )
        result[f"profile {name}"] = [profile.low, profile.high]
    scene = posterior.model.forward.scene
    candidates = {}
    for word in [each for words in arguments.next for each in words.split("+")]:
        (part,) = parse_observation(scene, word, run.seed).parts.values()
        candidates[word] = (part, part.default_noise)
    if candidates:
        gains = next_measurement(posterior, candidates)
        rows = [
            (name, c.bits, *(f"{100 * (1 - r):.0f} %" for r in c.sd.values()))
            for name, c in gains.items()
        ]
        names = next(iter(gains.values())).sd
        lines.append("expected information gain, and by how much each sd would fall:")
        lines.append(table(("measure next", "bits", *names), rows))
        result["next"] = {name: c._asdict() for name, c in gains.items()}
    emit(arguments, result, "\n".join(lines))
    return DONE


def add_effects(commands: Any) -> None:
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
    answer(parser, run_effects)


def run_effects(arguments: argparse.Namespace) -> int:
    """Measure each effect, and recommend which to leave out."""
    from calibrate.analysis.effects import recommend, tolerances
    from calibrate.measurements import observations, parse_observation

    check_seed(arguments.seed, "effects")
    scene = scene_of(arguments)
    observe = observations(parse_observation(scene, arguments.observe, arguments.seed))
    recommendation = recommend(
        scene,
        observe,
        tolerances(arguments.tolerance, observe),
        samples=arguments.samples,
        seed=arguments.seed,
        say=lambda what: None if arguments.json else print(what, "...", file=sys.stderr),
    )
    emit(arguments, effects_report(recommendation), effects_summary(recommendation))
    return DONE


def effects_report(recommendation: Recommendation) -> dict[str, Any]:
    """Return all that was measured as plain JSON."""
    return {
        "leave_out": [
            {"effect": name, "remedy": recommendation.effects[name].remedy}
            for name in recommendation.left_out
        ],
        "tolerance": dict(recommendation.tolerance),
        "units": dict(recommendation.units),
        "whole": _plain(recommendation.whole),
        "alone": [_plain(each) for each in recommendation.alone],
        "chosen": _plain(recommendation.chosen),
    }


def _plain(measured: Measured) -> dict[str, Any]:
    plain = vars(measured) | {"left_out": list(measured.left_out)}
    return plain | {"changes": dict(measured.changes)}


def effects_summary(recommendation: Recommendation) -> str:
    """Return a table of the effects, and the recommendation in words."""
    header = [
        "without",
        *(f"{name}, {unit}" for name, unit in recommendation.units.items()),
        "time",
        "unknowns",
    ]
    rows = [
        (
            ", ".join(each.left_out),
            *(each.changes[name] for name in recommendation.units),
            f"{each.ratio:.2f} x",
            each.unknowns,
        )
        for each in recommendation.alone
    ]
    whole = recommendation.whole
    lines = [
        f"the scene as it is: {whole.seconds:.3g} s a solve, {whole.unknowns} unknowns",
        "largest change where one effect is left out:",
        table(header, rows),
    ]
    if not recommendation.left_out:
        return "\n".join([*lines, "keep everything: no effect can go and save time"])
    selection, tolerance = recommendation.chosen, recommendation.tolerance
    changes = ", ".join(
        f"{name} by {selection.changes[name]:.2g} of {tolerance[name]:g} {unit} allowed"
        for name, unit in recommendation.units.items()
    )
    lines.append(f"leave out {', '.join(recommendation.left_out)}:")
    lines += [f"  {recommendation.effects[name].remedy}" for name in recommendation.left_out]
    lines.append(
        f"at theta that had no part in the choice this changes {changes}, and a solve takes "
        f"{selection.ratio:.2f} of the time"
    )
    return "\n".join(lines)
