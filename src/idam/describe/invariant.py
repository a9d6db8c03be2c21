"""Learned features that do not change with the cloud's pose: FPFH, and messages from ever farther around.

Each point starts from its histograms (FPFH) and gathers, layer by layer, the largest of its neighbours' messages,

    x_i  <-  ReLU(norm(x_i + W ReLU(A x_i + max_j (B x_j + C g_ij)))),

where the pair features g_ij = (|d|, n_i . d, n_j . d, n_i . n_j, det(d, n_i, n_j)), d from p_i to p_j and n the
normals, say how two oriented points lie to each other, in any pose (after Drost et al., "Model Globally, Match
Locally", CVPR 2010, and Deng, Birdal and Ilic, "PPFNet", CVPR 2018). The first layer's neighbours are the nearest 16;
the next two take 16 of the nearest 48 and 128, so that a few layers see far. Distances are in spacings of the cloud:
neither its scale nor its density matters.

Here is the forward pass, in NumPy. :class:`idam.network.features.invariant.Invariant` is the same in torch, to train.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from idam.describe.fpfh import fpfh_from_neighbours
from idam.describe.neighbours import Array, Reach, nearest_neighbours, within_reach
from idam.describe.normals import normal_reach, normals_from_neighbours
from idam.describe.products import product

__all__ = ["FAR", "NEIGHBOURS", "PERCENT", "STRIDES", "Descriptor", "Surroundings", "pair_features", "surroundings"]

NORMALS = normal_reach(2.5, 30)
"""Whom a normal is taken from: those within 2.5 spacings."""
HISTOGRAMS = Reach(6.0, at_most=99)
"""Whom a histogram counts: those within 6 spacings."""
NEIGHBOURS = 16
"""Whose messages a point gathers in each layer."""
STRIDES = (1, 3, 8)
"""Each layer's neighbours: every so many-th of the nearest."""
FAR = 8.0
"""Spacings that count as a distance of one."""
PERCENT = 20.0
"""FPFH's percentages are divided by it: about unit size."""
LAYER_NORM_EPS = 1e-5
"""Added to the variance, as torch's LayerNorm does."""


class Surroundings(NamedTuple):
    """What the descriptor sees of a cloud of N points: all that does not depend on weights.

    Attributes:
        points: (N, 3) float32, in spacings.
        normals: (N, 3) float32.
        histograms: FPFH (N, 33) float32.
        near: rows of each layer's neighbours, (layers, K, N).
    """

    points: Array
    normals: Array
    histograms: Array
    near: Array


