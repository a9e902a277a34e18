"""``calibrate identify``, ``effects`` and ``sensitivity``: analyses of a model and its data."""

from __future__ import annotations

import sys
from argparse import Namespace
from dataclasses import asdict, replace
from typing import TYPE_CHECKING

from calibrate.cli import words
from calibrate.cli.output import table
from calibrate.cli.run_words import run_options
from calibrate.cli.words import Answer, command, flag, option
from emulator.core.errors import InputError, check_seed
from emulator.core.store import check_folder

if TYPE_CHECKING:
    import xarray as xr

    from calibrate.analysis.effects import Recommendation


@command(run_options("seed"), help="of data not yet measured, from a scene")
def _before(arguments: Namespace) -> Answer:
    """Find the parameters that the observations would determine."""
    from calibrate.analysis.expected import expected_precision
    from calibrate.analysis.identifiability import products_in_words
    from calibrate.cli.run_words import problem_of
    from calibrate.noise import typical
    from calibrate.project import model_before_data

    problem = problem_of(arguments)
    # Errors that many numbers share are made for each data set, not at one draw of the prior.
    model = model_before_data(problem.change(systematic={}))
    inferred = [name for name, noise in model.noise.items() if noise.priors]
    noise = {name: typical(noise) for name, noise in model.noise.items()}
    model = replace(model, noise=noise)
    expected = expected_precision(model, systematic=problem.run.systematic)
    rows = [(name, f"{100 * ratio:.3g} %") for name, ratio in expected["sd"].items()]
    lines = [table(("parameter", "expected sd / prior sd"), rows)]
    lines += products_in_words(expected["combinations"], len(rows))
    if inferred:
        lines.append(f"noise of {', '.join(inferred)}: inferred sds at the median of their prior")
    return Answer(expected, "\n".join(lines))


@command(
    option("folder", "DIR"),
    option(
        "--next",
        "WHAT",
        "measurements to compare, written as for infer --observe, with their usual noise",
        nargs="+",
        default=[],
    ),
    option("--profile", "NAME", "profile likelihoods", nargs="+", default=[]),
    help="of a posterior that calibrate infer wrote",
)
def _after(arguments: Namespace) -> Answer:
    """Find the parameters that data determined, and the measurement that would add most."""
    from calibrate.analysis.expected import next_measurement
    from calibrate.analysis.identifiability import (
        identify,
        in_words,
        profile_likelihood,
        stress_band,
    )
    from calibrate.measurements import parse_observation
    from calibrate.measurements.usual_noise import usual_noise
    from calibrate.project import read_posterior

    run, posterior = read_posterior(arguments.folder)
    result = identify(posterior)
    lines = [in_words(result)]
    scene = posterior.model.forward.scene
    for direction in () if scene.outside else ("fibre", "cross-fibre"):
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
    candidates = {}
    for word in "+".join(arguments.next).split("+") if arguments.next else ():
        (part,) = parse_observation(scene, word, run.seed).parts.values()
        candidates[word] = (part, usual_noise(part, scene))
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
    return Answer(result, "\n".join(lines))


identify = words.command_of_kinds(
    "which parameters the data can determine", before=_before, after=_after
)


@command(
    words.add_scene,
    option("--observe", "WHAT", "as for infer, e.g. landmarks:24+volume", required=True),
    option(
        "--tolerance",
        "VALUE",
        "change that is allowed, with its unit, one for each unit observed, e.g. 0.5mm 1mL",
        required=True,
        nargs="+",
    ),
    option("--samples", "N", "theta to solve at (default 6)", type=int, default=6),
    option("--seed", type=int, default=0),
    help="which effects a scene can do without",
    description="Solves the scene with and without each effect it could do without (gravity, "
    "fibres, a pressure that follows the wall, quadratic elements, springs ...) and recommends "
    "which to leave out, so that what is observed changes by no more than a tolerance.",
    epilog="example: calibrate effects left_ventricle --observe landmarks:24+volume "
    "--tolerance 0.5mm 1mL",
)
def effects(arguments: Namespace) -> Answer:
    """Measure each effect, and recommend which to leave out."""
    from calibrate.analysis.effects import recommend, tolerances
    from calibrate.measurements import observations, parse_observation

    check_seed(arguments.seed, "effects")
    scene = words.scene_of(arguments)
    observe = observations(parse_observation(scene, arguments.observe, arguments.seed))
    recommendation = recommend(
        scene,
        observe,
        tolerances(arguments.tolerance, observe),
        samples=arguments.samples,
        seed=arguments.seed,
        say=lambda what: None if arguments.json else print(what, "...", file=sys.stderr),
    )
    result = {
        "leave_out": [
            {"effect": name, "remedy": recommendation.effects[name].remedy}
            for name in recommendation.left_out
        ],
        "tolerance": recommendation.tolerance,
        "units": recommendation.units,
        "whole": vars(recommendation.whole),
        "alone": [vars(effect) for effect in recommendation.alone],
        "chosen": vars(recommendation.chosen),
    }
    return Answer(result, _effects_in_words(recommendation))


