"""Training for practice: features that tell the points of any two scans apart (sections 3.3.1 and 3.4).

The scans differ in size, and their features do not depend on their pose: one iteration's matching and elimination are
all there is to supervise. A row of the similarity matrix has all of the other scan's points, and so has a column.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from idam import rigid
from idam.describe.invariant import Surroundings, surroundings
from idam.errors import InputError
from idam.lab.data.general import Material, draw_halves, draw_scans, load_meshes
from idam.lab.data.modelnet40 import load
from idam.lab.data.own_pairs import read_own_pairs
from idam.lab.data.working import ScanPair
from idam.lab.training.batches import VALIDATION_SEED, generator_at
from idam.lab.training.checkpoint import initial_model
from idam.lab.training.recipe import Recipe
from idam.network.ablation import inner_products
from idam.network.features.invariant import Invariant
from idam.network.model import IDAM
from idam.network.supervision import negative_entropy_loss

__all__ = ["GeneralStep", "GeneralTask", "MatchLoss", "ScannedPair", "learns_features_alone", "matching_of"]

PAIRS = {"general": 9600, "practice-any-rotation": 24_000}
"""Different pairs to train on, by what for: drawn once, and then kept, in some 4 GB."""
VALIDATION_PAIRS = 100
HELD = 8
"""One in so many shapes and meshes is held out for validation."""
MATCHED = 1.0
"""Spacings within which a point's nearest in the other scan is its match."""
AMBIGUOUS = 2.5
"""Spacings within which other points are neither right nor wrong."""
LEAST = -1e4
"""Score of what is left out, where the logarithm of a probability must be a number."""
ROWS = 200
"""Rows and columns of the similarity matrix, with a match each, that a pair teaches at a step."""


Draw = Callable[[Material, np.random.Generator], ScanPair]


class MatchLoss(NamedTuple):
    """The parts of the loss, and what they say of the pairs.

    Attributes:
        matching: cross-entropy of rows and columns that have a match.
        entropy: regression of the significance to the negative entropy.
        accuracy: share of those rows and columns whose best is right.
    """

    matching: Tensor
    entropy: Tensor
    accuracy: Tensor

    @property
    def total(self) -> Tensor:
        """The sum that is minimised (equation 13, less the validity's part)."""
        return self.matching + self.entropy


@dataclass(frozen=True)
class MatchScores:
    """The loss on the validation pairs.

    Attributes:
        matching: cross-entropy.
        accuracy: share of points with a match whose best is right.
    """

    matching: float
    accuracy: float

    def to_dict(self) -> dict[str, float]:
        """Both, by name."""
        return asdict(self)


class ScannedPair(NamedTuple):
    """What a pair teaches.

    Attributes:
        source: surroundings of its N points.
        target: surroundings of its P points.
        aligned: source points under the truth, in spacings, (N, 3).
        goal: target points, in spacings, (P, 3).
    """

    source: Surroundings
    target: Surroundings
    aligned: Tensor
    goal: Tensor


class Lesson(NamedTuple):
    """The pairs of a step, and what their rows and columns are drawn from."""

    pairs: list[ScannedPair]
    generator: torch.Generator


class GeneralStep(nn.Module):
    """The network and its loss as one module, so that distributed wrappers see one forward pass."""

    def __init__(self, model: IDAM) -> None:
        super().__init__()
        self.model = model

    def forward(self, lesson: Lesson) -> MatchLoss:
        """The mean loss of a step's pairs."""
        losses = [self.loss(pair, lesson.generator) for pair in lesson.pairs]
        return MatchLoss(*(torch.stack(parts).mean() for parts in zip(*losses, strict=True)))

    def loss(self, pair: ScannedPair, generator: torch.Generator) -> MatchLoss:
        """The loss of one pair, of its rows and of its columns."""
        describe = cast(Invariant, self.model.features).describe
        features = [describe(side) for side in (pair.source, pair.target)]
        # the significance learns from features that learn to match, and leaves them alone
        significance = [self.model.significance(x.detach()[None])[0] for x in features]
        distance = torch.cdist(pair.aligned, pair.goal)
        ways = [
            matching_of(features[0], features[1], distance, significance[0], generator),
            matching_of(features[1], features[0], distance.t(), significance[1], generator),
        ]
        return MatchLoss(*(torch.stack(parts).mean() for parts in zip(*ways, strict=True)))


def matching_of(
    own: Tensor, other: Tensor, distance: Tensor, significance: Tensor, generator: torch.Generator
) -> MatchLoss:
    """How well points (N, K) find their matches among others (P, K), at their true distances (N, P), in spacings.

    Points near a match are no match of their own, but no mistake either: they are left out of the softmax.
    """
    nearest, match = distance.min(1)
    rows = (nearest < MATCHED).nonzero().squeeze(1)
    rows = rows[torch.randperm(len(rows), generator=generator)[:ROWS].to(rows.device)]
    if len(rows) == 0:
        zero = own.sum() * 0.0
        return MatchLoss(zero, zero, zero)
    match = match[rows]
    near = (distance[rows] < AMBIGUOUS).scatter_(1, match[:, None], False)
    score = inner_products(own[rows], other).masked_fill(near, LEAST)
    right = score.detach().argmax(1) == match
    entropy = negative_entropy_loss(significance[rows], score.detach())
    return MatchLoss(F.cross_entropy(score, match), entropy, right.float().mean())