def surroundings(points: Array, spacing: float | None = None) -> Surroundings:
    """The surroundings of a cloud's points.

    Args:
        points: (N, 3), of any scale, N at least 2.
        spacing: distance of a point to its nearest neighbour; None for the median of this cloud.

    Raises:
        ValueError: a coordinate is not finite.
    """
    points = (points - points.mean(0, dtype=np.float64)).astype(np.float32)
    distance, near = nearest_neighbours(points, NEIGHBOURS * STRIDES[-1])
    if spacing is None:
        apart = np.sort(distance[:, 0][distance[:, 0] > 0])
        spacing = float(apart[(len(apart) - 1) // 2]) if len(apart) else 1.0
    points, distance = points / np.float32(spacing), distance / np.float32(spacing)
    normals = normals_from_neighbours(points, within_reach(distance, near, NORMALS))
    histograms = fpfh_from_neighbours(points, normals, within_reach(distance, near, HISTOGRAMS))
    last = near.shape[1] - 1
    layers = [near[:, np.minimum(np.arange(s - 1, NEIGHBOURS * s, s), last)].T for s in STRIDES]
    return Surroundings(points, normals, histograms, np.stack(layers))


def pair_features(points: Array, normals: Array, near: Array) -> Array:
    """How oriented points (N, 3) and their neighbours, rows (K, N), lie to each other: (5, K, N)."""
    (x, y, z), (p, q, r) = points.T, normals.T
    dx, dy, dz = x[near] - x, y[near] - y, z[near] - z
    p_, q_, r_ = p[near], q[near], r[near]
    distance = np.sqrt(dx * dx + dy * dy + dz * dz)
    inverse = 1 / np.maximum(distance, np.finfo(points.dtype).eps)
    features = np.empty((5, *near.shape), points.dtype)
    features[0] = distance / FAR
    features[1] = (dx * p + dy * q + dz * r) * inverse
    features[2] = (dx * p_ + dy * q_ + dz * r_) * inverse
    features[3] = p * p_ + q * q_ + r * r_
    features[4] = (dx * (q * r_ - r * q_) + dy * (r * p_ - p * r_) + dz * (p * q_ - q * p_)) * inverse
    return features


class Descriptor:
    """The features: vectors of one length, whose inner products say how alike the surroundings of two points are.

    Args:
        weights: of :class:`idam.network.features.invariant.Invariant`, by the names that torch gives them.

    Attributes:
        key: tells one descriptor's weights from another's.

    Raises:
        KeyError: a weight is missing.
    """

    def __init__(self, weights: Mapping[str, Array]) -> None:
        arrays = {name: np.asarray(value, np.float32) for name, value in weights.items()}
        layers = [f"layers.{n}." for n in range(len(STRIDES))]
        self._first, self._norm, self._last = (_Affine(arrays, name) for name in ("first", "norm", "last"))
        self._layers = [_Layer(arrays, name) for name in layers]
        self._length = arrays["length"]
        digest = hashlib.blake2b(digest_size=16)
        for name in sorted(arrays):
            digest.update(name.encode() + arrays[name].tobytes())
        self.key = digest.hexdigest()

    def describe(self, around: Surroundings) -> Array:
        """Features (N, 32) float32 of a cloud's points by their surroundings."""
        x = _relu(self._norm.normalised(self._first(around.histograms / np.float32(PERCENT))))
        for layer, near in zip(self._layers, around.near, strict=True):
            x = layer(x, near, pair_features(around.points, around.normals, near))
        x = self._last(x)
        norm = np.maximum(np.linalg.norm(x, axis=1, keepdims=True), np.float32(1e-12))
        features: Array = self._length * x / norm
        return features


class _Affine:
    """Weight and bias: of a linear map, transposed, or of a layer normalisation."""

    def __init__(self, weights: Mapping[str, Array], name: str) -> None:
        self.weight = np.ascontiguousarray(weights[f"{name}.weight"].T)
        self.bias = weights.get(f"{name}.bias", np.float32(0))

    def __call__(self, x: Array) -> Array:
        """The linear map."""
        mapped = product(x, self.weight)
        mapped += self.bias
        return mapped

    def normalised(self, x: Array) -> Array:
        """The layer normalisation of x (N, C), which it overwrites."""
        x -= x.mean(1, keepdims=True)
        x /= np.sqrt(np.square(x).mean(1, keepdims=True) + np.float32(LAYER_NORM_EPS))
        x *= self.weight
        x += self.bias
        return x


class _Layer:
    """What each point takes from its neighbours."""

    def __init__(self, weights: Mapping[str, Array], prefix: str) -> None:
        parts = ("own", "other", "pair", "update", "norm")
        self.own, self.other, self.pair, self.update, self.norm = (_Affine(weights, prefix + part) for part in parts)

    def __call__(self, x: Array, near: Array, pairs: Array) -> Array:
        """Features (N, C), rows of neighbours (K, N) and pair features (5, K, N) to features (N, C)."""
        gathered = self.largest_message(self.other(x), near, pairs)
        gathered += self.own(x)
        updated = self.update(_relu(gathered))
        updated += x
        return _relu(self.norm.normalised(updated))

    def largest_message(self, h: Array, near: Array, pairs: Array) -> Array:
        """max_j (h_j + C g_ij) over the neighbours j of each point i, with no (K, N, C) array: (N, C)."""
        largest = np.full_like(h, -np.inf)
        message, theirs = np.empty_like(h), np.empty_like(h)
        for k, row in enumerate(near):
            product(pairs[:, k].T, self.pair.weight, out=message)
            message += h.take(row, 0, out=theirs, mode="clip")  # a mode other than "raise" takes no copy
            np.maximum(largest, message, out=largest)
        return largest


def _relu(x: Array) -> Array:
    """max(x, 0), in place."""
    positive: Array = np.maximum(x, 0, out=x)
    return positive
