"""Shared by all figures: colours that every reader can tell apart, draws to picture, files."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import jax
import numpy as np

from calibrate.certificate import Certificate
from calibrate.measurements import DISPLACEMENT
from calibrate.measurements.points import DisplacementPoints
from calibrate.posterior import Posterior
from emulator.core.errors import InputError
from emulator.core.store import replacing

BLUE = "#0072B2"
VERMILION = "#D55E00"
GREEN = "#009E73"
PINK = "#CC79A7"
ORANGE = "#E69F00"
SKY = "#56B4E9"
BLACK = "#000000"
COLOURS = (BLUE, VERMILION, GREEN, PINK, ORANGE, SKY, BLACK)


if TYPE_CHECKING:
    from matplotlib.figure import Figure


def pyplot() -> Any:
    """Return matplotlib.pyplot; :class:`InputError` when it is not installed.

    It draws to files, unless somebody imported it before and shows figures, as in a notebook.
    """
    try:
        import matplotlib as mpl
    except ImportError as error:
        raise InputError(
            "figures need matplotlib: pip install 'soft-tissue-calibrate[plot]'"
        ) from error
    if "matplotlib.pyplot" not in sys.modules:
        mpl.use("Agg")
    import matplotlib.pyplot as plt

    return plt


def displacement_draws(posterior: Posterior) -> np.ndarray:
    """Return displacement fields (200, n, 3) mm of the forward map at evenly spaced draws."""
    thetas = posterior.thetas()
    rows = np.linspace(0, len(thetas) - 1, 200).astype(int)
    chosen = np.asarray(thetas)[rows]
    return np.asarray(jax.jit(lambda t: jax.lax.map(posterior.model.full, t))(chosen))


def displacement_part(posterior: Posterior) -> DisplacementPoints:
    """Return the observation called ``displacement``; :class:`InputError` when there is none."""
    parts = posterior.model.observe.parts
    if DISPLACEMENT not in parts:
        raise InputError("figure: the posterior observes no displacements")
    return cast(DisplacementPoints, parts[DISPLACEMENT])


def title_and_save(
    figure: Figure, posterior: Posterior, certificate: Certificate, path: str | Path
) -> None:
    """Add a title with scene, forward map and verdict; write the figure and close it."""
    figure.suptitle(
        f"{posterior.model.forward.scene.name}: posterior by {posterior.model.forward.kind}, "
        f"checked by FEM: {certificate.verdict} (Pareto k = {certificate.k_hat:.2f})"
    )
    save(figure, path)


def save(figure: Figure, path: str | Path) -> None:
    """Write the figure, whole or not at all, and close it."""
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=140)
    pyplot().close(figure)
