"""A pair of clouds as the page's script draws it."""

from __future__ import annotations

from typing import Any

import numpy as np

from idam.io import PointCloud
from idam.report.markup import number
from idam.report.pack import base64_of, packed
from idam.report.view import approach, frame, guess_up
from idam.result import Matches
from idam.rigid import Array

__all__ = ["pair_scene"]


def pair_scene(source: PointCloud, target: PointCloud, answers: list[Array], matches: Matches) -> dict[str, Any]:
    """Gather what the page's script draws, in coordinates around the target's centre.

    A cloud's own coordinates are relative to its centre, so that float32 is enough for what was in metres of a national
    grid. The source's poses take its coordinates to the target's: ``pose`` to where it is drawn, ``place`` to where it
    is, which differs only where clouds far apart are drawn closer together.
    """
    clouds = [packed(source), packed(target)]
    centres = [np.array(cloud["centre"]) for cloud in clouds]
    local = [cloud.points - centre for cloud, centre in zip((source, target), centres, strict=True)]
    apart = centres[0] - centres[1]
    offset, gap = approach(local, apart)
    return {
        "source": clouds[0],
        "target": clouds[1],
        "matches": _matches(matches, centres),
        "before": {
            "pose": _rows(np.eye(3), offset),
            "place": _rows(np.eye(3), apart),
            "gap": number(gap) if gap else "",
            **frame(local[0] + offset, local[1]),
        },
        "answers": [_after(answer, local, centres) for answer in answers],
        "up": guess_up(target.points),
    }


def _after(transformation: Array, local: list[Array], centres: list[Array]) -> dict[str, Any]:
    """Where a transform (4, 4) puts the source, and how to look at it."""
    rotation = transformation[:3, :3]
    moved = rotation @ centres[0] + transformation[:3, 3] - centres[1]
    pose = _rows(rotation, moved)
    return {"pose": pose, "place": pose, **frame(local[0] @ rotation.T + moved, local[1])}


def _matches(matches: Matches, centres: list[Array]) -> dict[str, Any]:
    """Sort matches from weak to strong, so that the strong are drawn last; each end relative to its cloud's centre."""
    order = np.argsort(matches.weight, kind="stable")
    ends = [(matches.source - centres[0])[order], (matches.target - centres[1])[order]]
    return {
        "ends": base64_of(np.concatenate(ends, axis=1), "<f4"),
        "weights": base64_of(matches.weight[order], "<f4"),
        "strongest": number(float(matches.weight.max(initial=0)), 2),
    }


def _rows(rotation: Array, translation: Array) -> list[list[float]]:
    """The upper three rows of a 4x4."""
    rows: list[list[float]] = np.column_stack([rotation, translation]).tolist()
    return rows
