"""Mutual-supervision loss (section 3.4): matching teaches elimination what is easy, elimination frees matching."""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from idam.network.geometry import apply_transform, nearest
from idam.network.model import Iteration

__all__ = ["Loss", "mutual_supervision"]


class Loss(NamedTuple):
    """The parts of the loss and what they say of the batch.

    Attributes:
        matching: cross-entropy of the similarity rows that have a match.
        entropy: regression of the significance to the negative entropy.
        elimination: binary cross-entropy of the validity.
        accuracy: share of rows with a match that the last iteration matched within r of the truth.
    """

    matching: Tensor
    entropy: Tensor
    elimination: Tensor
    accuracy: Tensor

    @property
    def total(self) -> Tensor:
        """The sum that is minimised (equation 13)."""
        return self.matching + self.entropy + self.elimination


def mutual_supervision(
    iterations: list[Iteration],
    source: Tensor,
    target: Tensor,
    rotation: Tensor,
    translation: Tensor,
    source_significance: Tensor,
    target_significance: Tensor,
    radius: float,
) -> Loss:
    """The loss of one batch of sampled points (equations 9 to 13).

    Args:
        iterations: from :meth:`idam.network.model.IDAM.iterate` on the sampled points.
        source: sampled source points as given, (B, M, 3).
        target: sampled target points, (B, L, 3).
        rotation: the true R* (B, 3, 3).
        translation: the true t* (B, 3).
        source_significance: s(i) of the sampled source points, (B, M).
        target_significance: s(j) of the sampled target points, (B, L).
        radius: r, within which points count as matching.
    """
    aligned = apply_transform(source, rotation, translation)
    distance, label = nearest(aligned, target)
    matched = distance <= radius**2
    matching = torch.stack([matching_loss(step.score.float(), label, matched) for step in iterations]).mean()
    score = iterations[0].score.float()
    entropy = negative_entropy_loss(source_significance.float(), score)
    entropy = entropy + negative_entropy_loss(target_significance.float(), score.transpose(1, 2))
    right = [is_right(aligned, step.match, radius) for step in iterations]
    elimination = torch.stack(
        [
            F.binary_cross_entropy_with_logits(step.validity_logit.float(), r.float())
            for step, r in zip(iterations, right, strict=True)
        ]
    ).mean()
    accuracy = (right[-1] & matched).sum() / matched.sum().clamp_min(1)
    return Loss(matching, entropy, elimination, accuracy)


def matching_loss(score: Tensor, label: Tensor, matched: Tensor) -> Tensor:
    """Cross-entropy of the rows (B, M) that have a match: mean of -log S(i, j*) (equations 9 and 10).

    The paper divides by M; dividing by the number of rows with a match differs by about a factor of two under balanced
    sampling, and keeps the scale where a pair has few of them.
    """
    log_likelihood = score.log_softmax(-1).gather(-1, label.unsqueeze(-1)).squeeze(-1)
    return -(log_likelihood * matched).sum() / matched.sum().clamp_min(1)


def negative_entropy_loss(significance: Tensor, score: Tensor) -> Tensor:
    """Mean of |s(i) - sum_j S(i, j) log S(i, j)|^2, the gradient cut at S (equation 11)."""
    log_similarity = score.detach().log_softmax(-1)
    return F.mse_loss(significance, (log_similarity.exp() * log_similarity).sum(-1))


def is_right(aligned: Tensor, match: Tensor, radius: float) -> Tensor:
    """[ |R* p_i + t* - p'_i|^2 <= r^2 ] (B, M): whether each match is right, the validity's label (equation 12)."""
    return (aligned - match).square().sum(-1) <= radius**2
