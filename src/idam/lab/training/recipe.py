"""How a model is trained."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from idam.errors import InputError
from idam.lab.data.pairs import EXPERIMENTS, experiment_noise
from idam.network.config import Config

__all__ = ["TRAININGS", "Recipe", "check"]

TRAININGS = (*EXPERIMENTS, "practice", "practice-any-rotation", "general")
"""What a model can be trained for: the paper's experiments, disjoint halves, or pairs as practice has them."""


@dataclass(frozen=True)
class Recipe:
    """How to train; the defaults are the paper's (section 4).

    Attributes:
        experiment: one of :data:`TRAININGS`.
        config: the network.
        epochs: passes over the training shapes; may be a fraction.
        batch_size: pairs a step, over all processes.
        schedule: ``step`` divides the rate by 10 at three quarters of the epochs (30 of 40); ``one-cycle`` rises to it
            and falls to nothing.
        learning_rate: Adam's, at its highest.
        weight_decay: Adam's.
        radius: r of the loss and of balanced sampling.
        noise: sigma of the noise on both clouds; None for the experiment's own. Practice draws its own.
        keep: share of points that balanced sampling draws.
        iterations: iterations of a training step; the configuration's are those after training.
        eliminate: let hard elimination choose the target points, and half of the source points, as it does after
            training; balanced sampling chooses the other half.
        pool: number of pairs drawn once and kept with their features, which are then not trained: of FPFH, or of the
            GNN as it starts. None draws every step's pairs anew.
        start: name or file of a model, or a ``last.ckpt``, whose weights to start from; None for random ones.
        pairs: file of one's own pairs (:func:`idam.lab.data.own_pairs.read_own_pairs`), half of what general training
            draws.
        seed: of the weights, pairs and samples.
    """

    experiment: str = "unseen-shapes"
    config: Config = field(default_factory=Config)
    epochs: float = 40
    batch_size: int = 16
    schedule: str = "step"
    learning_rate: float = 1e-4
    weight_decay: float = 1e-3
    radius: float = 0.05
    noise: float | None = None
    keep: float = 1 / 6
    iterations: int = 3
    eliminate: bool = False
    pool: int | None = None
    start: str | None = None
    pairs: str | None = None
    seed: int = 0

    @property
    def sigma(self) -> float:
        """Sigma of the noise on both clouds."""
        return experiment_noise(self.experiment) if self.noise is None else self.noise

    @property
    def max_angle(self) -> float:
        """Largest angle, in radians, of pairs in any rotation; less for GNN features, which are given a near start."""
        return math.radians(75) if self.config.features == "gnn" else math.pi

    def rate(self, progress: float) -> float:
        """The learning rate at a share of the training, in [0, 1)."""
        if self.schedule == "step":
            return self.learning_rate * (0.1 if progress >= 0.75 else 1.0)
        rise = 0.2
        if progress < rise:
            low = self.learning_rate / 25
            return low + (self.learning_rate - low) * 0.5 * (1 - math.cos(math.pi * progress / rise))
        return self.learning_rate * 0.5 * (1 + math.cos(math.pi * (progress - rise) / (1 - rise)))


def check(recipe: Recipe) -> None:
    """Raise InputError where a recipe makes no sense."""
    if recipe.experiment not in TRAININGS:
        raise InputError(f"unknown experiment {recipe.experiment!r}: choose {', '.join(TRAININGS)}")
    if recipe.pairs is not None and recipe.experiment != "general":
        raise InputError("your own --pairs are for general training: choose general, or leave --pairs out")
    if recipe.schedule not in ("step", "one-cycle"):
        raise InputError(f"unknown schedule {recipe.schedule!r}: choose step or one-cycle")
    positive = (recipe.epochs, recipe.learning_rate, recipe.radius)
    if not all(0 < value < math.inf for value in positive) or recipe.batch_size < 2:
        raise InputError("epochs, the learning rate and the radius must be positive, and the batch at least 2 pairs")
    if not 0 <= recipe.sigma < math.inf:
        raise InputError(f"cannot add noise of sigma {recipe.sigma:g}: choose 0 or more, in the shapes' units")
    if not 0 < recipe.keep <= 1:
        raise InputError(f"cannot sample a share of {recipe.keep:g} of the points: choose one in (0, 1]")
    if recipe.pool is not None and recipe.pool < recipe.batch_size:
        raise InputError(f"a pool of {recipe.pool} pairs does not fill a batch of {recipe.batch_size}: choose more")
    if abs(recipe.seed) >= 2**31:
        raise InputError(f"the seed {recipe.seed} is too large: choose one of 32 bits")
