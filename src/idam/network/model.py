"""IDAM: iterative distance-aware similarity matrix convolution (section 3)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor, nn

from idam.network.ablation import EqualValidity, InnerProduct, RandomSignificance
from idam.network.config import Config
from idam.network.elimination import Significance, Validity, hybrid_weights, keep_most_significant
from idam.network.features import GNN, build_features
from idam.network.geometry import apply_transform, compose, gather_points, weighted_procrustes
from idam.network.similarity import SimilarityConvolution

__all__ = ["IDAM", "Iteration", "KeyPoints", "Output"]


STILL = 1e-3
"""Largest move of a point, in the clouds' unit radii, that ends the iterations: a tenth of the paper's noise.
Only past the iterations that have weights of their own: the paper's three are never cut short. With 1e-4, a first try
on noisy pairs takes 10.6 iterations, not 8.1, and errs by 0.262 degrees, not 0.266; further tries make up for it."""

Graphs = tuple[Tensor, Tensor] | None
"""Neighbours in the source (B, N, K) and in the target (B, P, K)."""


@dataclass(frozen=True)
class Iteration:
    """One iteration, of M source and L target key points.

    Attributes:
        source: the source's key points as the iteration found them, moved by all before it, (B, M, 3).
        score: pair scores before the softmax, (B, M, L).
        match: where each source point goes to in the target, (B, M, 3).
        correspondence: the row's best target point, argmax_j S(i, j), (B, M).
        validity_logit: logit of the validity v(i), (B, M).
        weight: w_i of the Procrustes problem, (B, M), sum 1.
        rotation: of this iteration's own step, (B, 3, 3).
        translation: of this iteration's own step, (B, 3).
    """

    source: Tensor
    score: Tensor
    match: Tensor
    correspondence: Tensor
    validity_logit: Tensor
    weight: Tensor
    rotation: Tensor
    translation: Tensor

    @property
    def similarity(self) -> Tensor:
        """The similarity matrix S (B, M, L), each row a distribution over the target's key points (equation 3)."""
        return self.score.softmax(-1)

    @property
    def validity(self) -> Tensor:
        """v(i), the probability that the match of each source key point is right, (B, M)."""
        return self.validity_logit.sigmoid()


class Clouds(NamedTuple):
    """B pairs of clouds (B, N, 3) and (B, P, 3), their features, and their neighbours where features have any."""

    source: Tensor
    target: Tensor
    source_features: Tensor
    target_features: Tensor
    source_neighbours: Tensor | None
    target_neighbours: Tensor | None

    def pairs(self, rows: Tensor) -> Clouds:
        """Some of the pairs."""
        return Clouds(*(None if part is None else part[rows] for part in self))  # type: ignore[arg-type]


@dataclass(frozen=True)
class KeyPoints:
    """What hard elimination leaves of B clouds of N points.

    Attributes:
        points: (B, M, 3).
        features: (B, M, K).
        index: their rows in the cloud, (B, M).
        significance: s(i) of every point of the cloud, (B, N).
    """

    points: Tensor
    features: Tensor
    index: Tensor
    significance: Tensor


