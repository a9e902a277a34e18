"""``calibrate identify``: what data would determine, or has; what to measure next."""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import Any

from calibrate.cli.common import DONE, answer, emit, table
from calibrate.cli.model_words import add_model, run_of


def register(commands: Any) -> None:
    """Add the command, before data and after."""
    parser = commands.add_parser("identify", help="which parameters the data can determine")
    kinds = parser.add_subparsers(dest="kind", metavar="KIND", required=True)
    before = kinds.add_parser("before", help="of data not yet measured, from a scene")
    add_model(before)
    before.add_argument("--seed", type=int)
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
    """What the observations would determine."""
    from calibrate.analysis.expected import expected_precision
    from calibrate.analysis.identifiability import products_in_words
    from calibrate.project import model_before_data

    run = run_of(arguments, seed=arguments.seed)
    # Errors that many numbers share are made for each data set, not at one draw of the prior.
    model = model_before_data(replace(run, systematic={}))
    found = expected_precision(model, systematic=run.systematic)
    rows = [(name, f"{100 * ratio:.3g} %") for name, ratio in found["sd"].items()]
    lines = [table(("parameter", "expected sd / prior sd"), rows)]
    lines += products_in_words(found["combinations"], len(rows))
    emit(found, as_json=arguments.json, text="\n".join(lines))
    return DONE


def run_after(arguments: argparse.Namespace) -> int:
    """What a posterior's data determined, and what would add most."""
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
    found = identify(posterior)
    lines = [in_words(found)]
    for direction in ("fibre", "cross-fibre"):
        band = stress_band(posterior, direction, stretches=[1.1, 1.2])
        known = ", ".join(
            f"{m:.3g} kPa ({low:.3g} to {high:.3g}) at {s:g}"
            for s, low, m, high in zip(band.stretch, band.low, band.median, band.high, strict=True)
        )
        lines.append(f"stress along a {direction} stretch: {known}")
        found[f"stress {direction}"] = [a.tolist() for a in band[1:]]
    for name in arguments.profile:
        profile = profile_likelihood(posterior, name)
        lines.append(
            f"by likelihood alone, {name} is {profile.low:.4g} to {profile.high:.4g} (95 %)"
        )
        found[f"profile {name}"] = [profile.low, profile.high]
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
        found["next"] = {name: c._asdict() for name, c in gains.items()}
    emit(found, as_json=arguments.json, text="\n".join(lines))
    return DONE
