"""Training (sections 3.4, 3.5 and 4): a recipe, and the loop that follows it."""

from idam.lab.training.loop import train
from idam.lab.training.recipe import TRAININGS, Recipe

__all__ = ["TRAININGS", "Recipe", "train"]
