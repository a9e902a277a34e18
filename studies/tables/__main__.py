"""Tables of somebody else's runs: what a Gaussian process of their rows says of rows kept apart.

    python -m studies.tables --data DIR      # DIR/cardiacN/processed/{parameters,outputs}.csv
    python -m studies.tables --quick         # a table made here

The rows are shuffled once; every fifth is kept apart. Its outputs are predicted, with their 90 %,
and by AutoEmulate from the same rows where ``--peers PYTHON`` (or CALIBRATE_AUTOEMULATE) names an
interpreter that has it; then some of these rows are data, with noise of 2 % of each output's sd,
and their inputs are inferred, 80 or more a table.
Writes results.json after each table, and tables.png.
"""

import csv
import os
import tempfile
from functools import cache
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from studies.common.fenicsx import solve
from studies.common.figures import BLUE, GREEN, pyplot
from studies.common.output import Case, Results, parser, save

import calibrate as cal

HERE = Path(__file__).parent
SEED = 0
HELD_OUT = 5  # one row of so many
NOISE = 0.02  # sd of the data, in sds of each output over the rows
LEAST_INFERRED = 80  # inputs, of as many rows
OPTIONS = cal.samplers.NUTSOptions(warmup=300, draws=400, chains=2)
PEER = Path(__file__).with_name("autoemulate_best.py")
PEER_SECONDS = 300.0  # that it may choose for, a table


