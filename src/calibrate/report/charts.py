"""Charts of a posterior: data against prediction, draws, stress, pressure and volume."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import jax
import numpy as np
import numpyro.distributions as dist
import plotly.graph_objects as go
from plotly.subplots import make_subplots
from scipy.stats import rankdata

from calibrate.analysis.identifiability import stress_band
from calibrate.figures import BLUE, COLOURS, VERMILION, with_unit
from calibrate.measurements import Observation
from calibrate.measurements.klotz import klotz_of
from calibrate.measurements.volume import PressureVolume, in_mmhg, pressure_volume
from calibrate.measurements.words import to_json
from calibrate.posterior import Posterior
from calibrate.state_names import split
from emulator.scenes.loads import KPA_PER_MMHG

_CHAINS = COLOURS[:6]
_MOST_TRACED = 500  # largest number of a chain's draws in a trace
_MOST_PAIRED = 800  # largest number of draws in a pair plot
_CURVES = 60  # largest number of draws in a pressure-volume band
_KNOWN = 1e-9  # range of a known pressure over draws, relative: round-off
_VOLUMES = 400  # largest number of draws of a volume
_CLOSER_AT_REST = 3  # power of Klotz's pressures, as his curve rises from 0


def translucent(colour: str, opacity: float) -> str:
    """Return the colour ``#rrggbb`` with an opacity from 0 to 1, for filled areas."""
    return f"rgba({int(colour[1:3], 16)}, {int(colour[3:5], 16)}, {int(colour[5:], 16)}, {opacity})"


def band(x: Any, y: Any, colour: str, opacity: float, **about: Any) -> go.Scatter:
    """Return the area between two curves, whose ``x`` or ``y`` is a pair of low and high ends."""
    ends = [np.r_[c[0], c[1][::-1]] if isinstance(c, tuple) else np.r_[c, c[::-1]] for c in (x, y)]
    return go.Scatter(
        x=ends[0], y=ends[1], fill="toself", fillcolor=translucent(colour, opacity), line_width=0,
        hoverinfo="skip", mode="lines", **about,
    )  # fmt: skip


def inside(values: np.ndarray, data: np.ndarray) -> np.ndarray:
    """Return whether each present datum (m,) lies within the central 90 % of its predictions.

    ``values`` (s, n) predicted, noise included; ``data`` (n,), NaN where missing.
    """
    low, high = np.nanquantile(values, [0.05, 0.95], axis=0)
    return ((data >= low) & (data <= high))[np.isfinite(data)]


def names_with_units(posterior: Posterior) -> dict[str, str]:
    """Return the label of each unknown, its unit included."""
    units = {p.name: p.unit for p in posterior.model.forward.scene.parameters}
    return {n: with_unit(n, units.get(split(n)[0], "")) for n in posterior.model.names}


def against_data(posterior: Posterior) -> Iterator[tuple[str, go.Figure]]:
    """Yield a chart for each observation: the data against the posterior predictions."""
    tree = posterior.tree
    if "posterior_predictive" not in tree.children:
        return
    for name, part in posterior.model.observe.parts.items():
        values = np.asarray(tree["posterior_predictive"][name])
        values = values.reshape(values.shape[0] * values.shape[1], -1)
        data = np.ravel(np.asarray(posterior.data[name]))
        if hasattr(part, "curves"):
            curves = part.curves(posterior.model.observe.entries.get(name))
            yield name, _curves(part, curves, values, data)
            continue
        if values.shape[1] > 1:
            yield name, _many_numbers(name, part, values, data)
            continue
        figure = go.Figure(
            go.Histogram(
                x=values[:, 0], histnorm="probability density", marker_color=BLUE, opacity=0.75,
                name="predicted, with noise",
            )
        )  # fmt: skip
        line = {"color": VERMILION, "width": 3}
        figure.add_vline(x=float(data[0]), line=line, annotation_text="measured")
        figure.update_layout(
            xaxis_title=f"predicted {name} ({part.unit})", yaxis={"showticklabels": False}
        )
        yield name, figure


def _many_numbers(name: str, part: Observation, values: np.ndarray, data: np.ndarray) -> go.Figure:
    low, middle, high = np.nanquantile(values, [0.05, 0.5, 0.95], axis=0)
    present = np.isfinite(data)
    share = 100.0 * inside(values, data).mean()
    ends = [float(np.nanmin(data)), float(np.nanmax(data))]
    figure = go.Figure()
    figure.add_scatter(
        x=ends, y=ends, mode="lines", line={"color": "grey", "dash": "dot"}, name="equal",
        hoverinfo="skip",
    )  # fmt: skip
    figure.add_scatter(
        x=data[present], y=middle[present], mode="markers", marker={"color": BLUE, "size": 6},
        error_y={"type": "data", "symmetric": False, "array": (high - middle)[present],
                 "arrayminus": (middle - low)[present], "thickness": 1},
        name=f"median and 90 %; {share:.0f} % of the data lie within",
    )  # fmt: skip
    figure.update_layout(
        xaxis_title=f"{name} measured ({part.unit})", yaxis_title=f"predicted ({part.unit})"
    )
    return figure


