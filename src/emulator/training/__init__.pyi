from . import families
from .checkpoint import remove_checkpoint
from .plan import Plan
from .trainer import RECIPES, recipe, train

__all__ = [
    "RECIPES",
    "Plan",
    "families",
    "recipe",
    "remove_checkpoint",
    "train",
]
