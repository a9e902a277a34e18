"""Training of emulators."""

from emulator.training.checkpoint import remove_checkpoint
from emulator.training.plan import Plan
from emulator.training.trainer import RECIPES, recipe, train

__all__ = ["RECIPES", "Plan", "recipe", "remove_checkpoint", "train"]
