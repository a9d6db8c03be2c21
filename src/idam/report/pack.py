"""Clouds as text for a page: a bounded number of points, as integers about their centre, compressed."""

from __future__ import annotations

import base64
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from idam.io import PointCloud
from idam.report.view import sample

__all__ = ["base64_of", "packed", "thinned"]

STEPS = 65535
"""Coordinates are 16-bit integers: steps along the longest side of a cloud's bounding box."""
FADED = (1, 99)
"""Percentiles of the intensity that are shown black and white."""


def thinned(cloud: PointCloud, count: int) -> PointCloud:
    """At most ``count`` finite points, always the same ones, with their own colours where they have any.

    An intensity counts as a grey.
    """
    rows = sample(cloud.points, count)
    colors = cloud.colors if cloud.colors is not None else _greys(cloud.attributes.get("intensity"))
    return PointCloud(cloud.points[rows], None if colors is None else colors[rows])


def packed(cloud: PointCloud) -> dict[str, Any]:
    """Points as integers about their centre: coordinate = centre + step (integer - 32767.5).

    Neighbours follow each other (in Morton's order), and differences are stored rather than values, all low bytes
    before all high ones: that makes a third less text of the same points.
    """
    low, high = cloud.points.min(axis=0), cloud.points.max(axis=0)
    centre = (low + high) / 2
    step = float((high - low).max()) / STEPS or 1.0
    quantised = np.rint((cloud.points - centre) / step + STEPS / 2).clip(0, STEPS).astype(np.uint16)
    order = np.argsort(_morton(quantised), kind="stable")
    return {
        "points": _compressed(quantised[order]),
        "colours": "" if cloud.colors is None else _compressed(cloud.colors[order]),
        "centre": centre.tolist(),
        "step": step,
    }


def base64_of(values: NDArray[Any], dtype: str) -> str:
    """Numbers as they are in memory."""
    return base64.b64encode(np.ascontiguousarray(values, dtype).tobytes()).decode("ascii")


def _compressed(values: NDArray[Any]) -> str:
    """Unsigned integers (N, 3): planes of the bytes of their differences, low ones first, deflated."""
    differences = np.diff(values, axis=0, prepend=np.zeros((1, 3), values.dtype))
    data = np.ascontiguousarray(differences.T.astype(values.dtype.newbyteorder("<")))
    planes = data.view(np.uint8).reshape(3, len(values), values.itemsize).transpose(2, 0, 1)
    return base64.b64encode(zlib.compress(planes.tobytes(), 9)).decode("ascii")


def _morton(values: NDArray[np.uint16]) -> NDArray[np.uint64]:
    """The bits of three numbers (N, 3) in turn: sorted by this, points that are near follow each other."""
    spread = values.astype(np.uint64)
    for shift, mask in ((16, 0x0000FF0000FF), (8, 0x00F00F00F00F), (4, 0x0C30C30C30C3), (2, 0x249249249249)):
        spread = (spread | (spread << np.uint64(shift))) & np.uint64(mask)
    code: NDArray[np.uint64] = spread[:, 0] | (spread[:, 1] << np.uint64(1)) | (spread[:, 2] << np.uint64(2))
    return code


def _greys(intensity: NDArray[Any] | None) -> NDArray[np.uint8] | None:
    """Intensities (N,) as greys (N, 3); None where there are none, or all are alike."""
    if intensity is None or not np.isfinite(intensity).any():
        return None
    values = np.nan_to_num(intensity.astype(np.float64), posinf=0.0, neginf=0.0)
    low, high = np.percentile(values, FADED)
    if high <= low:
        return None
    return np.repeat(np.rint(255 * ((values - low) / (high - low)).clip(0, 1)).astype(np.uint8)[:, None], 3, axis=1)
