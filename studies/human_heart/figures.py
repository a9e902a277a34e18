"""The bands of the frames that were kept apart, and what was inferred."""

from pathlib import Path

import numpy as np
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from studies.common.figures import BLUE, ORANGE, pyplot
from studies.common.output import Case, save
from studies.human_heart.heart import SURFACES

import emulator as em


def draw(cases: dict[str, Case], path: Path) -> None:
    """Right volume against left, share inside by frame and surface, and intervals of unknowns."""
    case = cases["all frames"]
    bands = case["bands"]
    figure, axes = pyplot().subplots(1, 3, figsize=(12.0, 4.0), layout="constrained")
    left = np.array(bands["left_volume"])
    low, middle, high = np.array(bands["volume:rv_endocardium"])
    axes[0].fill_between(left, low, high, color=BLUE, alpha=0.2, lw=0)
    axes[0].plot(left, middle, color=BLUE)
    out = {
        name.removeprefix("without "): one["judged"][name.removeprefix("without ")]
        for name, one in cases.items()
        if name.startswith("without ")
    } or case["judged"]
    for frame, one in case["judged"].items():
        axes[0].plot(one["left_volume"], one["right_volume"]["measured"], "o", color=ORANGE)
        axes[0].annotate(frame, (one["left_volume"], one["right_volume"]["measured"]))
    axes[0].set_xlabel("left volume, mL")
    axes[0].set_ylabel("right volume, mL")
    axes[0].set_title("90 % band of the right volume", fontsize=10)
    width = 0.25
    for k, name in enumerate(SURFACES):
        shares = [100.0 * one[name]["inside"] for one in out.values()]
        axes[1].bar(np.arange(len(out)) + width * (k - 1), shares, width, label=name)
    axes[1].axhline(90.0, color="0.4", lw=1, ls="--")
    axes[1].set_xticks(range(len(out)), list(out))
    axes[1].set_ylabel("points inside, %")
    axes[1].set_title("frames left out, in their 90 % bands", fontsize=10)
    axes[1].legend(fontsize=8, loc="lower right")
    names = [n for n in case["posterior"] if "sd" not in n]
    for k, name in enumerate(names):
        row = case["posterior"][name]
        share = row["sd"] / abs(row["mean"])
        axes[2].barh(k, 100.0 * share, color=BLUE)
    axes[2].set_yticks(range(len(names)), names, fontsize=7)
    axes[2].set_xlabel("posterior sd, % of the mean")
    for axis in axes:
        axis.spines[["top", "right"]].set_visible(False)
    save(figure, path)


def draw_surface(case: Case, scene: em.Scene, axis: np.ndarray, path: Path) -> None:
    """The fullest frame's shape, by the mean and the sd of how far its nodes have moved.

    axis : the long axis (3,), from apex to base.
    """
    figure = pyplot().figure(figsize=(9.0, 4.6), layout="constrained")
    corners, mean = scene.mesh.surface[:, :3], np.array(case["mean"])
    points = scene.mesh.nodes.copy()
    points[np.array(case["nodes"])] += np.array(case["moved"])
    # Turned, and not mirrored, so that the axis is upright.
    upright = axis / np.linalg.norm(axis)
    across = np.cross(upright, [1.0, 0.0, 0.0])
    across /= np.linalg.norm(across)
    turned = points @ np.column_stack([across, np.cross(upright, across), upright])
    values = {"mean": mean, "sd": np.array(case["sd"])}
    for k, (name, told) in enumerate(values.items(), start=1):
        at_nodes = np.zeros(len(points))
        at_nodes[np.array(case["nodes"])] = told
        each = at_nodes[corners].mean(axis=1)
        axes = figure.add_subplot(1, 2, k, projection="3d")
        scale = pyplot().Normalize(each.min(), each.max())
        faces = Poly3DCollection(turned[corners], facecolors=pyplot().cm.viridis(scale(each)))
        axes.add_collection3d(faces)
        low, high = turned.min(axis=0), turned.max(axis=0)
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
        axes.set_box_aspect(high - low, zoom=1.4)
        axes.set_axis_off()
        axes.view_init(elev=15.0, azim=-60.0)
        colours = pyplot().cm.ScalarMappable(scale, "viridis")
        figure.colorbar(colours, ax=axes, shrink=0.7, label=f"{name} of displacement, mm")
    save(figure, path)
