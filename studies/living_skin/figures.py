"""The study's picture."""

from pathlib import Path

import numpy as np
from studies.common.output import Case, save
from studies.living_skin.bands import Bands
from studies.living_skin.skin import HEALTHY, KELOID, measured_of

from calibrate.figures import pyplot


def draw(cases: dict[str, Case], data: Path, path: Path) -> None:
    """Displacements along x, forces with bands, and the map of stiffness."""
    plt = pyplot()
    figure, axes = plt.subplots(2, 4, figsize=(17, 7), constrained_layout=True)
    for row, skin in zip(axes, (KELOID, HEALTHY), strict=True):
        bands = Bands.of_json(cases[f"{skin.name}, bands"])
        measured = measured_of(skin, data, len(bands.points))
        order = np.argsort(bands.points[:, 0])
        x = bands.points[order, 0]
        for k, amount in enumerate(bands.amounts):
            low, high = bands.low[k, order, 0], bands.high[k, order, 0]
            row[0].fill_between(x, low, high, alpha=0.35, label=f"{amount} mm")
        for amount in skin.amounts:
            frame = measured.field.frames.index(measured.frame_at(amount))
            u = measured.field.displacement[frame, bands.numbers]
            row[0].plot(x, u[order, 0], "k.", ms=3)
        row[0].set(title=f"{skin.name}: motion along x", xlabel="x (mm)", ylabel="$u_x$ (mm)")
        row[0].legend(title="not seen yet", fontsize=8)
        at = np.linspace(0.1, max(skin.amounts), 60)
        row[1].plot(at, [-1e3 * measured.force(a) for a in at], "k", label="measured")
        low, mean, high = -1e3 * bands.force.T
        error = np.abs(np.stack([mean - high, low - mean]))
        row[1].errorbar(bands.force_amounts, mean, error, fmt="o", label="90 % bands")
        row[1].set(xlabel="motion of the pad (mm)", ylabel="force (mN)", title="force")
        row[1].legend()
        of = cases[f"{skin.name}, map"]
        places = np.array(of["middles_mm"])
        for axis, values, words in (
            (row[2], np.exp(of["mean_log_kpa"]), "shear stiffness, mean (kPa)"),
            (row[3], np.array(of["sd"]), "sd of its logarithm"),
        ):
            dots = axis.scatter(*places.T, c=values, s=14, cmap="viridis")
            axis.plot(*bands.points.T, "k.", ms=1.5)
            axis.set(aspect="equal", title=words, xlabel="x (mm)", ylabel="y (mm)")
            figure.colorbar(dots, ax=axis, shrink=0.7)
    save(figure, path, dpi=80)
