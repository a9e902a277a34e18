r"""How far an entry's draws are from the reference's.

Draws are taken to the scale on which the prior is uniform and divided by the reference's standard
deviation. The sliced Wasserstein distance is the mean over unit directions :math:`e_k` of

.. math:: W_1(e_k \cdot x, e_k \cdot y) = \int |F_x - F_y| \, dt

(Bonneel et al. 2015), in posterior standard deviations. Draws of one distribution are apart, too:
``floor`` is the distance of draws of the reference itself, as many as the entry has, from it.
"""

from typing import Any

import numpy as np
from scipy.stats import wasserstein_distance
from studies.inverse_benchmark.problems import scene_of
from studies.inverse_benchmark.tables import Table

DIRECTIONS = 100
SEED = 7


def score(entry: Table, reference: Table) -> dict[str, Any]:
    """Distances of ``entry`` from ``reference``: sliced Wasserstein, shifts, ratios of sd."""
    names = scene_of().parameter_names
    one, other = _scaled(entry, reference)
    shift = one.mean() - other.mean()
    ratio = one.sd() / other.sd()
    return {
        "draws": len(entry.draws),
        "sliced": sliced(one, other),
        "floor": floor(other, len(entry.draws)),
        "shift": dict(zip(names, shift.tolist(), strict=True)),
        "sd_ratio": dict(zip(names, ratio.tolist(), strict=True)),
        "largest_shift": float(np.abs(shift).max()),
        "largest_log_sd": float(np.abs(np.log(ratio)).max()),
    }


def sliced(one: Table, other: Table) -> float:
    """Sliced Wasserstein distance of two sets of draws."""
    rng = np.random.default_rng(SEED)
    directions = rng.normal(size=(DIRECTIONS, one.draws.shape[1]))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    return float(
        np.mean([
            wasserstein_distance(one.draws @ e, other.draws @ e, one.weights, other.weights)
            for e in directions
        ])
    )  # fmt: skip


def floor(reference: Table, count: int) -> float:
    """Mean distance of ``count`` draws of the reference, with replacement, from it."""
    rng = np.random.default_rng(SEED)
    found = []
    for _ in range(5):
        rows = rng.choice(len(reference.draws), count, p=reference.weights)
        found.append(sliced(Table(reference.draws[rows], np.full(count, 1.0 / count)), reference))
    return float(np.mean(found))


def _scaled(entry: Table, reference: Table) -> tuple[Table, Table]:
    """Both in the unit box over the reference's standard deviation."""
    space = scene_of().space
    unit = [
        table._replace(draws=np.asarray(space.to_unit(table.draws))) for table in (entry, reference)
    ]
    sd = unit[1].sd()
    return unit[0]._replace(draws=unit[0].draws / sd), unit[1]._replace(draws=unit[1].draws / sd)
