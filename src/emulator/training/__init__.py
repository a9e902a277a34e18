"""Training of emulators."""

from emulator.training.plan import Plan
from emulator.training.trainer import RECIPES, recipe, remove_checkpoint, train

__all__ = ["RECIPES", "Plan", "recipe", "remove_checkpoint", "train"]
