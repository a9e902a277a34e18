"""Tables of runs in files of arrays, and fields among their outputs."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr

from calibrate.external.draft import draft_of_table
from emulator.catalogue import find_problem
from emulator.core.errors import InputError
from emulator.external.rows import rows_map, samples_of, scores_and_modes
from emulator.external.tables import content_of, read_runs

PLACES = np.linspace(0.0, 1.0, 20)


def field(x):
    """A field (c, 20, 2) of two parameters (c, 2), which no few modes hold exactly."""
    k, b = x[:, :1], x[:, 1:]
    return np.stack([np.sin(3.0 * PLACES * b) / k, np.exp(-k * PLACES) * b], axis=-1)


def runs(count, seed=0):
    """Parameters (c, 2), and the field there."""
    x = np.random.default_rng(seed).uniform([1.0, 0.5], [4.0, 2.0], (count, 2))
    return x, field(x)


def dataset(x, u):
    """Return the runs as arrays; the index of the runs and a scalar are no columns."""
    return xr.Dataset(
        {
            "k": ("run", x[:, 0], {"units": "kPa"}),
            "b": ("run", x[:, 1]),
            "u": (("run", "node", "axis"), u, {"units": "mm"}),
            "volume": ("run", x[:, 0] * x[:, 1] ** 2),
            "made": ((), 2026),
        },
        coords={"run": np.arange(len(x)) + 100},
    )


def write(folder: Path, name: str, content: xr.Dataset) -> Path:
    """Write a netCDF file or a Zarr store."""
    path = folder / name
    if path.suffix == ".zarr":
        content.to_zarr(path, consolidated=False)
    else:
        content.to_netcdf(path)
    return path


@pytest.mark.parametrize("name", ["runs.nc", "runs.zarr"])
def test_arrays_are_columns_and_fields(tmp_path, name):
    x, u = runs(12)
    table = read_runs(write(tmp_path, name, dataset(x, u)))
    assert dict(table.sizes) == {"k": 1, "b": 1, "u": 40, "volume": 1}
    assert table.units == {"k": "kPa", "u": "mm"}
    assert np.array_equal(table.column("k")[:, 0], x[:, 0])
    assert np.array_equal(table.column("u"), u.reshape(12, 40))


def test_a_drafted_problem_has_sizes_and_units_and_predicts_the_field(tmp_path):
    x, u = runs(90)
    u[3, 7] = np.nan  # a run that left its field unfinished has failed
    path = write(tmp_path, "runs.nc", dataset(x, u))
    draft = draft_of_table(path, tmp_path / "runs.toml", ["k", "b"])
    assert (draft.parameters, draft.outputs) == (["k", "b"], ["u", "volume"])
    problem = find_problem(str(draft.path))
    assert [(o.name, o.size, o.unit) for o in problem.outputs] == [
        ("u", 40, "mm"),
        ("volume", 1, ""),
    ]
    samples = samples_of(problem)
    assert (len(samples.theta), samples.failed) == (89, 1)
    forward = rows_map(problem)
    assert len(forward.process.modes) < 12
    fresh = 0.05 * np.array([[1.0, 0.5]]) + 0.9 * runs(60, seed=1)[0]
    truth = np.hstack([field(fresh).reshape(60, 40), fresh[:, :1] * fresh[:, 1:] ** 2])
    predicted = np.stack([np.asarray(forward(jnp.asarray(row)))[:, 0] for row in fresh])
    assert (np.abs(predicted - truth) / forward.process.sd).max() < 0.05
    drawn, sds = forward.drawn_errors(fresh, np.arange(41), 400, np.random.default_rng(0))
    assert np.allclose(drawn.std(axis=0), sds, rtol=0.3)
    assert 0.8 < np.mean(np.abs(predicted - truth) < 1.645 * sds) <= 1.0


def test_modes_are_those_of_the_covariance_and_leave_out_a_millionth():
    """Rows of M are eigenvectors of Y^T Y / c, and their squared lengths its eigenvalues."""
    field_of_runs = field(runs(60)[0]).reshape(60, 40)
    y = field_of_runs - field_of_runs.mean(axis=0)
    scores, modes = scores_and_modes(y)
    values = np.linalg.eigvalsh(y.T @ y / 60)[::-1]
    sizes = np.sum(modes**2, axis=1)
    assert np.allclose(sizes, values[: len(modes)])
    assert np.allclose((y.T @ y / 60) @ modes.T, modes.T * sizes)
    assert np.allclose(np.mean(scores**2, axis=0), 1.0)
    left = np.sum((y - scores @ modes) ** 2) / np.sum(y**2)
    assert left < 1e-6 < values[len(modes) - 1 :].sum() / values.sum()


def test_drawn_errors_of_a_field_go_together(tmp_path):
    """What a mode leaves open moves all places by the mode, modes together: V cov(s) V^T."""
    path = write(tmp_path, "runs.nc", dataset(*runs(40)))
    forward = rows_map(
        find_problem(str(draft_of_table(path, tmp_path / "r.toml", ["k", "b"]).path))
    )
    p, point = forward.process, np.array([[2.0, 1.0]])
    drawn, sds = forward.drawn_errors(point, np.arange(41), 6000, np.random.default_rng(0))
    covariance = np.cov(drawn[:, 0].T)
    flat = (p.modes * p.sd).T
    free = np.linalg.pinv(flat)
    of_scores = free @ (covariance - np.diag((p.rest * p.sd) ** 2)) @ free.T
    assert np.allclose(np.diag(covariance), sds[0] ** 2, rtol=0.12)
    off = of_scores / np.sqrt(np.outer(np.diag(of_scores), np.diag(of_scores)))
    largest = np.argsort(-np.diag(of_scores))[:3]
    expected = np.corrcoef((p.left_out @ free.T)[:, largest].T)
    assert np.abs(off[np.ix_(largest, largest)] - expected).max() < 0.15


@pytest.mark.parametrize(
    ("change", "inputs", "complaint"),
    [
        (lambda d: d.drop_vars(["k", "b", "volume", "run"]), ["k"], "no array of one dimension"),
        (lambda d: d, ["k", "u"], "parameter 'u' has 40 numbers a row"),
        (lambda d: d, ["k", "E"], "no column 'E'"),
        (lambda d: d.assign(k=("run", ["soft"] * 12)), ["k"], "'k' is text"),
        (lambda d: d.assign(k=d["k"].where(d["k"] < 2.0)), ["k"], "'k' is not finite"),
    ],
)
def test_arrays_that_do_not_fit_are_named(tmp_path, change, inputs, complaint):
    path = write(tmp_path, "runs.nc", change(dataset(*runs(12))))
    with pytest.raises(InputError, match=complaint):
        draft_of_table(path, tmp_path / "runs.toml", inputs)


def test_files_that_are_none_and_sizes_that_differ_are_named(tmp_path):
    (tmp_path / "runs.nc").write_text("no arrays")
    with pytest.raises(InputError, match="not a readable netCDF or Zarr file"):
        read_runs(tmp_path / "runs.nc")
    store = write(tmp_path, "runs.zarr", dataset(*runs(12)))
    with pytest.raises(InputError, match="have no order; name them"):
        draft_of_table(store, tmp_path / "z.toml", ["2"])
    path = draft_of_table(store, tmp_path / "z.toml", ["k", "b"]).path
    path.write_text(path.read_text().replace("size = 40", "size = 39"))
    with pytest.raises(InputError, match="'u' has 40 numbers in a row, and .* size = 39"):
        samples_of(find_problem(str(path)))


def test_a_table_is_known_by_its_content(tmp_path):
    x, u = runs(12)
    one, same, other = (
        content_of(write(tmp_path, f"{name}.zarr", dataset(x, u * factor)))
        for name, factor in (("a", 1.0), ("b", 1.0), ("c", 1.1))
    )
    assert one == same != other


def test_numbers_are_the_mean_of_each_modes_process(tmp_path):
    """At x it is the sum over runs of covariances with x times weights, for each mode alone."""
    path = write(tmp_path, "runs.nc", dataset(*runs(30)))
    draft = draft_of_table(path, tmp_path / "r.toml", ["k", "b"])
    p = rows_map(find_problem(str(draft.path))).process
    x = np.array([0.3, 0.8])
    at = (x - p.centre) / p.width
    scores = []
    for logs, weights in zip(p.logs, p.weights, strict=True):
        rho = np.sqrt(5.0 * np.sum(((at - p.at) / np.exp(logs[:2])) ** 2, axis=1))
        bell = (1.0 + rho + rho**2 / 3.0) * np.exp(-rho)
        scores.append((bell + np.exp(logs[2]) * (1.0 + p.at @ at)) @ weights)
    expected = p.mean + p.sd * (np.array(scores) @ p.modes)
    assert np.allclose(p.numbers(jnp.asarray(x)), expected, rtol=1e-6, atol=1e-6 * p.sd)
