from .identifiability import in_words, stress_band
from .sbc import LEVELS
from .terms import find_terms

__all__ = [
    "LEVELS",
    "find_terms",
    "in_words",
    "stress_band",
]
