"""The model on the command line: scene, data, observations, noise, forward map."""

from __future__ import annotations

import argparse
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calibrate.cli.common import add_scene, assignments, scene_words
from calibrate.cli.forward import add_forward, given_options
from calibrate.cli.noise_words import discrepancy_words, noise_scale_words, noise_words
from calibrate.places import absolute, emulator_place, prior_place, scene_place
from emulator.core.errors import InputError

if TYPE_CHECKING:
    from calibrate.project import Run
    from calibrate.project.experiment import Cohort
    from emulator.surrogates.additive import Emulator


def add_model(parser: argparse.ArgumentParser) -> None:
    """Add everything that says which posterior is meant, but its sampler.

    Options have no defaults here: those of a run, or an experiment file's entries, are theirs.
    """
    add_scene(parser, "; or an experiment file, whose entries the options replace")
    parser.add_argument(
        "--data", metavar="FILE|synthetic", help=".csv or netCDF, mm and mL (default synthetic)"
    )
    parser.add_argument(
        "--truth",
        nargs="+",
        default=[],
        metavar="NAME=VALUE",
        help="of synthetic data; NAME@STATE=VALUE in one of several load states",
    )
    parser.add_argument(
        "--known",
        nargs="+",
        default=[],
        metavar="NAME=VALUE",
        help="parameters that are not inferred, e.g. pressure@p8=1.07",
    )
    parser.add_argument(
        "--prior",
        metavar="NAME|FILE",
        help="box (uniform over the scene's range; the default), ventricles (correlated "
        "Holzapfel-Ogden parameters of human ventricles), or a population's medians, log sds and "
        "correlations in a .json file",
    )
    parser.add_argument(
        "--observe",
        metavar="WHAT",
        help="of synthetic data (default nodes:20), e.g. nodes:N, landmarks:N, all, a node set, "
        "3,14,15, volume, volume:FACETSET, surface:FACETSET:N, strain:fibre:N, "
        "segment_strain:circumferential, length:A:B, parameter:NAME; several joined by +, as in "
        "landmarks:24+volume",
    )
    _add_noise(parser)
    add_forward(parser, default=None)
    parser.add_argument(
        "--emulator", metavar="NAME|DIR", help="default: the one shipped for the scene"
    )
    parser.add_argument("--load-steps", type=int, metavar="N", help="as for simulate (default 1)")
    allowed = parser.add_mutually_exclusive_group()
    allowed.add_argument(
        "--error-runs",
        type=int,
        metavar="N",
        help="FEM runs (8 or more) from which the forward map's own error is learned, so that a "
        "poor map widens the posterior instead of moving it",
    )
    allowed.add_argument(
        "--mesh-error",
        type=int,
        metavar="N",
        help="the same with solves on the next finer mesh, so that the error of the mesh widens "
        "the posterior, too",
    )


def model_of(arguments: argparse.Namespace) -> dict[str, Any]:
    """What :func:`add_model` read and was given, as fields of :class:`~calibrate.project.Run`.

    Of an experiment file, what takes the place of its entries.
    """
    experiment = experiment_file(arguments.scene)
    scene, root = (None, arguments.root) if experiment else scene_words(arguments)
    measured = arguments.data not in (None, "synthetic")
    for option in ("truth", "observe") if measured else ():
        if getattr(arguments, option):
            raise InputError(
                f"--{option} has no effect beside --data {arguments.data}: it is for synthetic data"
            )
    found = {
        "scene": scene and scene_place(scene),
        "root": root and absolute(root),
        "data": arguments.data and absolute(arguments.data, is_path=measured),
        "truth": assignments(arguments.truth),
        "known": assignments(arguments.known),
        "observe": arguments.observe,
        "prior": arguments.prior and prior_place(arguments.prior),
        "noise": noise_words(arguments.noise),
        "noise_scale": noise_scale_words(arguments.noise_scale),
        "discrepancy": discrepancy_words(arguments.discrepancy),
        "check_scale": False if arguments.no_unit_check else None,
        "forward": arguments.forward,
        "emulator": emulator_place(arguments.emulator),
        "forward_options": given_options(arguments),
        "error_runs": arguments.error_runs,
        "mesh_error_runs": arguments.mesh_error,
        "load_steps": arguments.load_steps,
    }
    return {name: value for name, value in found.items() if value is not None and value != {}}


def plan_of(arguments: argparse.Namespace, **sampling: Any) -> Run | Cohort:
    """The run that :func:`add_model` read, or the experiment of its file.

    ``sampling`` are further fields of a run, ``None`` where nothing was given.
    """
    from calibrate.project import Run
    from calibrate.project.experiment import read_experiment

    given = model_of(arguments) | {n: v for n, v in sampling.items() if v is not None}
    if experiment_file(arguments.scene):
        return read_experiment(arguments.scene, given)
    return Run(**given)


def run_of(arguments: argparse.Namespace, **sampling: Any) -> Run:
    """:func:`plan_of` where it is of one body; :class:`InputError` where it is of several."""
    from calibrate.project import Run

    plan = plan_of(arguments, **sampling)
    if not isinstance(plan, Run):
        raise InputError(
            f"{arguments.scene} has members of a population; give an experiment file of one of them"
        )
    return plan


def experiment_file(word: str) -> bool:
    """Whether a word is a TOML file that names a scene or members instead of being a scene."""
    if not word.endswith(".toml") or not Path(word).is_file():
        return False
    try:
        return bool({"scene", "members"} & tomllib.loads(Path(word).read_text("utf-8")).keys())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError):
        return False  # told when it is read as a scene


def _add_noise(parser: argparse.ArgumentParser) -> None:
    """Noise by observation, known or to be inferred, and the check of the data's unit."""
    parser.add_argument(
        "--noise",
        nargs="+",
        default=[],
        metavar="[NAME=]SD",
        help="standard deviation by observation, e.g. volume=1.0 displacement=0.2, mL and mm; a "
        "bare number is a single observation's or the displacements' (default 0.2 mm, 1 mL). Other "
        "noise by its name, e.g. displacement=student_t:dof=4,scale=0.2 or "
        "displacement=correlated:length=15,sd=0.1,spatial_sd=0.2 (length in mm)",
    )
    parser.add_argument(
        "--noise-scale",
        nargs="+",
        default=[],
        metavar="[NAME=]SCALE",
        help="infer the noise: scale of the half-normal prior of its standard deviation",
    )
    parser.add_argument(
        "--discrepancy",
        nargs="+",
        default=[],
        metavar="NAME=SCALE:LENGTH",
        help="let the model be wrong, e.g. displacement=0.5:20: scale of the half-normal prior of "
        "the discrepancy's standard deviation, in the data's unit, and its correlation length, mm",
    )
    parser.add_argument(
        "--no-unit-check",
        action="store_true",
        help="take data however far from every prediction (m for mm, mm3 for mL, zero)",
    )


def emulator_of(body: str, emulator: str | None = None) -> Emulator:
    """The emulator called ``body``, or the one of a scene: ``emulator``, or the one shipped."""
    from emulator.catalogue import find_scene
    from emulator.surrogates import load

    found = load(emulator or body)
    if emulator and find_scene(body).fingerprint != found.scene.fingerprint:
        raise InputError(
            f"--emulator {emulator} is of scene '{found.scene.name}', or of another mesh, not of "
            f"'{body}'"
        )
    return found
