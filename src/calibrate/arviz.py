"""ArviZ as this package uses it, imported after NumPyro.

ArviZ puts a lazy module in NumPyro's place, and a submodule that is imported through it first
leaves ``numpyro.distributions.distribution`` undefined. So whoever needs ArviZ takes it from here.
"""

import numpyro.distributions  # isort: skip  # noqa: F401
import arviz_base as base
import arviz_stats as stats
from arviz_stats import ecdf_utils
from arviz_stats.base import array_stats

__all__ = ["array_stats", "base", "ecdf_utils", "stats"]
