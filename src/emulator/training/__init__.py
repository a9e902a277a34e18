"""Training of emulators."""

from emulator.training.campaign import Runs, run_campaign
from emulator.training.sampling import sobol, uniform
from emulator.training.trainer import Plan, remove_checkpoint, train

__all__ = ["Plan", "Runs", "remove_checkpoint", "run_campaign", "sobol", "train", "uniform"]
