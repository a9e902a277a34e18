from . import families
from .plan import Plan
from .trainer import RECIPES, recipe, remove_checkpoint, train

__all__ = [
    "RECIPES",
    "Plan",
    "families",
    "recipe",
    "remove_checkpoint",
    "train",
]