@dataclass(frozen=True)
class Output:
    """The registration of B pairs.

    Attributes:
        rotation: (B, 3, 3), of the whole transform from source to target.
        translation: (B, 3).
        iterations: what each iteration saw and did.
        source: its key points, where it was given.
        target: its key points.
        trust: mean validity of the matches that kept a weight in the last iteration, (B,), in [0, 1].

    Where the configuration tries again, each pair has the transform and the trust of its best try; iterations and key
    points are those of the first, which all pairs of a batch take. Iterations end early where none moves a point any
    more (:data:`STILL`).
    """

    rotation: Tensor
    translation: Tensor
    iterations: list[Iteration]
    source: KeyPoints
    target: KeyPoints
    trust: Tensor

    def transforms(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Rotations and translations of some of the pairs."""
        return self.rotation[rows], self.translation[rows]


class IDAM(nn.Module):
    """The network of the paper: features, hard elimination, and the iterated match, eliminate, solve, move."""

    def __init__(self, config: Config | None = None) -> None:
        super().__init__()
        self.config = config or Config()
        self.features = build_features(self.config)
        inputs, channels, blocks = self.features.channels, self.config.channels, range(self.config.blocks)
        self.significance = Significance(inputs, channels) if self.config.hard_elimination else RandomSignificance()
        self.similarity = nn.ModuleList(
            SimilarityConvolution(inputs, channels) if self.config.convolution else InnerProduct(channels)
            for _ in blocks
        )
        self.validity = nn.ModuleList(
            Validity(channels) if self.config.hybrid_elimination else EqualValidity() for _ in blocks
        )

    def forward(self, source: Tensor, target: Tensor, neighbours: Graphs = None) -> Output:
        """Register batches of clouds: the transform that moves each source onto its target (figure 2).

        Args:
            source: (B, N, 3), scaled like the training data (about the unit sphere).
            target: (B, P, 3); P may differ from N.
            neighbours: of GNN features, the rows of each point's K nearest others, (B, N, K) and (B, P, K); None to
                search for them (:meth:`idam.network.features.gnn.GNN.graph`).

        Returns:
            The transform, with everything each iteration saw. Scores and validity are differentiable in the weights;
            the transform is not: no gradient passes the SVD (section 3.4).
        """
        neighbours = self.graphs(source, target) if neighbours is None else neighbours
        features = self.encode(source, target, neighbours)
        output = self.match(self.eliminate(source, features[0]), self.eliminate(target, features[1]))
        clouds = Clouds(source, target, *features, *(neighbours or (None, None)))
        for keep in self.config.keep_again:
            if self.features.rotation_invariant:  # they are no more alike where a wrong try led
                output = self._better(output, clouds, keep, anew=True)
            output = self._better(output, clouds, keep)
        return output

    def _better(self, output: Output, clouds: Clouds, keep: float, *, anew: bool = False) -> Output:
        """The output with another try of the pairs whose matches are not to be trusted, where it is trusted more."""
        rows = (output.trust < self.config.trusted).nonzero().squeeze(-1)
        if len(rows) == 0:
            return output
        start = no_motion(clouds.source[rows]) if anew else output.transforms(rows)
        return better(output, self._again(clouds.pairs(rows), keep, *start), rows)

    def _again(self, clouds: Clouds, keep: float, rotation: Tensor, translation: Tensor) -> Output:
        """Another try from where a transform leads, with a share of the points to keep and twice the iterations.

        Features that change with the pose are more alike where the best try so far led.
        """
        source, features = apply_transform(clouds.source, rotation, translation), clouds.source_features
        if not self.features.rotation_invariant:
            features = self.describe(source, clouds.source_neighbours)
        target = self.eliminate(clouds.target, clouds.target_features, keep)
        step = self.match(self.eliminate(source, features, keep), target, 2 * self.config.iterations)
        with torch.autocast(source.device.type, enabled=False):
            rotation, translation = compose(step.rotation, step.translation, rotation, translation)
        return replace(step, rotation=rotation, translation=translation)

    def graphs(self, source: Tensor, target: Tensor) -> Graphs:
        """The neighbours that features of both clouds are built on, which no rigid motion changes; None without any."""
        return (self.features.graph(source), self.features.graph(target)) if isinstance(self.features, GNN) else None

    def describe(self, points: Tensor, neighbours: Tensor | None) -> Tensor:
        """Features (B, N, K) of points (B, N, 3)."""
        features: Tensor = self.features(points) if neighbours is None else self.features(points, neighbours)
        return features

    def encode(self, source: Tensor, target: Tensor, neighbours: Graphs = None) -> tuple[Tensor, Tensor]:
        """Features (B, N, K) and (B, P, K) of both clouds; equally large clouds go through as one batch."""
        near, other = neighbours or (None, None)
        if source.shape == target.shape:
            both = None if near is None or other is None else torch.cat([near, other])
            source_features, target_features = self.describe(torch.cat([source, target]), both).chunk(2)
            return source_features, target_features
        return self.describe(source, near), self.describe(target, other)

    def eliminate(self, points: Tensor, features: Tensor, keep: float | None = None) -> KeyPoints:
        """Hard elimination: the most significant of the points (B, N, 3) with features (B, N, K)."""
        significance = self.significance(features)
        index = keep_most_significant(significance, self.config.keep if keep is None else keep)
        return KeyPoints(gather_points(points, index), gather_points(features, index), index, significance)

    def match(self, source: KeyPoints, target: KeyPoints, count: int | None = None) -> Output:
        """Register key points, in ``count`` iterations: one try of :meth:`forward` from hard elimination on."""
        iterations = self.iterate(source.points, target.points, source.features, target.features, count)
        with torch.autocast(source.points.device.type, enabled=False):
            rotation, translation = chain(iterations)
        kept = iterations[-1].weight > 0
        trust = (iterations[-1].validity * kept).sum(-1) / kept.sum(-1).clamp_min(1)
        return Output(rotation, translation, iterations, source, target, trust.detach())

    def iterate(
        self,
        source: Tensor,
        target: Tensor,
        source_features: Tensor,
        target_features: Tensor,
        count: int | None = None,
    ) -> list[Iteration]:
        """Match key points (B, M, 3) to (B, L, 3), solve for the step, move the source, and again."""
        iterations: list[Iteration] = []
        count = self.config.iterations if count is None else count
        for n in range(count):
            block = min(n, self.config.blocks - 1)
            maximum, score = self.similarity[block](source, target, source_features, target_features)
            step = self._solve(source, target, score, self.validity[block](maximum))
            iterations.append(step)
            with torch.autocast(source.device.type, enabled=False):
                moved = apply_transform(source, step.rotation, step.translation)
            if self.config.blocks <= n + 1 < count and not self.training and is_still(source, moved):
                break
            source = moved
        return iterations

    @torch.no_grad()
    def _solve(self, source: Tensor, target: Tensor, score: Tensor, validity_logit: Tensor) -> Iteration:
        correspondence = score.max(-1).indices  # as argmax, in two thirds of its time
        with torch.autocast(source.device.type, enabled=False):
            weight = hybrid_weights(validity_logit.to(source.dtype).sigmoid(), self.config.keep_matches)
            if self.config.soft_matches:
                match = score.to(source.dtype).softmax(-1) @ target
            else:
                match = gather_points(target, correspondence)
            rotation, translation = weighted_procrustes(source, match, weight)
        return Iteration(source, score, match, correspondence, validity_logit, weight, rotation, translation)


def no_motion(points: Tensor) -> tuple[Tensor, Tensor]:
    """The rotations (B, 3, 3) and translations (B, 3) that leave points (B, N, 3) where they are."""
    return torch.eye(3).to(points).expand(len(points), 3, 3), torch.zeros_like(points[:, 0])


def better(first: Output, second: Output, rows: Tensor) -> Output:
    """Both tries as one: for each pair of the second, which are those rows of the first, the one trusted more."""
    take = second.trust > first.trust[rows]
    rows = rows[take]
    return replace(
        first,
        rotation=first.rotation.index_copy(0, rows, second.rotation[take]),
        translation=first.translation.index_copy(0, rows, second.translation[take]),
        trust=first.trust.index_copy(0, rows, second.trust[take]),
    )


def is_still(before: Tensor, after: Tensor) -> bool:
    """Whether no point of a batch (B, M, 3) has moved, so that all iterations to come would find the same again."""
    return bool((after - before).abs().max() < STILL)


def chain(iterations: list[Iteration]) -> tuple[Tensor, Tensor]:
    """The whole transform, rotation (B, 3, 3) and translation (B, 3), of consecutive steps."""
    rotation, translation = iterations[0].rotation, iterations[0].translation
    for step in iterations[1:]:
        rotation, translation = compose(step.rotation, step.translation, rotation, translation)
    return rotation, translation
