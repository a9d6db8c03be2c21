"""What the curves show, computed from the network's outputs: errors by iteration, and how far to trust the validity."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from idam.lab.data.pairs import Pairs
from idam.network.geometry import apply_transform, gather_points, rotation_angle
from idam.network.model import IDAM, Output, chain

__all__ = ["Calibration", "Observed", "calibrate", "iteration_errors", "observe", "right_matches"]

RIGHT = 0.05
"""Distance within which a match is right (the paper's r)."""


@dataclass(frozen=True)
class Observed:
    """What the network did on n pairs, in T iterations of M matches each.

    Attributes:
        errors: rotation errors in degrees before the first and after every iteration, (n, T + 1).
        validity: of every match of the last iteration, (n, M).
        right: whether that match is right, (n, M).
    """

    errors: Tensor
    validity: Tensor
    right: Tensor


@dataclass(frozen=True)
class Calibration:
    """How the predicted validity compares with the truth, in B bins of equal width; NaN in empty ones.

    Attributes:
        predicted: mean validity of each bin, (B,).
        observed: share of right matches in each bin, (B,).
        count: matches in each bin, (B,).
        error: expected calibration error, the mean of |predicted - observed| over all matches.
    """

    predicted: Tensor
    observed: Tensor
    count: Tensor
    error: float


@torch.inference_mode()
def observe(network: IDAM, pairs: Pairs) -> Observed:
    """Register pairs one by one, as a user would, with a network that tries once."""
    errors, validity, right = [], [], []
    for n in range(len(pairs)):
        pair = pairs[n : n + 1]
        output = network(pair.source, pair.target)
        found = iteration_errors(output, pair.rotation)
        left_out = 1 + network.config.iterations - found.shape[1]  # where no point moved any more
        errors.append(torch.cat([found, found[:, -1:].expand(-1, left_out)], 1))
        validity.append(output.iterations[-1].validity)
        right.append(right_matches(output, pair.rotation, pair.translation))
    return Observed(torch.cat(errors), torch.cat(validity), torch.cat(right))


def iteration_errors(output: Output, true_rotation: Tensor) -> Tensor:
    """Rotation errors (B, T + 1) in degrees before the first and after each of T iterations."""
    steps = output.iterations
    so_far = [chain(steps[:n])[0] for n in range(1, len(steps) + 1)]
    rotation = torch.stack([torch.eye(3).expand_as(true_rotation), *so_far], 1)
    return rotation_angle(true_rotation.unsqueeze(1).double() @ rotation.double().transpose(-1, -2))


def right_matches(output: Output, true_rotation: Tensor, true_translation: Tensor) -> Tensor:
    """Whether the true transform takes each source key point to within 0.05 of its best target point, (B, M)."""
    match = gather_points(output.target.points, output.iterations[-1].correspondence)
    offset = apply_transform(output.source.points, true_rotation, true_translation) - match
    return offset.square().sum(-1) <= RIGHT**2


def calibrate(validity: Tensor, right: Tensor, bins: int = 10) -> Calibration:
    """Compare validities in [0, 1] with whether the matches are right, both of the same shape."""
    validity, right = validity.flatten().double(), right.flatten().double()
    index = (validity * bins).long().clamp_max(bins - 1)
    count = torch.bincount(index, minlength=bins)
    predicted = torch.bincount(index, validity, minlength=bins) / count
    observed = torch.bincount(index, right, minlength=bins) / count
    gap = (predicted - observed).abs().nan_to_num() * count
    return Calibration(predicted, observed, count, float(gap.sum() / count.sum()))
