"""Training of emulators."""

from emulator.fem.campaign import Runs, run_campaign
from emulator.training.family import pretrain
from emulator.training.plan import RECIPES, Plan, recipe
from emulator.training.sampling import design, sobol, uniform
from emulator.training.trainer import remove_checkpoint, train

__all__ = [
    "RECIPES",
    "Plan",
    "Runs",
    "design",
    "pretrain",
    "recipe",
    "remove_checkpoint",
    "run_campaign",
    "sobol",
    "train",
    "uniform",
]
