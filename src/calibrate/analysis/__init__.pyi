from .identifiability import in_words, stress_band
from .sbc import LEVELS, Calibration
from .terms import find_terms

__all__ = [
    "LEVELS",
    "Calibration",
    "find_terms",
    "in_words",
    "stress_band",
]
