"""How alike the points of two clouds are: the similarity matrix, the matches it makes, what it says of a transform."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from idam.align import TOUCHING
from idam.clouds.pyramid import Level
from idam.errors import InputError
from idam.network.ablation import inner_products
from idam.network.features.invariant import Invariant, Surroundings, surroundings
from idam.network.model import IDAM
from idam.network.pretrained import load_model
from idam.search.overlap import touching

__all__ = ["FeatureMatches", "Matching", "mutual_matches"]

Points = NDArray[np.float64]

RANK = 2
"""Two points match where each is among the other's so many best."""
MATCHES = 600
"""Matches at most, the likeliest: the compatibility matrix grows with their square."""
TOLERANCE = 1.5
"""Spacings by which distances between two matches may differ, and by which a match may miss."""
REACH = 1.7
"""Tolerances within which a refined transform counts as bringing a match together."""
FEW = 50
"""Matches that must be there before a share of them says much."""
AGAINST, FOR = -2.0, 4.0
"""Least and most that one pair of points says against or for a transform, as a logarithm of likelihoods."""


@dataclass(frozen=True)
class FeatureMatches:
    """Points (M, 3) of the source and of the target whose features are alike, and how far right ones may miss."""

    source: Tensor
    target: Tensor
    tolerance: float

    @cached_property
    def points(self) -> tuple[Points, Points]:
        """Source and target, (M, 3) each, as every transform is tried on them: in float64."""
        return self.source.double().numpy(), self.target.double().numpy()

    def weights(self, transformation: Points) -> Points:
        """How well a transform (4, 4) brings each match together, (M,): 1 at no distance, 0 from its reach on."""
        source, target = self.points
        moved = source @ transformation[:3, :3].T + transformation[:3, 3]
        miss = np.linalg.norm(moved - target, axis=1) / (REACH * self.tolerance)
        return np.asarray((1 - miss**2).clip(0))

    def support(self, transformation: Points) -> float:
        """Share of the matches that a transform (4, 4) brings together, in [0, 1]: low where there are few of them."""
        return float((self.weights(transformation) > 0).sum() / (len(self.source) + FEW))


@dataclass(frozen=True)
class Matching:
    """What the features say of two clouds of N and P points at one resolution.

    Attributes:
        clouds: the clouds.
        score: pair scores before the softmax, (N, P).
        row: logarithm of the sum of exponentials of each row, (N,).
        column: likewise of each column, (P,).
        matches: the mutual matches.
    """

    clouds: Level
    score: Tensor
    row: Tensor
    column: Tensor
    matches: FeatureMatches

    @classmethod
    @torch.inference_mode()
    def of(cls, network: IDAM, clouds: Level) -> Matching:
        """By a network's features, or by those of the model that it names where its own turn with the cloud."""
        own = network.features
        features = own if isinstance(own, Invariant) else features_of(network.config.matched_by)
        points = [torch.as_tensor(cloud, dtype=torch.float32) for cloud in (clouds.source, clouds.target)]
        score = inner_products(*(described(features, surroundings(cloud, clouds.spacing)) for cloud in points))
        row, column = score.logsumexp(1), score.logsumexp(0)
        pairs = mutual_matches(score, row, column)
        matches = FeatureMatches(points[0][pairs[:, 0]], points[1][pairs[:, 1]], TOLERANCE * clouds.spacing)
        return cls(clouds, score, row, column, matches)

    def likelihood(self, transformation: Points) -> float:
        """How much likelier the similarity matrix makes what a transform (4, 4) lays together than chance does.

        A sum over the source points that the transform lays on the target, of log S(i, j) over its value were all
        points alike, by row or by column, whichever is less; over the number of points of the smaller cloud. Points
        like all others say nothing; those that lie on others unlike them speak against the transform.
        """
        surfaces = self.clouds.surfaces
        rows, columns = touching(surfaces.source, surfaces.target, transformation, TOUCHING * self.clouds.spacing)
        score = self.score[rows, columns]
        by_row = score - self.row[rows] + np.log(self.score.shape[1])
        by_column = score - self.column[columns] + np.log(self.score.shape[0])
        return float(torch.minimum(by_row, by_column).clamp(AGAINST, FOR).sum() / min(self.score.shape))


@lru_cache(2)
def features_of(model: str) -> Invariant:
    """Those of a model, on the CPU; raise InputError where they turn with the cloud."""
    features = load_model(model).features
    if not isinstance(features, Invariant):
        raise InputError(f"matched_by={model}: its features turn with the cloud; name a model such as general")
    return features


def described(features: Invariant, around: Surroundings) -> Tensor:
    """Features (N, K), on the CPU, of a cloud there; worked out where the network is."""
    device = features.length.device
    return features.describe(Surroundings(*(x.to(device) for x in around))).cpu()


def mutual_matches(score: Tensor, row: Tensor, column: Tensor) -> Tensor:
    """Rows and columns (M, 2) of scores (N, P) where each is among the other's best, the likeliest first.

    The likelihood of a match is its share of the softmax of its row, the similarity matrix (equation 3), times that of
    the softmax of its column: a point that is like many others is a poor match to all of them.

    Args:
        score: (N, P).
        row: logarithms of the sums of exponentials of the rows, (N,).
        column: likewise of the columns, (P,).
    """
    best = [
        torch.zeros_like(score, dtype=torch.bool).scatter_(
            dim, score.topk(min(RANK, score.shape[dim]), dim).indices, True
        )
        for dim in (0, 1)
    ]
    pairs = (best[0] & best[1]).nonzero()
    i, j = pairs.unbind(1)
    likelihood = 2 * score[i, j] - row[i] - column[j]
    return pairs[likelihood.sort(descending=True, stable=True).indices[:MATCHES]]
