"""Synthetic data of a run."""

from calibrate.project.problem import read_problem, with_data


def make_data(run, scene):
    """Return the observations and the data of a run, with ``scene`` in place of the run's."""
    problem = with_data(read_problem(run, scene=scene))
    return problem.observe, dict(problem.data)
