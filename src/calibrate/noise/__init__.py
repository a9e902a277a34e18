"""Measurement noise, one kind a file; the kinds are listed in :data:`KINDS`."""

from calibrate.noise.gaussian import GaussianNoise
from calibrate.noise.protocol import Noise
from calibrate.noise.registry import KINDS, noise_from_json

__all__ = ["KINDS", "GaussianNoise", "Noise", "noise_from_json"]