def read(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """The inputs (c, p) and the outputs (c, n) of a table."""
    tables = []
    for name in ("parameters", "outputs"):
        with (folder / f"{name}.csv").open(newline="") as file:
            _, *rows = csv.reader(file)
        tables.append(np.array(rows, dtype=float))
    return tables[0], tables[1]


def made(rows: int = 90) -> tuple[np.ndarray, np.ndarray]:
    """A table of three inputs, of which one does nothing, and two outputs."""
    x = np.random.default_rng(SEED).random((rows, 3))
    return x, np.stack([np.sin(2.0 * x[:, 0]) + x[:, 1], np.exp(x[:, 1] - x[:, 0])], axis=1)


def write(folder: Path, x: np.ndarray, y: np.ndarray, data: np.ndarray) -> Path:
    """The files of a problem: its table, a file of data, and an experiment."""
    inputs, outputs = [f"x{k}" for k in range(x.shape[1])], [f"y{k}" for k in range(y.shape[1])]
    for name, head, rows in (
        ("runs", [*inputs, *outputs], np.hstack([x, y])),
        ("data", outputs, data[None]),
    ):
        with (folder / f"{name}.csv").open("w", newline="") as file:
            csv.writer(file).writerows([head, *rows.tolist()])
    text = '[solver]\nkind = "table"\nfile = "runs.csv"\n'
    for name, column in zip(inputs, x.T, strict=True):
        low, high = float(column.min()), float(column.max())
        text += f"[parameters.{name}]\nrange = [{low!r}, {high!r}]\n"
    text += "".join(f"[outputs.{name}]\n" for name in outputs)
    (folder / "table.toml").write_text(text)
    noise = "".join(
        f"{n} = {NOISE * sd:.8g}\n" for n, sd in zip(outputs, y.std(axis=0), strict=True)
    )
    bounded = ", ".join(f'"{name}"' for name in inputs)
    experiment = f'scene = "table.toml"\ndata = "data.csv"\nbounded = [{bounded}]\n'
    experiment += 'draws = 400\nchains = 2\nsampler = "nuts"\n[noise]\n'
    (folder / "experiment.toml").write_text(experiment + noise)
    return folder / "experiment.toml"


def r2_of(predicted: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The R2 (n,) of predictions of rows (c, n)."""
    return 1.0 - ((predicted - y) ** 2).sum(axis=0) / ((y - y.mean(axis=0)) ** 2).sum(axis=0)


def beside(python: str, x: np.ndarray, y: np.ndarray, apart: np.ndarray, truth: np.ndarray) -> Case:
    """AutoEmulate's best model of the same rows, by its own choice."""
    problem = {"x": x, "y": y, "apart": apart, "seconds": PEER_SECONDS}
    answer = solve(python, problem, PEER)
    return {
        "best": str(answer["best"]),
        "r2": float(r2_of(answer["predicted"], truth).mean()),
        "models_compared": len(answer["models"]),
        "seconds": float(answer["seconds"]),
        "version": str(answer["version"]),
    }


class Table(NamedTuple):
    """A table, and the posterior that its rows give of the first row that is kept apart.

    x, y : inputs (c, p) and outputs (c, n). known, apart : the rows of each kind.
    data : the outputs of the rows kept apart, with noise.
    posterior : of the first of them. seconds : what it took, with all fits.
    """

    x: np.ndarray
    y: np.ndarray
    known: np.ndarray
    apart: np.ndarray
    data: np.ndarray
    posterior: cal.Posterior
    seconds: float


@cache
def fitted(folder: Path | None) -> Table:
    """The table in a folder, or the one made here, with its first posterior."""
    x, y = made() if folder is None else read(folder)
    order = np.random.default_rng(SEED).permutation(len(x))
    apart, known = order[: len(x) // HELD_OUT], order[len(x) // HELD_OUT :]
    inside = ((x[apart] >= x[known].min(axis=0)) & (x[apart] <= x[known].max(axis=0))).all(axis=1)
    apart = apart[inside]  # the map answers nowhere else
    rng = np.random.default_rng([SEED, 1])
    data = y[apart] + NOISE * y[known].std(axis=0) * rng.normal(size=y[apart].shape)
    with tempfile.TemporaryDirectory() as place:
        path = write(Path(place), x[known], y[known], data[0])
        begin = perf_counter()
        posterior = cal.infer(cal.read_experiment(path))
        seconds = perf_counter() - begin
    return Table(x, y, known, apart, data, posterior, seconds)


def outputs(table: Table, python: str | None) -> Case:
    """Errors of the outputs of rows kept apart, and AutoEmulate's."""
    x, y, known, apart, _, posterior, seconds = table
    full: Any = posterior.model.full  # a process of rows, which knows its errors
    predicted = np.asarray(jax.vmap(full)(jnp.asarray(x[apart])))[..., 0]
    rng = np.random.default_rng([SEED, 2])
    _, sds = full.drawn_errors(x[apart], np.arange(y.shape[1]), 1, rng)
    errors, r2 = predicted - y[apart], r2_of(predicted, y[apart])
    peer = {}
    if python is not None:
        peer = {"AutoEmulate": beside(python, x[known], y[known], x[apart], y[apart])}
    return {
        **peer,
        "rows": len(x),
        "inputs": x.shape[1],
        "outputs": y.shape[1],
        "r2": float(r2.mean()),
        "r2_least": float(r2.min()),
        "inside_90": float((np.abs(errors) < 1.645 * sds).mean()),
        "seconds_to_first_posterior": seconds,
    }


def inputs(table: Table) -> Case:
    """Coverage of the inputs of some rows kept apart, from their outputs with noise."""
    posterior = table.posterior
    count = min(-(-LEAST_INFERRED // table.x.shape[1]), len(table.data))
    of_rows, begin = [posterior.draws()], perf_counter()
    for row in table.data[1:count]:
        values = dict(zip(posterior.model.observe.parts, row, strict=True))
        further = cal.sample(posterior.model, values, sampler="nuts", options=OPTIONS)
        of_rows.append(further.draws())
    ranks = np.array(
        [
            np.mean(draws[f"x{k}"] < table.x[row, k])
            for row, draws in zip(table.apart[:count], of_rows, strict=True)
            for k in range(table.x.shape[1])
        ]
    )
    return {
        "posteriors": count,
        "inferred": len(ranks),
        "inside_90": float(((ranks > 0.05) & (ranks < 0.95)).mean()),
        "inside_50": float(((ranks > 0.25) & (ranks < 0.75)).mean()),
        "seconds_a_further_posterior": (perf_counter() - begin) / (count - 1),
    }


def draw(cases: list[Case], path: Path) -> None:
    """R2 and coverage of each table."""
    figure, axes = pyplot().subplots(1, 2, figsize=(9, 3), layout="constrained")
    names = [c["name"] for c in cases]
    axes[0].barh(names, [1.0 - c["r2"] for c in cases], color=BLUE, label="this package")
    theirs = [(c["name"], 1.0 - c["AutoEmulate"]["r2"]) for c in cases if "AutoEmulate" in c]
    if theirs:
        axes[0].plot([v for _, v in theirs], [n for n, _ in theirs], "o", color="grey", mec="black")
        axes[0].plot([], [], "o", color="grey", mec="black", label="AutoEmulate's best")
        axes[0].legend(fontsize="small")
    axes[0].set(xlabel="1 - R2 of outputs kept apart, mean", xscale="log")
    axes[1].barh(names, [c["inside_90"] for c in cases], color=GREEN)
    axes[1].axvspan(0.85, 0.95, color="grey", alpha=0.25)
    axes[1].axvline(0.9, color="grey")
    axes[1].set(xlabel="share of them inside 90 %", xlim=(0.5, 1.0))
    for axis in axes:
        axis.invert_yaxis()
    save(figure, path)


def main() -> None:
    """Make the cases, results.json and the picture."""
    words = parser(__doc__, HERE)
    words.add_argument("--data", type=Path, help="folder of tables")
    peer = os.environ.get("CALIBRATE_AUTOEMULATE")
    words.add_argument("--peers", default=peer, help="an interpreter that has AutoEmulate")
    arguments = words.parse_args()
    results = Results(arguments.out, SEED, again=arguments.again)
    found = [] if arguments.data is None else arguments.data.glob("cardiac*/processed/outputs.csv")
    tables = {path.parts[-3]: path.parent for path in sorted(found, reverse=True)}  # small first
    every: dict[str, Path | None] = {"made": None} if not tables or arguments.quick else {**tables}
    for name, folder in every.items():
        results.case(name, lambda folder=folder: outputs(fitted(folder), arguments.peers))
        results.case(f"{name}, inputs", lambda folder=folder: inputs(fitted(folder)))
    results.write()
    draw([done for done in results.cases if "r2" in done], arguments.out / "tables.png")
    for done in results.cases:
        assert done["inside_90"] > 0.8, done["name"]


if __name__ == "__main__":
    main()
