"""Whether one cloud is larger than the other: the scale that a rigid transform leaves over."""

from __future__ import annotations

import numpy as np

from idam import rigid
from idam.align.information import inflation
from idam.align.patches import Pairs
from idam.clouds.surfaces import Surface, Surfaces
from idam.rigid import Array

__all__ = ["scale_residual"]

ITERATIONS = 30
"""At most; a scale that is 10 % off takes ten to thirty, as the surfaces come to touch only bit by bit."""
STILL = 1e-4
"""Length of a step from which on it is done."""
FEWEST = 100
"""Pairs of points below which nothing can be told of a scale."""


def scale_residual(surfaces: Surfaces, transformation: Array) -> tuple[float, float]:
    """How many times as large as the source the target is, and the standard error of that.

    A similarity is fitted from the transform on: point to point along both normals, with the scale about the centre of
    what overlaps as the seventh unknown.

    Args:
        surfaces: in working coordinates.
        transformation: (4, 4), nearly right.

    Returns:
        The scale, and its standard error; 1 and infinity where too little lies on each other to tell.
    """
    scale = 1.0
    for _ in range(ITERATIONS):
        pairs = Pairs.of_points(_scaled(surfaces, scale), transformation)
        if len(pairs.points) < FEWEST:
            return 1.0, float("inf")
        centre = pairs.points.mean(0)
        growth = ((pairs.points - centre) * pairs.normals).sum(1)
        gradient = np.concatenate([pairs.gradients(pairs.normals), growth[:, None]], 1)
        fixed = gradient.T @ (pairs.weights[:, None] * gradient) + 1e-9 * len(gradient) * np.eye(7)
        step = np.linalg.solve(fixed, -gradient.T @ (pairs.weights * pairs.residuals))
        # scaled about the origin, so that the centre has to be brought back
        grown = float(np.exp(step[6]))
        back = rigid.transform(np.eye(3), (1 - grown) * centre)
        transformation, scale = transformation @ rigid.exp(step[:6]) @ back, scale * grown
        if np.abs(step).max() < STILL:
            break
    fixed *= pairs.slope
    variance = inflation(pairs, gradient, fixed) * np.linalg.inv(fixed)[6, 6]
    return scale, float(scale * np.sqrt(variance))


def _scaled(surfaces: Surfaces, scale: float) -> Surfaces:
    """With the source so many times as large: points and normals alone."""
    return Surfaces(_Grown(surfaces.source, scale), surfaces.target, surfaces.spacing)


class _Grown(Surface):
    """A surface so many times as large, of which only points and normals are asked."""

    def __init__(self, surface: Surface, scale: float) -> None:
        super().__init__(surface.cloud, surface.tree)
        self.__dict__.update(points=surface.points * scale, normals=surface.normals)
