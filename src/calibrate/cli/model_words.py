"""The model on the command line: scene, data, observations, noise, forward map."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calibrate.cli.common import add_scene, assignments, scene_words
from calibrate.cli.forward import add_forward, forward_options
from calibrate.cli.noise_words import discrepancy_words, noise_scale_words, noise_words
from emulator.errors import InputError

if TYPE_CHECKING:
    from emulator.surrogates.additive import Emulator


def add_model(parser: argparse.ArgumentParser) -> None:
    """Add everything that says which posterior is meant, but its sampler."""
    add_scene(parser)
    parser.add_argument(
        "--data", default="synthetic", metavar="FILE|synthetic", help=".csv or netCDF, mm and mL"
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
        default="box",
        metavar="NAME|FILE",
        help="box (uniform over the scene's range), ventricles (correlated Holzapfel-Ogden "
        "parameters of human ventricles), or a population's medians, log sds and correlations "
        "in a .json file",
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
    add_forward(parser)
    parser.add_argument(
        "--emulator", metavar="NAME|DIR", help="default: the one shipped for the scene"
    )
    parser.add_argument(
        "--load-steps", type=int, default=1, metavar="N", help="as for simulate (default 1)"
    )
    allowed = parser.add_mutually_exclusive_group()
    allowed.add_argument(
        "--error-runs",
        type=int,
        default=0,
        metavar="N",
        help="FEM runs (8 or more) from which the forward map's own error is learned, so that a "
        "poor map widens the posterior instead of moving it",
    )
    allowed.add_argument(
        "--mesh-error",
        type=int,
        default=0,
        metavar="N",
        help="the same with solves on the next finer mesh, so that the error of the mesh widens "
        "the posterior, too",
    )


def model_of(arguments: argparse.Namespace) -> dict[str, Any]:
    """What :func:`add_model` read, as fields of :class:`~calibrate.workflow.Run`."""
    scene, root = scene_words(arguments)
    measured = arguments.data != "synthetic"
    for option in ("truth", "observe") if measured else ():
        if getattr(arguments, option):
            raise InputError(
                f"--{option} has no effect beside --data {arguments.data}: it is for synthetic data"
            )
    return {
        "scene": _scene(scene),
        "root": root and _absolute(root),
        "data": _absolute(arguments.data, is_path=measured),
        "truth": assignments(arguments.truth),
        "known": assignments(arguments.known),
        "observe": arguments.observe or "nodes:20",
        "prior": prior_word(arguments.prior),
        "noise": noise_words(arguments.noise),
        "noise_scale": noise_scale_words(arguments.noise_scale),
        "discrepancy": discrepancy_words(arguments.discrepancy),
        "check_scale": not arguments.no_unit_check,
        "forward": arguments.forward,
        "emulator": emulator_word(arguments.emulator),
        "forward_options": forward_options(arguments),
        "error_runs": arguments.error_runs,
        "mesh_error_runs": arguments.mesh_error,
        "load_steps": arguments.load_steps,
    }


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


def prior_word(word: str) -> str | dict[str, Any]:
    """A name as it is; a file's content, because a kept run must not change with the file."""
    from calibrate.priors.population import read_population

    return asdict(read_population(word)) if word.endswith(".json") else word


def _scene(word: str) -> str:
    """A scene's name as it is, its file as an absolute path; ``finer:`` stays before either."""
    refined = "finer:" * word.startswith("finer:")
    name = word.removeprefix(refined)
    return refined + (_scene(name) if refined else _absolute(name, is_path=name.endswith(".toml")))


def _absolute(word: str, *, is_path: bool = True) -> str:
    """An absolute path, because a kept run may be read from any folder."""
    return str(Path(word).resolve()) if is_path else word


def emulator_word(word: str | None) -> str | None:
    """A shipped name as it is, a folder as an absolute path."""
    from emulator.surrogates import shipped

    return word if word is None or word in shipped() else _absolute(word)


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
