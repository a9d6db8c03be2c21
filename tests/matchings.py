"""Matches and scores made up by hand, which several tests take."""

from __future__ import annotations

import numpy as np

from idam.clouds.prepared import ALL, Level
from idam.clouds.pyramid import PairLevel
from idam.clouds.viewpoint import FreeSpace
from idam.clouds.voxels import downsample, ladder, rung_for
from idam.search.matching import FeatureMatches, Matching
from motions import move
from solids import distances

TOLERANCE = 0.02
NO_MATCHES = FeatureMatches(np.empty((0, 3)), np.empty((0, 3)), TOLERANCE)


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
    return FeatureMatches(source[rows], target[rows], TOLERANCE)


def swapped(matches: FeatureMatches) -> FeatureMatches:
    return FeatureMatches(matches.target, matches.source, matches.tolerance)


def level(source: np.ndarray, target: np.ndarray) -> PairLevel:
    """Two clouds as they are, of which nobody knows where they were seen from."""
    return PairLevel(Level(source, ALL), Level(target, ALL), 1.0, FreeSpace(source, target, None, None, 0.0))


def thinned(points: np.ndarray, count: int) -> np.ndarray:
    """At most so many points, evenly spread."""
    step = rung_for(points, count, 1.0)
    assert step is not None
    return downsample(points, ladder(step))


def matching_by(clouds: PairLevel, score: np.ndarray, matches: FeatureMatches = NO_MATCHES) -> Matching:
    """What scores (N, P) say of clouds."""
    score = score.astype(np.float32)
    return Matching(clouds, score, log_sum(score, 1), log_sum(score, 0), matches)


def log_sum(score: np.ndarray, axis: int) -> np.ndarray:
    """The logarithm of the sum of exponentials, of scores of any size."""
    highest = score.max(axis, keepdims=True)
    total = np.log(np.exp((score - highest).astype(np.float64)).sum(axis)) + highest.squeeze(axis)
    return np.asarray(total.astype(np.float32))


def scores_for(clouds: PairLevel, transformation: np.ndarray) -> np.ndarray:
    """The nearer a transform (4, 4) moves two points to each other, the more alike they are."""
    return -distances(move(transformation, clouds.source), clouds.target) / clouds.spacing
