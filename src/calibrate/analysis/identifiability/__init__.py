"""What data can determine, and what it has determined.

Before data: :func:`expected_precision`. After: :func:`identify`, :func:`profile_likelihood`,
:func:`stress_band`. For the next experiment: :func:`next_measurement`.
"""

from calibrate.analysis.identifiability.combinations import identify, in_words
from calibrate.analysis.identifiability.expected import expected_precision
from calibrate.analysis.identifiability.next_measurement import Candidate, next_measurement
from calibrate.analysis.identifiability.profile import Profile, profile_likelihood
from calibrate.analysis.identifiability.stress import StressBand, stress_band

__all__ = [
    "Candidate",
    "Profile",
    "StressBand",
    "expected_precision",
    "identify",
    "in_words",
    "next_measurement",
    "profile_likelihood",
    "stress_band",
]
