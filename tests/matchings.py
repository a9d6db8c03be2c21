"""Matches and scores made up by hand, which several tests take."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch
from scipy.spatial.distance import cdist
from torch import Tensor

from idam.clouds.pyramid import Level
from idam.search.matching import FeatureMatches, Matching
from idam.search.ranking import Answer
from motions import move

TOLERANCE = 0.02
NO_MATCHES = FeatureMatches(torch.empty(0, 3), torch.empty(0, 3), TOLERANCE)


def as_matches(source: np.ndarray, target: np.ndarray, tolerance: float = TOLERANCE) -> FeatureMatches:
    first, second = (torch.as_tensor(points, dtype=torch.float32) for points in (source, target))
    return FeatureMatches(first, second, tolerance)


def example(*right: tuple[np.ndarray, int], wrong: int, seed: int = 0) -> FeatureMatches:
    """Without noise: some that agree with each of the transforms, and wrong ones among them, in any order."""
    random = np.random.default_rng(seed)
    source = random.uniform(-0.6, 0.6, (sum(n for _, n in right) + wrong, 3))
    target = random.uniform(-0.6, 0.6, source.shape)
    first = 0
    for transformation, count in right:
        target[first : first + count] = move(transformation, source[first : first + count])
        first += count
    rows = random.permutation(len(source))
    return as_matches(source[rows], target[rows])


def swapped(matches: FeatureMatches) -> FeatureMatches:
    return FeatureMatches(matches.target, matches.source, matches.tolerance)


def matching_by(clouds: Level, score: Tensor, matches: FeatureMatches = NO_MATCHES) -> Matching:
    """What scores (N, P) say of clouds."""
    return Matching(clouds, score, score.logsumexp(1), score.logsumexp(0), matches)


def scores_for(clouds: Level, transformation: np.ndarray) -> Tensor:
    """The nearer a transform (4, 4) lays two points to each other, the more alike they are."""
    distance = cdist(move(transformation, clouds.source), clouds.target)
    return torch.as_tensor(-distance / clouds.spacing, dtype=torch.float32)


def bumpy(count: int, seed: int) -> np.ndarray:
    """Points on a closed surface without symmetry."""
    points = np.random.default_rng(seed).normal(size=(count, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    waves = np.sin(5 * points @ np.array([0.6, 0.0, 0.8])) + np.cos(4 * points @ np.array([0.0, 1.0, 0.3]))
    bumps: np.ndarray = points * [1.0, 0.6, 0.4] * (0.8 + 0.15 * waves[:, None]) + 0.2 * np.maximum(points, 0)
    return bumps


def vase(count: int, seed: int) -> np.ndarray:
    """Points on a surface of revolution about z."""
    rng = np.random.default_rng(seed)
    angle, z = rng.uniform(0, 2 * np.pi, count), rng.uniform(-0.8, 0.8, count)
    radius = 0.4 + 0.15 * np.cos(4 * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], 1)


def anything(transformations: Iterable[np.ndarray]) -> list[Answer]:
    """Transforms (4, 4) as answers, however far they turn."""
    return [Answer(x) for x in transformations]
