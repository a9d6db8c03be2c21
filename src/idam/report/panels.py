"""Panels that show clouds: how these are projected, scaled and labelled. Imports Matplotlib.

Clouds are projected here rather than by Matplotlib's 3D axes, whose margins leave little room for the shapes: in
parallel, obliquely from above, equal in scale along all axes, and paler the farther away.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import ArrayLike, NDArray

__all__ = ["Array", "dot", "draw_clouds", "empty_grid", "head", "legend", "project", "same_scale"]

AZIMUTH, ELEVATION = math.radians(35), math.radians(20)
PALEST = 0.6
"""Share of white in the colour of the farthest points."""
LETTER = 0.062
"""Inches that a letter of a title takes, at most on average."""

Array = NDArray[np.float64]


def project(points: ArrayLike, up: int) -> Array:
    """Points (N, 3) as seen obliquely from above: how far to the right, up, and towards the viewer."""
    sin_a, cos_a, sin_e, cos_e = math.sin(AZIMUTH), math.cos(AZIMUTH), math.sin(ELEVATION), math.cos(ELEVATION)
    axes = np.array(
        [[cos_a, 0.0, -sin_a], [-sin_a * sin_e, cos_e, -cos_a * sin_e], [sin_a * cos_e, sin_e, cos_a * cos_e]]
    )
    upright = np.roll(np.asarray(points, np.float64), 1 - up, axis=1)
    return np.asarray(upright @ axes.T)


def draw_clouds(axes: Axes, *clouds: tuple[Array, str], size: float = 0.7, palest: float = PALEST) -> PathCollection:
    """Projected clouds in their colours, nearer points over farther ones."""
    points = np.concatenate([cloud for cloud, _ in clouds])
    colours = np.concatenate([np.tile(to_rgb(colour), (len(cloud), 1)) for cloud, colour in clouds])
    depth = points[:, 2]
    pale = palest * (depth.max() - depth)[:, None] / max(float(np.ptp(depth)), 1e-9)
    shades = colours + pale * (1 - colours)
    order = depth.argsort()
    x, y = points[order, :2].T
    return axes.scatter(x, y, s=size, c=shades[order], linewidths=0, clip_on=False)


def empty_grid(figure: Figure, rows: int, columns: int) -> list[list[Axes]]:
    """Rows of panels without axes."""
    grid: list[list[Axes]] = figure.subplots(rows, columns, squeeze=False).tolist()
    for axes in figure.axes:
        axes.set_axis_off()
    return grid


def same_scale(panels: Sequence[Axes], ratio: float = 1.0) -> None:
    """As many inches to the unit in all of these panels and along both axes; panels ``ratio`` times as wide as high."""
    limits = [(axes.get_xlim(), axes.get_ylim()) for axes in panels]
    height = max(max(x[1] - x[0], ratio * (y[1] - y[0])) for x, y in limits) / ratio
    for axes, (x, y) in zip(panels, limits, strict=True):
        axes.set_xlim((sum(x) - ratio * height) / 2, (sum(x) + ratio * height) / 2)
        axes.set_ylim((sum(y) - height) / 2, (sum(y) + height) / 2)
        axes.set_aspect("equal")


def head(axes: Axes, name: str, width: float) -> None:
    """The name above a panel, its lines shortened to so many inches."""
    most = int(width / LETTER)
    axes.set_title("\n".join(x if len(x) <= most else x[: most - 1] + "…" for x in name.split("\n")), pad=2)


def dot(colour: str, label: str) -> Line2D:
    """An entry of a legend: points of that colour."""
    return Line2D([], [], color=colour, linestyle="", marker="o", markersize=4, label=label)


def legend(figure: Figure, entries: list[Line2D], title: str | None = None) -> None:
    """What the colours mean, in a row below all panels."""
    figure.legend(handles=entries, loc="outside lower center", ncols=len(entries), title=title, title_fontsize=8)
