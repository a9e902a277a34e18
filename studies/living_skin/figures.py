"""The study's picture."""

from pathlib import Path

import numpy as np
from studies.common.figures import pyplot
from studies.common.output import Case, save
from studies.living_skin.bands import Bands
from studies.living_skin.skin import HEALTHY, KELOID, measured_of


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
        row[1].legend(loc="upper left")
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


def draw_inclusions(cases: list[Case], path: Path) -> None:
    """Truth, mean and sd of twins with a stiff inclusion that the model was not told of."""
    plt = pyplot()
    figure, axes = plt.subplots(
        len(cases), 3, figsize=(13, 2.6 * len(cases)), constrained_layout=True, squeeze=False
    )
    for row, case in zip(axes, cases, strict=True):
        places = np.array(case["middles_mm"])
        truth, mean = (np.array(case[n]) for n in ("truth_log_kpa", "mean_log_kpa"))
        most = float(np.exp(max(truth.max(), mean.max())))
        share = f"{100 * case['inside']:.0f} % of elements inside"
        for axis, values, words, top in (
            (row[0], np.exp(truth), "truth, shear stiffness (kPa)", most),
            (row[1], np.exp(mean), f"mean; {share}", most),
            (row[2], np.array(case["sd"]), "sd of its logarithm", 1.0),
        ):
            dots = axis.scatter(*places.T, c=values, s=12, cmap="viridis", vmin=0.0, vmax=top)
            axis.set(aspect="equal", title=words, xlabel="x (mm)", ylabel="y (mm)")
            figure.colorbar(dots, ax=axis, shrink=0.8)
    save(figure, path, dpi=70)
