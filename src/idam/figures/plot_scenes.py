"""Drawing clouds: registrations, key points, correspondences. Imports Matplotlib.

Clouds are projected here rather than by Matplotlib's 3D axes, whose margins leave little room for the shapes: in
parallel, obliquely from above, equal in scale along all axes, and paler the farther away.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray
from torch import Tensor

from idam.figures.scenes import Kept, Matches, Overlay
from idam.figures.style import BLUE, GREEN, GREY, ORANGE, PAGE, VERMILLION

__all__ = ["draw_key_points", "draw_matches", "draw_overlays", "project"]

AZIMUTH, ELEVATION = math.radians(35), math.radians(20)
PALEST = 0.6
"""Share of white in the colour of the farthest points."""
DASHES = (0, (4, 2))
RATIO = 5 / 3
"""Width over height of a panel of matches."""
TURNED_BACK = "target (right or below) turned back by the truth: right matches are parallel"
LETTER = 0.062
"""Inches that a letter of a title takes, at most on average."""

Array = NDArray[np.float64]


def draw_overlays(overlays: Sequence[Overlay], up: int) -> Figure:
    """Registrations side by side, each before above after, six to a row; ``up`` is the axis that points up."""
    columns = min(len(overlays), 6)
    bands = math.ceil(len(overlays) / columns)
    side = min(PAGE / columns, 1.6)
    lines = max(overlay.name.count("\n") for overlay in overlays) + 1
    figure = Figure((max(columns * side, 2.0), (2 * side + 0.15 * lines) * bands + 0.2), layout="constrained")
    grid = _empty_grid(figure, 2 * bands, columns)
    for n, overlay in enumerate(overlays):
        band, column = divmod(n, columns)
        before, after = grid[2 * band], grid[2 * band + 1]
        _title(before[column], overlay.name, side)
        source, moved, target = (
            project(cloud @ overlay.upright.T, up) for cloud in (overlay.source, overlay.moved, overlay.target)
        )
        _draw_clouds(before[column], (source, BLUE), (target, ORANGE))
        _draw_clouds(after[column], (moved, BLUE), (target, ORANGE))
        _same_scale([before[column], after[column]])
        if column == 0:
            for row, text in ((before, "before"), (after, "after")):
                row[0].text(-0.05, 0.5, text, transform=row[0].transAxes, rotation=90, ha="right", va="center")
    _legend(figure, [_dot(BLUE, "source"), _dot(ORANGE, "target")])
    return figure


def draw_key_points(shapes: Sequence[Kept], up: int) -> Figure:
    """Clouds in grey with their key points in colour, four to a row; ``up`` is the axis that points up."""
    columns = min(len(shapes), 4)
    rows = math.ceil(len(shapes) / columns)
    side = PAGE / columns
    figure = Figure((PAGE, rows * (side + 0.05) + 0.2), layout="constrained")
    grid = _empty_grid(figure, rows, columns)
    for n, shape in enumerate(shapes):
        axes = grid[n // columns][n % columns]
        _title(axes, shape.name, side)
        _draw_clouds(axes, (project(shape.cloud, up), GREY))
        _draw_clouds(axes, (project(shape.key_points, up), BLUE), size=4.0, palest=0.3)
        _same_scale([axes])
    _legend(figure, [_dot(GREY, "point"), _dot(BLUE, "key point, kept by hard elimination")])
    return figure


def draw_matches(shapes: Sequence[Matches], up: int) -> Figure:
    """Source left or above, target right or below, matches between, two shapes to a row; ``up`` points up."""
    columns = min(len(shapes), 2)
    rows = math.ceil(len(shapes) / columns)
    side = PAGE / columns
    figure = Figure((PAGE, rows * (side / RATIO + 0.2) + 0.4), layout="constrained")
    grid = _empty_grid(figure, rows, columns)
    for n, shape in enumerate(shapes):
        axes = grid[n // columns][n % columns]
        _title(axes, shape.name, side)
        _draw_shape_matches(axes, shape, up)
        _same_scale([axes], RATIO)
    weighted = Line2D([], [], color=GREEN, label="match with weight")
    others = Line2D([], [], color=VERMILLION, linestyle=DASHES, label="match without")
    _legend(figure, [weighted, others], TURNED_BACK)
    return figure


def _draw_shape_matches(axes: Axes, shape: Matches, up: int) -> None:
    source, target = project(shape.source, up), project(shape.target, up)
    start, end = project(shape.start, up), project(shape.end, up)
    width, height, _ = np.ptp(np.concatenate([source, target]), axis=0)
    beside, below = width + 0.4 * height, height + 0.4 * width
    wide = max(width, RATIO * (height + below)) < max(width + beside, RATIO * height)  # then it is larger that way
    aside = np.array([0.0, -below, 0.0] if wide else [beside, 0.0, 0.0])
    _draw_clouds(axes, (source, GREY), (target + aside, GREY))
    weighted = shape.weighted.numpy()
    for those, colour, style in ((~weighted, VERMILLION, DASHES), (weighted, GREEN, "-")):
        x, y, _ = np.stack([start[those], end[those] + aside]).transpose(2, 0, 1)
        axes.plot(x, y, color=colour, linestyle=style, linewidth=0.5, alpha=0.8)


def project(points: Tensor, up: int) -> Array:
    """Points (N, 3) as seen obliquely from above: how far to the right, up, and towards the viewer."""
    sin_a, cos_a, sin_e, cos_e = math.sin(AZIMUTH), math.cos(AZIMUTH), math.sin(ELEVATION), math.cos(ELEVATION)
    axes = np.array(
        [[cos_a, 0.0, -sin_a], [-sin_a * sin_e, cos_e, -cos_a * sin_e], [sin_a * cos_e, sin_e, cos_a * cos_e]]
    )
    upright = np.roll(points.numpy().astype(np.float64), 1 - up, axis=1)
    return np.asarray(upright @ axes.T)


def _draw_clouds(axes: Axes, *clouds: tuple[Array, str], size: float = 0.7, palest: float = PALEST) -> None:
    """Projected clouds in their colours, nearer points over farther ones."""
    points = np.concatenate([cloud for cloud, _ in clouds])
    colours = np.concatenate([np.tile(to_rgb(colour), (len(cloud), 1)) for cloud, colour in clouds])
    depth = points[:, 2]
    pale = palest * (depth.max() - depth)[:, None] / max(float(np.ptp(depth)), 1e-9)
    shades = colours + pale * (1 - colours)
    order = depth.argsort()
    axes.scatter(points[order, 0], points[order, 1], s=size, c=shades[order], linewidths=0, clip_on=False)


def _empty_grid(figure: Figure, rows: int, columns: int) -> list[list[Axes]]:
    grid: list[list[Axes]] = figure.subplots(rows, columns, squeeze=False).tolist()
    for axes in figure.axes:
        axes.set_axis_off()
    return grid


def _same_scale(panels: Sequence[Axes], ratio: float = 1.0) -> None:
    """As many inches to the unit in all of these panels and along both axes; panels ``ratio`` times as wide as high."""
    limits = [(axes.get_xlim(), axes.get_ylim()) for axes in panels]
    height = max(max(x[1] - x[0], ratio * (y[1] - y[0])) for x, y in limits) / ratio
    for axes, (x, y) in zip(panels, limits, strict=True):
        axes.set_xlim((sum(x) - ratio * height) / 2, (sum(x) + ratio * height) / 2)
        axes.set_ylim((sum(y) - height) / 2, (sum(y) + height) / 2)
        axes.set_aspect("equal")


def _title(axes: Axes, name: str, width: float) -> None:
    """The name above a panel, its lines shortened to so many inches."""
    most = int(width / LETTER)
    axes.set_title("\n".join(x if len(x) <= most else x[: most - 1] + "…" for x in name.split("\n")), pad=2)


def _dot(colour: str, label: str) -> Line2D:
    return Line2D([], [], color=colour, linestyle="", marker="o", markersize=4, label=label)


def _legend(figure: Figure, entries: list[Line2D], title: str | None = None) -> None:
    figure.legend(handles=entries, loc="outside lower center", ncols=len(entries), title=title, title_fontsize=8)
