"""ArviZ as this package uses it, imported after NumPyro, see :func:`calibrate.mend_numpyro`."""

import numpyro.distributions  # isort: skip  # noqa: F401
import arviz_base as base
import arviz_stats as stats
from arviz_stats import ecdf_utils
from arviz_stats.base import array_stats

__all__ = ["array_stats", "base", "ecdf_utils", "stats"]
