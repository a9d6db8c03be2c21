"""Candidate transforms from the matches of invariant features: those sets of matches that agree on one rigid motion.

A rigid motion keeps distances: two right matches are as far apart in the source as in the target. Chen et al.,
"SC2-PCR: A Second Order Spatial Compatibility for Efficient and Robust Point Cloud Registration" (CVPR 2022), count for
each two compatible matches how many others both are compatible with. That number is large for two right ones and small
for two that agree by chance, so that even a few per cent of right matches stand out.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from idam import rigid
from idam.describe.products import product
from idam.rigid import Array
from idam.search.matching import FeatureMatches

__all__ = ["agreeing_transforms", "brought_together", "kabsch_rotations", "solved_anew", "weighted_procrustes"]

COMPANIONS = 20
"""Matches that a seed's first transform is solved from, besides itself."""
ROUNDS = 3
"""Times a seed's transform is solved anew, from the matches that it brings together."""


def agreeing_transforms(matches: FeatureMatches, seeds: int) -> Array:
    """Transforms (S, 4, 4) that sets of matches agree on, the largest set first; many are alike.

    Args:
        matches: of which some are right; where there are fewer than three, they agree on nothing.
        seeds: matches, the most compatible ones, from each of which a set of agreeing ones is grown.
    """
    source, target = matches.source, matches.target
    if len(source) < 3:
        return np.empty((0, 4, 4))
    second_order = _second_order_compatibility(source, target, matches.tolerance)
    seed = np.argsort(-second_order.sum(1), kind="stable")[:seeds]
    last = min(COMPANIONS, len(source)) - 1
    companion = np.argpartition(-second_order[seed], last, axis=1)[:, : last + 1]
    index = np.concatenate([seed[:, None], companion], 1)
    weight = np.take_along_axis(second_order[seed], companion, 1)
    # the seed itself is compatible with whatever its best companion is
    weight = np.concatenate([weight.max(1, keepdims=True), weight], 1)
    transforms = weighted_procrustes(source[index], target[index], weight.astype(np.float64))
    return solved_anew(matches, brought_together(matches, transforms, matches.tolerance), ROUNDS)


def solved_anew(matches: FeatureMatches, near: Array, rounds: int) -> Array:
    """Transforms (S, 4, 4) solved again and again from what they bring together, (S, M) at first; the best first."""
    for _ in range(rounds):
        transforms = weighted_procrustes(matches.source, matches.target, near)
        near = brought_together(matches, transforms, matches.tolerance)
    return transforms[np.argsort(-near.sum(1), kind="stable")]


def brought_together(matches: FeatureMatches, transforms: Array, tolerance: float) -> Array:
    """1 for the matches (S, M) that each of S transforms brings within the tolerance, 0 for the others.

    ``|R p + t - q|^2 = p^2 + q^2 + t^2 - 2 q^T R p + 2 t^T R p - 2 t^T q``: for all matches and transforms one product.
    """
    rotation, shift = transforms[:, :3, :3], transforms[:, :3, 3]
    back = (shift[:, None] @ rotation)[:, 0]
    one, square = np.ones((len(shift), 1)), (shift**2).sum(1, keepdims=True)
    factors = np.concatenate([one, square, -2 * rotation.reshape(-1, 9), 2 * back, -2 * shift], 1)
    near: Array = (product(factors, _moments(matches.source, matches.target)) < tolerance**2).astype(np.float64)
    return near


def weighted_procrustes(source: Array, target: Array, weight: Array) -> Array:
    """The rigid transforms (S, 4, 4) minimising ``sum_i w_i |R p_i + t - q_i|^2`` (section 3.3.2, equation 8).

    Both clouds are centred on their weighted means: with plain means the optimum is another one.

    Args:
        source: points p, (S, N, 3), or (N, 3) where they are the same for all.
        target: their matches q, likewise.
        weight: non-negative, (S, N), of any scale; where all are zero, they count as equal.
    """
    total = weight.sum(-1, keepdims=True)
    weight = np.where(total > 0, weight / np.where(total > 0, total, 1.0), 1.0 / weight.shape[-1])
    if source.ndim == 2:  # one cloud for all: moments are one product
        products = (source[:, :, None] * target[:, None, :]).reshape(len(source), 9)
        moments = product(weight, np.concatenate([source, target, products], 1))
        source_mean, target_mean = moments[:, :3], moments[:, 3:6]
        covariance = moments[:, 6:].reshape(-1, 3, 3) - source_mean[:, :, None] * target_mean[:, None, :]
    else:
        source_mean, target_mean = (np.einsum("sn,snd->sd", weight, points) for points in (source, target))
        centred = weight[:, :, None] * (source - source_mean[:, None])
        covariance = centred.swapaxes(1, 2) @ (target - target_mean[:, None])
    rotation, _ = kabsch_rotations(covariance)
    return rigid.transform(rotation, target_mean - (rotation @ source_mean[:, :, None])[..., 0])


def kabsch_rotations(covariance: Array) -> tuple[Array, Array]:
    """Kabsch's rotations R, those of the largest traces of R H, for covariances H (S, 3, 3); their singular values."""
    u, values, vh = np.linalg.svd(covariance)
    v = vh.swapaxes(1, 2).copy()
    v[:, :, 2] *= np.linalg.det(v @ u.swapaxes(1, 2))[:, None]
    return v @ u.swapaxes(1, 2), values


def _second_order_compatibility(source: Array, target: Array, tolerance: float) -> NDArray[np.float32]:
    """For each two compatible matches how many others both are compatible with (M, M); 0 for incompatible ones."""
    first, second = (_distances(points) for points in (source, target))
    compatible = (np.abs(first - second) < tolerance).astype(np.float32)
    np.fill_diagonal(compatible, 0)
    second_order: NDArray[np.float32] = compatible * product(compatible, compatible)
    return second_order


def _moments(source: Array, target: Array) -> Array:
    """What the square distances of M matches under any transform are linear in, (17, M)."""
    products = (target[:, :, None] * source[:, None, :]).reshape(-1, 9)
    squares = (source**2).sum(1) + (target**2).sum(1)
    return np.concatenate([squares[None], np.ones((1, len(source))), products.T, source.T, target.T])


def _distances(points: Array) -> NDArray[np.float32]:
    """Distances (M, M) of points (M, 3) from each other, coordinate by coordinate: an (M, M, 3) array takes longer."""
    square = np.zeros((len(points), len(points)), np.float32)
    for x in points.T.astype(np.float32):
        gap = x[:, None] - x
        square += gap * gap
    return np.sqrt(square)
