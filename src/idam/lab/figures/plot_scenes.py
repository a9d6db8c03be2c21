"""Drawing clouds: registrations, key points, correspondences. Imports Matplotlib."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from idam.lab.figures.scenes import Kept, Matches, Overlay
from idam.report.palette import BLUE, GREEN, GREY, SOURCE, TARGET, VERMILLION
from idam.report.panels import dot, draw_clouds, empty_grid, head, legend, project, same_scale
from idam.report.style import PAGE

__all__ = ["draw_key_points", "draw_matches", "draw_overlays"]

DASHES = (0, (4, 2))
RATIO = 5 / 3
"""Width over height of a panel of matches."""
TURNED_BACK = "target (right or below) turned back by the truth: right matches are parallel"


def draw_overlays(overlays: Sequence[Overlay], up: int) -> Figure:
    """Registrations side by side, each before above after, six to a row; ``up`` is the axis that points up."""
    columns = min(len(overlays), 6)
    bands = math.ceil(len(overlays) / columns)
    side = min(PAGE / columns, 1.6)
    lines = max(overlay.name.count("\n") for overlay in overlays) + 1
    figure = Figure((max(columns * side, 2.0), (2 * side + 0.15 * lines) * bands + 0.2), layout="constrained")
    grid = empty_grid(figure, 2 * bands, columns)
    for n, overlay in enumerate(overlays):
        band, column = divmod(n, columns)
        before, after = grid[2 * band], grid[2 * band + 1]
        head(before[column], overlay.name, side)
        source, moved, target = (
            project(cloud @ overlay.upright.T, up) for cloud in (overlay.source, overlay.moved, overlay.target)
        )
        draw_clouds(before[column], (source, SOURCE), (target, TARGET))
        draw_clouds(after[column], (moved, SOURCE), (target, TARGET))
        same_scale([before[column], after[column]])
        if column == 0:
            for row, text in ((before, "before"), (after, "after")):
                row[0].text(-0.05, 0.5, text, transform=row[0].transAxes, rotation=90, ha="right", va="center")
    legend(figure, [dot(SOURCE, "source"), dot(TARGET, "target")])
    return figure


def draw_key_points(shapes: Sequence[Kept], up: int) -> Figure:
    """Clouds in grey with their key points in colour, four to a row; ``up`` is the axis that points up."""
    figure, panels = _named_panels([shape.name for shape in shapes], 4, 1.0, between=0.05, below=0.2)
    for axes, shape in zip(panels, shapes, strict=True):
        draw_clouds(axes, (project(shape.cloud, up), GREY))
        draw_clouds(axes, (project(shape.key_points, up), BLUE), size=4.0, palest=0.3)
        same_scale([axes])
    legend(figure, [dot(GREY, "point"), dot(BLUE, "key point, kept by hard elimination")])
    return figure


def draw_matches(shapes: Sequence[Matches], up: int) -> Figure:
    """Source left or above, target right or below, matches between, two shapes to a row; ``up`` points up."""
    figure, panels = _named_panels([shape.name for shape in shapes], 2, RATIO, between=0.2, below=0.4)
    for axes, shape in zip(panels, shapes, strict=True):
        _draw_shape_matches(axes, shape, up)
        same_scale([axes], RATIO)
    weighted = Line2D([], [], color=GREEN, label="match with weight")
    others = Line2D([], [], color=VERMILLION, linestyle=DASHES, label="match without")
    legend(figure, [weighted, others], TURNED_BACK)
    return figure


def _named_panels(
    names: list[str], most: int, ratio: float, *, between: float, below: float
) -> tuple[Figure, list[Axes]]:
    """A figure as wide as the page with a panel for each name, ``most`` to a row, each ``ratio`` times as wide as high.

    ``between`` inches are left for each row's names, and ``below`` for the legend.
    """
    columns = min(len(names), most)
    rows = math.ceil(len(names) / columns)
    side = PAGE / columns
    figure = Figure((PAGE, rows * (side / ratio + between) + below), layout="constrained")
    panels = [axes for row in empty_grid(figure, rows, columns) for axes in row][: len(names)]
    for axes, name in zip(panels, names, strict=True):
        head(axes, name, side)
    return figure, panels


def _draw_shape_matches(axes: Axes, shape: Matches, up: int) -> None:
    source, target = project(shape.source, up), project(shape.target, up)
    start, end = project(shape.start, up), project(shape.end, up)
    width, height, _ = np.ptp(np.concatenate([source, target]), axis=0)
    beside, below = width + 0.4 * height, height + 0.4 * width
    wide = max(width, RATIO * (height + below)) < max(width + beside, RATIO * height)  # then it is larger that way
    aside = np.array([0.0, -below, 0.0] if wide else [beside, 0.0, 0.0])
    draw_clouds(axes, (source, GREY), (target + aside, GREY))
    weighted = shape.weighted.numpy()
    for those, colour, style in ((~weighted, VERMILLION, DASHES), (weighted, GREEN, "-")):
        x, y, _ = np.stack([start[those], end[those] + aside]).transpose(2, 0, 1)
        axes.plot(x, y, color=colour, linestyle=style, linewidth=0.5, alpha=0.8)