def compact(around: Surroundings) -> Surroundings:
    """Surroundings in half the memory: clouds have fewer points than 16 bits can count."""
    return around._replace(histograms=around.histograms.astype(np.float16), near=around.near.astype(np.int16))


class GeneralTask:
    """IDAM's features on scans of surfaces of our own making, of ModelNet40's and of other meshes.

    The meshes are those in the folder ``meshes`` of the data, where there is one.
    """

    def __init__(self, recipe: Recipe, data: str | Path, precision: str) -> None:
        check_general(recipe, precision)
        self.recipe = recipe
        shapes, meshes = load(data, "train").points.numpy(), load_meshes(Path(data) / "meshes")
        taught, held = (np.arange(len(shapes)) % HELD != 0), (np.arange(len(shapes)) % HELD == 0)
        own = [] if recipe.pairs is None else read_own_pairs(recipe.pairs).pairs
        self.material = Material(
            shapes[taught],
            [mesh for n, mesh in enumerate(meshes) if n % HELD],
            [pair for n, pair in enumerate(own) if n % HELD] or own,  # a single pair is worth learning, too
        )
        self.module = GeneralStep(initial_model(recipe))
        self.size = PAIRS[recipe.experiment]
        surfaces = f"our own surfaces, ModelNet40's training split and {len(meshes)} meshes"
        if recipe.experiment != "general":
            surfaces = "ModelNet40's training split"
        self.data = f"{self.size} pairs of scans of {surfaces}"
        self.held = f"{VALIDATION_PAIRS} pairs of scans, an eighth of the shapes and meshes held out for them"
        if own:
            self.data += f", half of them {len(own)} pairs of {recipe.pairs}"
        kept = Material(shapes[held], meshes[::HELD], own[::HELD])
        draw = draw_scans if recipe.experiment == "general" else draw_halves
        # of indices that no training reaches, whatever its seed
        self.pairs = [scanned(draw, kept, VALIDATION_SEED, self.size + n) for n in range(VALIDATION_PAIRS)]
        self.pair = cache(lambda n: scanned(draw, self.material, recipe.seed, n))

    def batch(self, step: int, rank: int, world: int) -> Lesson:
        """Pairs in an order of their own in each epoch, and what their rows are drawn from."""
        size = self.recipe.batch_size
        epoch, position = divmod(step, self.size // size)
        order = np.random.default_rng((unsigned(self.recipe.seed), epoch)).permutation(self.size)
        pairs = [self.pair(int(n)) for n in order[position * size : (position + 1) * size][rank::world]]
        return Lesson(pairs, generator_at(self.recipe, step, rank))

    @torch.inference_mode()
    def validate(self) -> tuple[float, MatchScores]:
        """The matching loss, and the accuracy with it."""
        device = next(self.module.parameters()).device
        generator = torch.Generator().manual_seed(VALIDATION_SEED)
        self.module.eval()  # the running means of the significance's norms are of what is learnt from
        loss = self.module(Lesson([on_device(pair, device) for pair in self.pairs], generator))
        self.module.train()
        scores = MatchScores(loss.matching.item(), loss.accuracy.item())
        return scores.matching, scores


def learns_features_alone(recipe: Recipe) -> bool:
    """Whether a recipe is for this training: scans in any pose, and features that do not change with it."""
    halves = recipe.experiment == "practice-any-rotation" and recipe.config.features == "invariant"
    return recipe.experiment == "general" or halves


def check_general(recipe: Recipe, precision: str) -> None:
    """Raise InputError where a recipe asks for what this training does not teach."""
    if recipe.config.features != "invariant":
        raise InputError(
            "training for practice needs features that do not change with the pose: choose --features invariant"
        )
    if recipe.config.convolution or recipe.config.hybrid_elimination:
        raise InputError(
            "training for practice teaches no convolution and no validity: "
            "add --set convolution=false --set hybrid_elimination=false"
        )
    if recipe.pool is not None:
        raise InputError("training for practice trains features: leave --pool out")
    if precision != "32":
        raise InputError("training for practice is in single precision: leave --precision out")


def on_device(pair: ScannedPair, device: torch.device) -> ScannedPair:
    """The pair, moved; surroundings follow the network by themselves."""
    return pair._replace(aligned=pair.aligned.to(device), goal=pair.goal.to(device))


def scanned(draw: Draw, material: Material, seed: int, index: int) -> ScannedPair:
    """A pair of scans that depends on the seed and its index alone."""
    pair = draw(material, np.random.default_rng((unsigned(seed), index)))
    aligned = rigid.apply(pair.transformation, pair.source)
    source, target = (compact(surroundings(cloud, pair.spacing)) for cloud in (pair.source, pair.target))
    truth = (torch.from_numpy(points / pair.spacing).float() for points in (aligned, pair.target))
    return ScannedPair(source, target, *truth)


def unsigned(seed: int) -> int:
    """A seed of 32 bits as NumPy takes it, which refuses what is negative."""
    return seed % 2**32