def _effects_in_words(recommendation: Recommendation) -> str:
    """Return a table of the effects, and the recommendation in words."""
    observed = [f"{name}, {unit}" for name, unit in recommendation.units.items()]
    rows = [
        (
            ", ".join(effect.left_out),
            *(effect.changes[name] for name in recommendation.units),
            f"{effect.ratio:.2f} x",
            effect.unknowns,
        )
        for effect in recommendation.alone
    ]
    whole = recommendation.whole
    lines = [
        f"the scene as it is: {whole.seconds:.3g} s a solve, {whole.unknowns} unknowns",
        "largest change where one effect is left out:",
        table(("without", *observed, "time", "unknowns"), rows),
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


@command(
    run_options("seed"),
    help="which terms of a law a test shows",
    epilog="example: calibrate init biaxial.csv --law invariant_terms, then "
    "calibrate terms biaxial.toml",
)
def terms(arguments: Namespace) -> Answer:
    """Compare all sets of terms by their evidence, and by tests that are left out."""
    from calibrate.analysis.terms import HeldOut, find_terms
    from calibrate.cli.run_words import problem_of
    from calibrate.project.problem import build_model, with_data

    comparison = find_terms(*build_model(with_data(problem_of(arguments))))
    columns: list[list[str]] = [
        [", ".join(names) or "none" for names, _ in comparison.sets],
        [f"{chance:.3f}" for _, chance in comparison.sets],
    ]
    head, tables = ["likeliest sets", "probability"], list[str]()
    if comparison.held_out:
        head.append("log density of a held-out point")
        columns.append([f"{x:.2f}" for x in comparison.log_densities])
        tables = [table(HeldOut.head, (test.cells for test in comparison.held_out))]
    sets = table(head, zip(*columns, strict=True))
    return Answer(asdict(comparison), "\n\n".join([str(comparison), sets, *tables]))


_SAMPLES = {"sobol": 512, "morris": 64, "derivatives": 256}
# The heads of a table's columns, and their contents, by method; blanks keep heads apart.
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


@command(
    words.add_scene,
    option("--observe", "WHAT", "as for infer, e.g. volume or landmarks:24+volume"),
    flag("--field", "the displacement of every node, and a map of it"),
    option(
        "--method",
        choices=tuple(_SAMPLES),
        default="sobol",
        help="sobol (default): shares of the variance; morris: mean effects, for many parameters; "
        "derivatives: bounds on the shares, and combinations of parameters that matter",
    ),
    option(
        "--samples",
        "N",
        "sobol evaluates N (p + 2) theta, a power of two (default 512); morris N (p + 1) "
        "(64); derivatives N (256)",
        type=int,
    ),
    option(
        "--prior",
        "NAME|FILE",
        "box (uniform over the range, on its scale), or a population's .json file without "
        "correlations",
        default="box",
    ),
    option(
        "--group",
        "NAME=A,B",
        "vary parameters together, e.g. matrix=a,b fibres=a_f,b_f",
        nargs="+",
        default=[],
    ),
    words.add_forward,
    option("--emulator", "NAME|DIR", "default: the one shipped"),
    words.seed_option("the design, of random landmarks and of FEM runs"),
    option("--out", "DIR", "write sensitivity.nc, figures, and the map as VTU"),
    help="which parameter moves which observation",
    description="Shares of each observation's variance over the prior (Sobol' indices), "
    "screening of many parameters (Morris), or bounds from exact derivatives.",
    epilog="example: calibrate sensitivity left_ventricle --observe volume --field --out DIR",
)
def sensitivity(arguments: Namespace) -> Answer:
    """Analyse a scene's forward map, and write the indices."""
    from calibrate.analysis.sensitivity import indices_to_json, sensitivity
    from calibrate.measurements import parse_observation
    from calibrate.priors import prior_of
    from calibrate.project.experiment import with_absolute_paths
    from emulator import Simulator
    from emulator.surrogates.protocol import Ingredients
    from emulator.surrogates.registry import build_forward, full_options

    check_seed(arguments.seed, "sensitivity")
    scene = words.scene_of(arguments)
    if arguments.out:
        check_folder(arguments.out)
    observe = arguments.observe and parse_observation(scene, arguments.observe, arguments.seed)
    options = full_options(arguments.forward, words.forward_options(arguments))
    groups = _groups(arguments.group)
    entries = {"emulator": arguments.emulator, "prior": arguments.prior}
    emulator, prior = with_absolute_paths(entries).values()
    ingredients = Ingredients(scene, Simulator(scene), emulator, arguments.seed, progress=False)
    indices = sensitivity(
        build_forward(arguments.forward, ingredients, options),
        observe or None,
        prior=prior_of(prior, scene),
        method=arguments.method,
        samples=_SAMPLES[arguments.method] if arguments.samples is None else arguments.samples,
        groups=groups,
        field=arguments.field,
        seed=arguments.seed,
    )
    if arguments.out:
        from calibrate.figures.sensitivity import write

        write(indices, scene, arguments.out)
    return Answer(indices_to_json(indices), _indices_in_words(indices))


def _indices_in_words(indices: xr.DataTree) -> str:
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


def _groups(texts: list[str]) -> dict[str, list[str]]:
    """Read words ``NAME=A,B``: the parameters of each group by its name."""
    groups = {}
    for word in texts:
        name, mark, members = word.partition("=")
        if not mark or not name or not all(members.split(",")):
            raise InputError(f"--group {word}: write NAME=A,B, e.g. matrix=a,b")
        if name in groups:
            raise InputError(f"--group {name} is given twice")
        groups[name] = members.split(",")
    return groups
