"""What a viewpoint sees of a surface that is given by dense points: the nearest in every cell of its image."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["seen_from_afar", "seen_from_within"]

Points = NDArray[np.float64]
Mask = NDArray[np.bool_]

ROWS = 160
"""Cells from pole to pole in the image of a viewpoint within."""
BEHIND = 4.0
"""Cells that a point may lie behind the nearest, seen from afar, and still be seen: surfaces slant."""
BEHIND_WITHIN = 1.06
"""Times as far as the nearest that a point may lie, seen from within, and still be seen."""


def seen_from_afar(points: Points, rotation: Points, cells: int) -> Mask:
    """Which points (N, 3) are seen along the z axis after a rotation (3, 3), in an image ``cells`` wide."""
    turned = points @ rotation.T
    low = turned[:, :2].min(0)
    width = float((turned[:, :2].max(0) - low).max()) or 1.0
    column, row = ((turned[:, :2] - low) / width * cells).astype(np.int64).clip(0, cells - 1).T
    image = np.full((cells + 2, cells + 2), np.inf)
    np.minimum.at(image, (column + 1, row + 1), turned[:, 2])
    # points are no surface: each cell also hides what lies behind its neighbours
    nearest = np.minimum.reduce([image[i : i + cells, j : j + cells] for i in range(3) for j in range(3)])
    seen: Mask = turned[:, 2] < nearest[column, row] + BEHIND * width / cells
    return seen


def seen_from_within(points: Points, place: Points) -> Mask:
    """Which points (N, 3) are seen from a place (3,) among them, all around."""
    offset = points - place
    distance = np.linalg.norm(offset, axis=1).clip(1e-9)
    around = (np.arctan2(offset[:, 1], offset[:, 0]) / np.pi + 1) * ROWS
    upward = (np.arcsin((offset[:, 2] / distance).clip(-1, 1)) / np.pi + 0.5) * ROWS
    cell = around.astype(np.int64).clip(0, 2 * ROWS - 1) * ROWS + upward.astype(np.int64).clip(0, ROWS - 1)
    nearest = np.full(2 * ROWS * ROWS, np.inf)
    np.minimum.at(nearest, cell, distance)
    seen: Mask = distance < nearest[cell] * BEHIND_WITHIN
    return seen
