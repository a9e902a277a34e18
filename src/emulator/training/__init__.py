"""Training of emulators."""

from emulator.training.family import pretrain
from emulator.training.plan import RECIPES, Plan, recipe
from emulator.training.trainer import remove_checkpoint, train

__all__ = ["RECIPES", "Plan", "pretrain", "recipe", "remove_checkpoint", "train"]
