"""Training of emulators."""

from emulator.training.checkpoint import remove_checkpoint
from emulator.training.family import pretrain
from emulator.training.plan import RECIPES, Plan, recipe
from emulator.training.trainer import train

__all__ = ["RECIPES", "Plan", "pretrain", "recipe", "remove_checkpoint", "train"]
