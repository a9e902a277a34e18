"""Which parameter moves what: global sensitivity of observations, and of the whole field.

:func:`sensitivity` takes a forward map and observations; :func:`analyse` any function of the unit
cube. Variance-based indices and screening are SALib's.
"""

from calibrate.analysis.sensitivity.analysis import METHODS, analyse
from calibrate.analysis.sensitivity.factors import Factors
from calibrate.analysis.sensitivity.of_maps import FIELD, sensitivity

__all__ = ["FIELD", "METHODS", "Factors", "analyse", "sensitivity"]
