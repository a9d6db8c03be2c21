"""Whether one cloud is larger than the other: the scale that a rigid transform leaves over."""

from __future__ import annotations

import math

import numpy as np

from idam import rigid
from idam.align.information import inflation
from idam.align.patches import Pairs, Patches
from idam.clouds.surfaces import TOUCHING, Surfaces
from idam.rigid import Array

__all__ = ["residual_scale"]

FEWEST = 100
"""Pairs of points below which nothing can be told of a scale."""
HINT = 2.5
"""Standard errors of the scale after one step from which on it is fitted."""
CERTAIN = 8.0
"""Standard errors from which on the fitted scale counts. Of 41 pairs of real scans, all of
one scale, none is told to have another; of the same 41 with one cloud 2 % larger 37, 10 % larger 37."""
NOISE = 0.5
"""Share of the residuals' standard deviation that counts as an error of the scale, too: noise bends normals."""
LEAST = 0.01
"""Difference from 1 below which it does not count."""
SAMPLE = 2000
"""Points that give a hint of a scale far off."""
REACHES = (*np.geomspace(4.0, TOUCHING, 6), *[TOUCHING] * 24)
"""Spacings within which points pull on each other, step by step: of a scale 10 % off, few lie near to begin with."""
STILL = 1e-4
"""Length of a step from which on it is done."""


def residual_scale(surfaces: Surfaces, transformation: Array, pairs: Pairs) -> float:
    """How many times as large as the source the target is: 1 unless it is significantly more or less.

    A step of Gauss and Newton, with the scale as the seventh unknown, costs next to nothing. Only where one gives a
    hint, near or far, is a similarity fitted, along both normals.

    Args:
        surfaces: in working coordinates.
        transformation: (4, 4), the answer.
        pairs: that it was fixed by.
    """
    if not _hint(pairs) and not _hint(_pairs(surfaces, transformation, 1.0, REACHES[0], SAMPLE)):
        return 1.0
    scale = 1.0
    for reach in REACHES:
        pairs = _pairs(surfaces, transformation, scale, reach)
        step, error = _step(pairs)
        if not math.isfinite(error):
            return 1.0
        # the step scales about the origin of the source's working coordinates, as the pairs are in the scaled source
        grown = math.exp(step[6])
        transformation, scale = transformation @ rigid.exp(step[:6]), scale * grown
        if reach == TOUCHING and np.abs(step).max() < STILL:
            break
    error = math.hypot(error, NOISE * pairs.scale)
    return scale if abs(scale - 1) > max(LEAST, CERTAIN * error) else 1.0


def _hint(pairs: Pairs) -> bool:
    """Whether one step speaks for another scale."""
    step, error = _step(pairs)
    return bool(abs(step[6]) > HINT * error)


def _step(pairs: Pairs) -> tuple[Array, float]:
    """A step of Gauss and Newton by rotation, translation and logarithm of the scale, (7,), and the last's error."""
    if len(pairs.points) < FEWEST:
        return np.zeros(7), math.inf
    growth = (pairs.points * pairs.normals).sum(1)
    gradient = np.concatenate([pairs.gradients(pairs.normals), growth[:, None]], 1)
    weighted = pairs.weights[:, None] * gradient
    fixed = weighted.T @ gradient + 1e-9 * len(gradient) * np.eye(7)
    step = np.linalg.solve(fixed, -weighted.T @ pairs.residuals)
    rest = pairs.residuals + gradient @ step
    variance = inflation(pairs, gradient, rest, fixed) * np.linalg.inv(fixed)[6, 6]
    return step, math.sqrt(variance)


def _pairs(surfaces: Surfaces, transformation: Array, scale: float, reach: float, most: int = 10**9) -> Pairs:
    """Points of the source, so many times as large, with the target's nearest within so many spacings."""
    source, target = surfaces.source, surfaces.target
    every = slice(None, None, math.ceil(len(source.points) / most))
    points, normals = scale * source.points[every], source.normals[every]
    distance, row = target.nearest(rigid.apply(transformation, points))
    on = np.flatnonzero(distance <= reach * surfaces.spacing)
    mine, other = Patches(points[on], normals[on]), Patches(target.points[row[on]], target.normals[row[on]])
    return Pairs.alike(mine, other, transformation)
