"""Python functions, UM-Bridge models and tables of runs as solvers."""

import csv
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm

import calibrate as cal
import emulator as em
from calibrate.um_bridge import serve
from emulator.catalogue import find_problem
from emulator.core.errors import InputError, SolverError
from emulator.external.rows import process_of, rows_map, samples_of
from emulator.external.solver import ExternalSimulator
from emulator.surrogates.fem import fem_forward

FUNCTION = """
[solver]
kind = "python"
function = "model.py:solve"
[parameters.mu]
range = [1.0, 9.0]
[outputs.force]
size = 2
"""
TABLE = """
[solver]
kind = "table"
file = "runs.csv"
columns = { force = "F [N]" }
[parameters.a]
range = [0.0, 1.0]
[parameters.b]
range = [0.0, 1.0]
[outputs.force]
[outputs.volume]
"""


def function(folder, text):
    """A problem whose solver is a function of ``text``."""
    (folder / "model.py").write_text(text)
    (folder / "model.toml").write_text(FUNCTION)
    return ExternalSimulator(find_problem(str(folder / "model.toml")))


def test_a_function_gets_values_by_name_and_returns_outputs_and_derivatives(tmp_path):
    text = "def solve(mu):\n    return {'force': [mu, mu**2]}, {'force': {'mu': [1.0, 2 * mu]}}"
    simulator, theta = function(tmp_path, text), jnp.array([3.0])
    u = simulator(theta)
    assert np.asarray(u)[:, 0].tolist() == [3.0, 9.0]
    assert np.asarray(simulator.sensitivities(u, theta))[0, :, 0].tolist() == [1.0, 6.0]


@pytest.mark.parametrize(
    ("text", "kind", "complaint"),
    [
        ("def solve(mu):\n    raise ValueError('no root')", SolverError, "ValueError: no root"),
        ("def solve(mu):\n    return {'force': [1.0, float('inf')]}", SolverError, "is inf"),
        ("def solve(mu):\n    return 1.0", InputError, "returned 1.0; give the outputs by name"),
        ("def solve(mu):\n    return 1, 2, 3", InputError, "returned 3 things"),
        ("def solv(mu):\n    return 1.0", InputError, "has no attribute 'solve'"),
        ("import nothing_at_all", InputError, "No module named 'nothing_at_all'"),
    ],
)
def test_faults_of_a_function_are_named(tmp_path, text, kind, complaint):
    with pytest.raises(kind, match=complaint):
        function(tmp_path, text)(jnp.array([3.0]))


@pytest.fixture(scope="module")
def served():
    """A UM-Bridge server of a beam's displacements, on a free port; and the same by itself."""
    scene = em.scenes.once_clamped_beam(cells=(4, 1, 1), order=1)
    forward, observe = fem_forward(em.Simulator(scene)), cal.nodal_displacements(scene, [7, 11])
    server = serve(forward, observe, port=0)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield server.server_address[1], forward, observe
    server.shutdown()
    server.server_close()


def bridge(folder, port, size=6, model="forward", parameters=("mu", "lam")):
    """A problem whose solver is that server."""
    text = f'[solver]\nkind = "umbridge"\nurl = "http://127.0.0.1:{port}"\nmodel = "{model}"\n'
    text += "".join(f"[parameters.{name}]\nrange = [50.0, 100.0]\n" for name in parameters)
    (folder / "bridge.toml").write_text(f"{text}[outputs.displacement]\nsize = {size}\n")
    return ExternalSimulator(find_problem(str(folder / "bridge.toml")))


def test_a_model_behind_a_bridge_answers_with_derivatives(tmp_path, served):
    port, forward, observe = served
    simulator, theta = bridge(tmp_path, port), jnp.array([70.0, 80.0])
    u = simulator(theta)

    def direct(theta):
        return observe(forward.at(observe.nodes)(theta), theta).ravel()

    assert np.allclose(u[:, 0], direct(theta), rtol=1e-12)
    slopes = np.asarray(simulator.sensitivities(u, theta))[..., 0].T
    assert np.allclose(slopes, jax.jacfwd(direct)(theta), rtol=1e-8)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"size": 5}, "has 6 outputs; problem 'bridge' has 5"),
        ({"parameters": ("mu",)}, "has 2 inputs; problem 'bridge' has 1"),
        ({"model": "posterior"}, "ModelNotFound"),
        ({"port": 9}, "no UM-Bridge server answers at http://127.0.0.1:9"),
    ],
)
def test_a_model_that_does_not_fit_is_refused(tmp_path, served, change, complaint):
    with pytest.raises(InputError, match=complaint):
        bridge(tmp_path, **{"port": served[0], **change})(
            jnp.array([70.0, 80.0])[: 2 if "parameters" not in change else 1]
        )


def table(folder, rows, text=TABLE):
    """A problem that is a table."""
    with (folder / "runs.csv").open("w", newline="") as file:
        csv.writer(file).writerows([["a", "b", "F [N]", "volume"], *rows])
    (folder / "table.toml").write_text(text)
    return find_problem(str(folder / "table.toml"))