def _curves(
    part: Any,
    curves: Mapping[str, tuple[np.ndarray, np.ndarray]],
    values: np.ndarray,
    data: np.ndarray,
) -> go.Figure:
    """Return each curve of an observation: data, and the 90 % band of predictions."""
    low, high = np.nanquantile(values, [0.05, 0.95], axis=0)
    figure = go.Figure()
    for k, (label, (x, rows)) in enumerate(curves.items()):
        colour = COLOURS[k % len(COLOURS)]
        figure.add_trace(band(x, (high[rows], low[rows]), colour, 0.25, showlegend=False))
        figure.add_scatter(
            x=x, y=data[rows], mode="markers", marker={"color": colour, "size": 6}, name=label
        )
    share = 100.0 * inside(values, data).mean()
    figure.update_layout(
        xaxis_title=part.curve_axis,
        yaxis_title=f"{part.quantity} ({part.unit}); {share:.0f} % of the data lie within 90 %",
    )
    return figure


def traces(
    labels: Mapping[str, str],
    every: Mapping[str, np.ndarray],
    priors: Mapping[str, dist.Distribution],
) -> go.Figure:
    """Return the draws (chains, draws) of names with labels: densities, order, ranks by chain."""
    figure = make_subplots(
        len(labels), 3, column_titles=["posterior", "trace", "ranks by chain"],
        horizontal_spacing=0.06, vertical_spacing=0.25 / max(len(labels), 2),
    )  # fmt: skip
    for row, (name, label) in enumerate(labels.items(), start=1):
        draws = every[name]
        ranks = rankdata(draws).reshape(draws.shape)
        edges = np.linspace(0.5, draws.size + 0.5, 21)
        step = max(1, draws.shape[1] // _MOST_TRACED)
        for chain, values in enumerate(draws):
            colour = _CHAINS[chain % len(_CHAINS)]
            style: dict[str, Any] = {
                "marker": {"color": colour}, "name": f"chain {chain + 1}",
                "legendgroup": str(chain), "showlegend": False,
            }  # fmt: skip
            counts = np.histogram(ranks[chain], edges)[0]
            line = {"mode": "lines", **style}
            histogram = go.Histogram(
                x=values, histnorm="probability density", opacity=0.5, nbinsx=40,
                **{**style, "showlegend": row == 1},
            )  # fmt: skip
            trace = go.Scatter(y=values[::step], line_width=1, **line)
            rank = go.Scatter(x=edges, y=[*counts, counts[-1]], line_shape="hv", **line)
            for column, panel in enumerate((histogram, trace, rank), start=1):
                figure.add_trace(panel, row, column)
        if (prior := priors.get(name)) is not None and not prior.shape():
            x = np.linspace(draws.min(), draws.max(), 100)
            line = {"color": "grey", "width": 2, "dash": "dash"}
            style = {"name": "prior", "legendgroup": "prior", "showlegend": row == 1}
            density = np.exp(np.asarray(prior.log_prob(x)))
            figure.add_trace(go.Scatter(x=x, y=density, mode="lines", line=line, **style), row, 1)
        even = draws.shape[1] / 20.0
        figure.add_hline(y=even, line={"color": "grey", "dash": "dot"}, row=row, col=3)
        figure.update_yaxes(title_text=label, showticklabels=False, row=row, col=1)
        figure.update_yaxes(rangemode="tozero", row=row, col=3)
    figure.update_layout(barmode="overlay", height=120 + 170 * len(labels))
    return figure


def pairs(labels: Mapping[str, str], draws: Mapping[str, np.ndarray]) -> go.Figure:
    """Return the scatter of the draws (s,) of every two names that have labels."""
    count = len(next(iter(draws.values())))
    rows = np.linspace(0, count - 1, min(count, _MOST_PAIRED)).astype(int)
    marker = {"size": 3, "color": BLUE, "opacity": 0.35}
    if len(labels) == 2:  # Plotly fails to draw a matrix of a single panel.
        x, y = labels
        figure = go.Figure(
            go.Scatter(x=draws[x][rows], y=draws[y][rows], mode="markers", marker=marker)
        )
        return figure.update_layout(xaxis_title=labels[x], yaxis_title=labels[y])
    figure = go.Figure(
        go.Splom(
            dimensions=[{"label": labels[n], "values": draws[n][rows]} for n in labels],
            marker=marker, showupperhalf=False, diagonal_visible=False,
        )
    )  # fmt: skip
    return figure.update_layout(height=160 + 140 * len(labels))


def stress(posterior: Posterior) -> go.Figure:
    """Return the stress that a stretch takes, with its 90 % band."""
    figure = go.Figure()
    fibres = posterior.model.forward.scene.law.fibres
    for direction, colour in (("fibre", BLUE), ("cross-fibre", VERMILION))[: 2 if fibres else 1]:
        of_stretch = stress_band(posterior, direction)
        label = f"along the {direction}" if fibres else "in any direction"
        ends = of_stretch.high, of_stretch.low
        figure.add_trace(band(of_stretch.stretch, ends, colour, 0.2, name=f"90 %, {label}"))
        figure.add_scatter(
            x=of_stretch.stretch, y=of_stretch.median, line_color=colour, name=f"median, {label}"
        )
    figure.update_layout(xaxis_title="stretch", yaxis_title="Cauchy stress difference (kPa)")
    return figure


def volume_band(posterior: Posterior) -> go.Figure | None:
    """Return the cavity volume over its pressure; None without such a parameter or cavity."""
    model = posterior.model
    curve = pressure_volume(model.full)
    if curve is None:
        return None
    thetas = posterior.thetas(model.states.states[-1])
    rows = np.linspace(0, len(thetas) - 1, min(_CURVES, len(thetas))).astype(int)
    volumes = jax.jit(lambda t: jax.lax.map(curve.volumes, t))(thetas[rows])
    low, middle, high = np.nanquantile(np.asarray(volumes), [0.05, 0.5, 0.95], axis=0)
    p, name = curve.pressures, curve.parameter.name
    data_volumes = _measured_volumes(posterior, curve)
    figure = go.Figure()
    _add_klotz(figure, curve, middle, data_volumes)
    figure.add_trace(band((low, high), p, BLUE, 0.22, name="90 % of the posterior"))
    figure.add_scatter(
        x=middle, y=p, mode="lines", line_color=BLUE, name="median",
        text=[in_mmhg(pressure) for pressure in p], hovertemplate="%{x:.1f} mL at %{text}",
    )  # fmt: skip
    figure.add_scatter(
        x=[curve.rest, middle[0]], y=[0.0, p[0]], line={"color": BLUE, "dash": "dot"},
        marker={"color": BLUE, "size": 8, "symbol": "circle-open"}, mode="lines+markers",
        name="without load, as the mesh is",
    )  # fmt: skip
    for label, (volume, pressures) in data_volumes.items():  # at the pressure of its load state
        is_known = np.ptp(pressures) <= _KNOWN * abs(pressures[0])
        figure.add_scatter(
            x=[volume], y=[float(pressures.mean())], mode="markers",
            marker={"color": VERMILION, "size": 11, "symbol": "x"},
            error_y={"type": "data", "array": [float(pressures.std())]},
            name=f"{label} measured; pressure {'known' if is_known else 'inferred'}",
        )  # fmt: skip
    figure.update_layout(
        xaxis_title="cavity volume (mL)",
        yaxis_title=f"{name} (kPa; 1 kPa is {1.0 / KPA_PER_MMHG:.1f} mmHg)",
    )
    return figure


def state_volumes(posterior: Posterior) -> dict[str, np.ndarray]:
    """Return cavity volumes (s,) in mL by load state; none without a cavity or for one state."""
    model = posterior.model
    curve = pressure_volume(model.full)
    if curve is None or len(model.states.states) < 2:
        return {}
    wall = model.full.at(curve.volume.nodes)
    volume = jax.jit(lambda t: jax.lax.map(lambda theta: curve.volume.cavity(wall(theta)), t))
    count = len(posterior.thetas(model.states.states[0]))
    rows = np.linspace(0, count - 1, min(_VOLUMES, count)).astype(int)
    return {
        state: np.asarray(volume(posterior.thetas(state)[rows])) for state in model.states.states
    }


def _measured_volumes(
    posterior: Posterior, curve: PressureVolume
) -> dict[str, tuple[float, np.ndarray]]:
    """Return each measured cavity volume in mL with its pressure at draws, by observation."""
    volumes, model = {}, posterior.model
    column = model.forward.scene.parameter_names.index(curve.parameter.name)
    for observation, part in model.observe.parts.items():
        if to_json(part) == to_json(curve.volume):
            pressures = np.asarray(posterior.thetas(split(observation)[1])[:, column])
            volumes[observation] = float(posterior.data[observation]), pressures
    return volumes


def _add_klotz(
    figure: go.Figure,
    curve: PressureVolume,
    median: np.ndarray,
    data_volumes: dict[str, tuple[float, np.ndarray]],
) -> None:
    """Add Klotz's curve through the volume at the highest measured pressure, or the median."""
    points = [(float(pressures.mean()), volume) for volume, pressures in data_volumes.values()]
    pressure, volume = max(points, default=(curve.pressures[-1], median[-1]))
    klotz = klotz_of(curve.volume.scene, volume, pressure)
    if klotz is None:
        return
    top = max(pressure, curve.pressures[-1])
    p = top * np.linspace(0.0, 1.0, 60) ** _CLOSER_AT_REST
    through = "measured volume" if points else "median"
    figure.add_scatter(
        x=np.asarray(klotz.volume(p)), y=p, mode="lines", line={"color": "gray", "dash": "dash"},
        name=f"left ventricles (Klotz et al. 2006), through the {through} at {in_mmhg(pressure)}",
        text=[in_mmhg(kpa) for kpa in p], hovertemplate="%{x:.1f} mL at %{text}",
    )  # fmt: skip
