"""Hard cases for what stands on the simulator: training, cached maps, error bars, samplers."""

from studies.stability.emulation import maps as maps
from studies.stability.emulation import sampling as sampling
from studies.stability.emulation import training as training
from studies.stability.emulation.check import CASES

__all__ = ["CASES"]