def runs(count=60, seed=0):
    """Rows of a smooth function of two inputs, the second of which moves the volume only."""
    x = np.random.default_rng(seed).random((count, 2))
    force = np.sin(3.0 * x[:, 0]) + 0.5
    return np.column_stack([x, force, 2.0 + x[:, 0] * np.exp(x[:, 1])])


def test_a_table_is_interpolated_with_errors_of_the_size_that_it_says(tmp_path):
    rows, fresh = runs(), runs(200, 1)
    forward = rows_map(table(tmp_path, rows))
    predicted = np.asarray(jax.vmap(forward)(jnp.asarray(fresh[:, :2])))[..., 0]
    errors = np.abs(predicted - fresh[:, 2:])
    assert errors.max() < 5e-3
    assert np.asarray(jax.vmap(forward)(jnp.asarray(rows[:, :2])))[..., 0] == pytest.approx(
        rows[:, 2:], abs=2e-3
    )
    _, sds = forward.drawn_errors(fresh[:, :2], np.arange(2), 2, np.random.default_rng(0))
    assert 0.8 < (errors < 1.645 * sds).mean() <= 1.0


def test_functions_drawn_of_the_error_have_the_sds_that_are_told(tmp_path):
    forward, points = rows_map(table(tmp_path, runs(15))), runs(5, 1)[:, :2]
    errors, sds = forward.drawn_errors(points, np.arange(2), 4000, np.random.default_rng(0))
    assert np.allclose(errors.std(axis=0), sds, rtol=0.1)
    assert np.abs(errors.mean(axis=0)).max() < 0.1 * sds.max()


def test_an_error_at_a_row_left_out_is_that_of_a_process_of_the_others():
    rows = runs(20)
    whole = process_of(rows[:, :2], rows[:, 2:3])
    others = np.arange(20) != 7
    x, y = whole.at, (rows[:, 2] - whole.mean[0]) / whole.sd[0]
    from emulator.external.rows import _covariance, _kernel

    K = np.asarray(_covariance(whole.logs[0], x))
    k = np.asarray(_kernel(whole.logs[0], x[7:8], x[others]))[0]
    direct = y[7] - k @ np.linalg.solve(K[np.ix_(others, others)], y[others])
    assert whole.left_out[7, 0] == pytest.approx(direct * whole.sd[0], rel=1e-6)


def test_the_fit_is_that_of_the_density_of_the_rows_and_of_the_lengths():
    from emulator.external.rows import _covariance, _loss

    x, y = runs(12)[:, :2], runs(12)[:, 2]
    x, y = (x - x.mean(axis=0)) / x.std(axis=0), (y - y.mean()) / y.std()

    def direct(logs):
        K = np.asarray(_covariance(logs, x))
        a2 = y @ np.linalg.solve(K, y) / len(y)  # its most likely value
        density = multivariate_normal(np.zeros(len(y)), a2 * K).logpdf(y)
        return density + norm(1.5 + 0.5 * np.log(2.0), 1.0).logpdf(logs[:2]).sum()

    one, other = np.array([0.3, 1.0, -2.0, -6.0]), np.array([1.5, 2.5, 0.5, -4.0])
    change = (float(_loss(one, x, y)[0]) - float(_loss(other, x, y)[0])) * len(y)
    assert change == pytest.approx(direct(other) - direct(one), rel=1e-8)


def test_failed_and_repeated_rows_are_left_out(tmp_path):
    rows = runs(20).tolist()
    rows += [rows[3], [0.2, 0.2, "", 1.0], [0.3, 0.3, "nan", 1.0]]
    samples = samples_of(table(tmp_path, rows))
    assert (len(samples.theta), samples.failed, samples.repeated) == (20, 2, 1)


@pytest.mark.parametrize(
    ("rows", "text", "complaint"),
    [
        (runs(6), TABLE, "has 6 runs with outputs; give 10 or more"),
        (np.vstack([runs(20), runs(20)[:1] + [0, 0, 1, 0]]), TABLE, "rows 1 and 21 have the same"),
        (runs(20) * [0, 1, 1, 1], TABLE, "'a' is the same in all rows"),
        ([["x", 1, 1, 1], *runs(20).tolist()], TABLE, "row 1, column 'a' is 'x', not a number"),
        ([["", 1, 1, 1], *runs(20).tolist()], TABLE, "row 1, column 'a' is empty"),
        (runs(20), TABLE.replace("volume", "pressure"), "there is no column 'pressure', but a, b"),
        (runs(20), TABLE.replace("runs.csv", "rums.csv"), "rums.csv"),
    ],
)
def test_tables_that_say_too_little_are_refused(tmp_path, rows, text, complaint):
    with pytest.raises(InputError, match=complaint):
        samples_of(table(tmp_path, rows, text))


def test_a_table_makes_no_runs(tmp_path):
    with pytest.raises(InputError, match="is a table of runs; there is no solver"):
        ExternalSimulator(table(tmp_path, runs()))(jnp.array([0.5, 0.5]))
