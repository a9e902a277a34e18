from dataclasses import replace

import numpy as np
import pytest

import calibrate as cal
import emulator as em
from calibrate.statistical_model import FEMLikelihood, fem_likelihood
from emulator.fem.campaign import workers
from emulator.fem.solution import Status
from linear_support import linear_forward


def test_what_fem_says_at_a_draw(beam, simulator):
    """Against FEM and the normal density by hand."""
    observe = cal.nodal_displacements(beam, [3, 11])
    model = cal.model(linear_forward(beam), observe, cal.GaussianNoise(sd=0.2))
    draw = {"mu": 70.0, "lam": 80.0}
    u = np.asarray(simulator(beam.theta(**draw)))
    data = {"displacement": u[[3, 11]] + 0.1}
    found = FEMLikelihood(model, simulator)(draw, data, stability=True)
    by_hand = -0.5 * 6 * (0.1 / 0.2) ** 2 - 6 * np.log(0.2 * np.sqrt(2.0 * np.pi))
    np.testing.assert_allclose(found.fem, by_hand, rtol=1e-6)
    np.testing.assert_allclose(found.means["displacement"], u[[3, 11]], atol=1e-6)
    assert found.converged
    assert found.stable
    assert 0.5 < found.smallest_J < 1.0
    assert found.cheap < found.fem
    assert FEMLikelihood(model, simulator)(draw, data).stable is None


def test_slopes_of_the_means_are_those_of_differences(beam, simulator):
    observe = cal.nodal_displacements(beam, [3, 11])
    model = cal.model(linear_forward(beam), observe, cal.GaussianNoise(sd=0.2))
    data = {"displacement": np.zeros((2, 3))}
    fem = FEMLikelihood(model, simulator)

    def told(mu, lam):
        return next(fem.many([{"mu": mu, "lam": lam}], data, slopes=True))[1]

    slopes = told(70.0, 80.0).slopes
    assert slopes.shape == (6, 1, 2)
    for k, step in enumerate(((0.1, 0.0), (0.0, 0.1))):
        ahead, behind = (
            np.asarray(told(70.0 + sign * step[0], 80.0 + sign * step[1]).means["displacement"])
            for sign in (1.0, -1.0)
        )
        difference = (ahead - behind).ravel() / 0.2
        np.testing.assert_allclose(slopes[:, 0, k], difference, rtol=1e-4, atol=1e-7)
    assert fem({"mu": 70.0, "lam": 80.0}, data).slopes is None


PULL = em.Parameter("pull", "kPa", 0.5, 3.0)


@pytest.fixture(scope="module")
def pulled(beam):
    """The beam without gravity, pulled at its end: the model of two load states, the larger first.

    It has the beam's two moduli as unknowns.
    """
    scene = replace(
        beam, name="pulled", origin={}, parameters=(*beam.parameters, PULL),
        mesh=replace(beam.mesh, facet_sets={"end": _end_facets(beam.mesh)}),
        loads=(em.loads.DeadPressure("end", parameter="pull"),),
    )  # fmt: skip
    observe = {
        f"u@{state}": cal.nodal_displacements(scene, [3, 11]) for state in ("large", "small")
    }
    known = {"pull@large": 2.0, "pull@small": 1.0}
    return cal.model(linear_forward(scene), observe, {"u": cal.GaussianNoise(sd=0.2)}, known=known)


def _end_facets(mesh):
    facets = em.geometry.boundary_facets(mesh.elements)
    x = mesh.nodes[facets][:, :, 0]
    return facets[(x == x.max()).all(axis=1)]


def _solved(monkeypatch, *, fails=False):
    """The tasks that are solved from here on."""
    solve, tasks = workers.Solver.__call__, []

    def recorded(solver, task):
        tasks.append(task)
        row = solve(solver, task)
        failed = row.solution._replace(status=np.asarray(Status.LOAD_LIMIT))
        return row._replace(solution=failed) if fails else row

    monkeypatch.setattr(workers.Solver, "__call__", recorded)
    return tasks


def test_states_of_a_draw_start_from_the_state_before(pulled, monkeypatch):
    """The smaller load is solved first, and its solution and derivatives begin the larger one's."""
    simulator, tasks = em.Simulator(pulled.forward.scene), _solved(monkeypatch)
    draw = {"mu": 70.0, "lam": 80.0}
    fem = FEMLikelihood(pulled, simulator)
    ((_, (large, small)),) = fem.equilibria([draw], slopes=True)
    assert [float(task.theta[2]) for task in tasks] == [1.0, 2.0]
    u, along = tasks[1].starts[:2]
    np.testing.assert_array_equal(u, small.displacement)
    np.testing.assert_allclose(along, u + small.sensitivities[2], atol=1e-12)
    for field, pull in ((large, 2.0), (small, 1.0)):
        theta = pulled.forward.scene.theta(**draw, pull=pull)
        np.testing.assert_allclose(field.displacement, simulator(theta), atol=1e-8)
    assert len(tasks[0].starts) == 1
    ((_, (_, again)),) = fem.equilibria([draw])
    assert len(tasks) == 2  # it was kept
    assert again is small
    fem.kept.clear()
    ((_, (_, again)),) = fem.equilibria([draw])
    np.testing.assert_allclose(tasks[3].starts[0], again.displacement)
    assert len(tasks[3].starts) == 2


@pytest.mark.parametrize("kept", [None, {}])
def test_the_map_starts_last_unless_the_solutions_teach_it(pulled, monkeypatch, kept):
    """The solver takes the last start of a body that is known under load."""
    simulator, tasks = em.Simulator(pulled.forward.scene), _solved(monkeypatch)
    fem = FEMLikelihood(pulled, simulator, kept=kept)
    list(fem.equilibria([{"mu": 70.0, "lam": 80.0}]))
    list(fem.equilibria([{"mu": 75.0, "lam": 80.0}]))
    by_map = pulled.full(pulled.forward.scene.theta(mu=75.0, lam=80.0, pull=1.0))
    starts = tasks[2].starts
    assert len(starts) == 2
    np.testing.assert_allclose(starts[-1 if kept is None else 0], by_map, atol=1e-12)


def test_a_draw_that_fails_in_one_state_is_not_solved_in_another(pulled, monkeypatch):
    tasks = _solved(monkeypatch, fails=True)
    draws = [{"mu": 70.0, "lam": 80.0}, {"mu": 90.0, "lam": 80.0}]
    fem = FEMLikelihood(pulled, em.Simulator(pulled.forward.scene))
    assert list(fem.equilibria(draws)) == [(0, None), (1, None)]
    assert len(tasks) == 2


def test_solutions_that_nobody_asked_to_keep_are_bounded(pulled, monkeypatch):
    monkeypatch.setattr(
        fem_likelihood, "_MOST_BYTES", 3 * 24 * len(pulled.forward.scene.mesh.nodes)
    )
    fem = FEMLikelihood(pulled, em.Simulator(pulled.forward.scene))
    draws = [{"mu": mu, "lam": 80.0} for mu in (60.0, 70.0, 80.0)]
    for number, fields in fem.equilibria(draws):
        assert len(fields) == 2, number
    assert len(fem.kept) == 3
    ((_, (large, _)),) = fem.equilibria(draws[2:])
    assert large is list(fem.kept.values())[-2]
    solutions = {}
    list(FEMLikelihood(pulled, fem.simulator, kept=solutions).equilibria(draws))
    assert len(solutions) == 6
