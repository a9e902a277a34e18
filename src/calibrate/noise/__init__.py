"""Measurement noise, one kind a file; the kinds are listed in :data:`NOISES`."""

from calibrate.noise.correlated import CorrelatedNoise
from calibrate.noise.discrepancy import DiscrepancyNoise, with_discrepancy
from calibrate.noise.gaussian import GaussianNoise
from calibrate.noise.protocol import Noise, Sites, information_about_means
from calibrate.noise.registry import NOISES, noise_of, parse_noise
from calibrate.noise.student_t import StudentTNoise

__all__ = [
    "NOISES",
    "CorrelatedNoise",
    "DiscrepancyNoise",
    "GaussianNoise",
    "Noise",
    "Sites",
    "StudentTNoise",
    "information_about_means",
    "noise_of",
    "parse_noise",
    "with_discrepancy",
]
