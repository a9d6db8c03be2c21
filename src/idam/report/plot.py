"""One registration as a picture: the pair before, the feature matches, the pair after. Imports Matplotlib."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from numpy.typing import NDArray

from idam.io import PointCloud
from idam.io.files import silenced
from idam.report.palette import SOURCE, TARGET
from idam.report.panels import Array, dot, draw_clouds, empty_grid, legend, project, same_scale
from idam.report.style import look, save_as
from idam.report.view import approach, frame, guess_up, sample
from idam.result import Matches, RegistrationResult, chance

__all__ = ["draw_result", "write_plot"]

SIDE = 3.2
"""Inches of each of the three panels."""
DPI = 200
POINTS = 20_000
"""Points of each cloud that are drawn at most."""
MATCHES = 100
"""Matches that are drawn at most: the strongest."""
NAME = 40
"""Letters of a name in the title at most."""
PALEST = 0.45
"""Share of white in the colour of the farthest points."""


def write_plot(
    path: Path,
    source: PointCloud,
    target: PointCloud,
    result: RegistrationResult,
    *,
    source_name: str,
    target_name: str,
) -> None:
    """Draw one registration and write it as PNG or SVG, by the extension, atomically; the same bytes every time.

    Args:
        path: the file to write.
        source: the source as it was given to ``register``, not moved.
        target: the target.
        result: what ``register`` returned for them.
        source_name: what the picture calls the source, such as its file name.
        target_name: what the picture calls the target.

    Raises:
        InputError: the file cannot be written.
    """
    # silenced: its font may lack letters of a name
    with look(), matplotlib.rc_context({"savefig.dpi": DPI}), silenced("matplotlib"):
        figure = draw_result(source.points, target.points, result, heading(result, source_name, target_name))
        save_as(figure, path)


def draw_result(source: Array, target: Array, result: RegistrationResult, title: str) -> Figure:
    """The clouds before, the strongest matches between them drawn apart, and the clouds after, side by side."""
    source, target = (_core(points[sample(points, POINTS)]) for points in (source, target))
    middle, origin = ((cloud.min(axis=0) + cloud.max(axis=0)) / 2 for cloud in (source, target))
    offset, gap = approach([source - middle, target - origin], middle - origin)
    up = guess_up(target)
    before, after, still = (
        _seen(points, up) for points in (source - middle + offset, result.apply(source) - origin, target - origin)
    )
    start, end = (_seen(points - origin, up) for points in (result.apply(result.matches.source), result.matches.target))

    figure = Figure((3 * SIDE, SIDE + 0.9), layout="constrained")
    panels = empty_grid(figure, 1, 3)[0]
    _draw_pair(panels[0], before, still)
    aside = _aside(after, still)
    _draw_pair(panels[1], after + aside, still, palest=0.75)  # behind matches the clouds stand back
    _draw_matches(panels[1], start + aside, end, result.matches)
    _draw_pair(panels[2], after, still)
    for axes, caption in zip(panels, _captions(result.matches, gap), strict=True):
        axes.set_title(caption)
        same_scale([axes])
    figure.suptitle(title, fontsize=9, parse_math=False)
    legend(figure, [dot(SOURCE, "source"), dot(TARGET, "target")])
    return figure


def heading(result: RegistrationResult, source_name: str, target_name: str) -> str:
    """The title: which clouds, how sure, and why."""
    names = [name if len(name) <= NAME else f"{name[: NAME - 1]}…" for name in (source_name, target_name)]
    confidence = f"confidence {chance(result.confidence)}"
    title = f"{names[0]} onto {names[1]}: {confidence}" + (f"\n{result.reason}" if result.reason else "")
    return title.encode("utf-8", "replace").decode()  # a file's name may not be Unicode


def _captions(matches: Matches, gap: float) -> tuple[str, str, str]:
    kept = int(np.count_nonzero(matches.weight))
    which = f"the {MATCHES} strongest of {kept} matches" if kept > MATCHES else f"{kept} matches"
    before = f"before, drawn closer together: {gap:,.4g} apart" if gap else "before"
    return before, f"{which}, source aside: right ones are parallel", "after"


def _core(points: Array) -> Array:
    """Without the few points far from all others, which would make the rest small."""
    view = frame(points)
    near: NDArray[np.bool_] = np.linalg.norm(points - view["centre"], axis=1) <= view["radius"]
    return points[near]


def _seen(points: Array, up: str) -> Array:
    """Points (N, 3) projected, the axis called ``up`` upwards."""
    if up == "-y":
        return project(points * [1.0, -1.0, -1.0], 1)
    return project(points, "xyz".index(up[1]))


def _aside(source: Array, target: Array) -> Array:
    """How to shift the projected source off the target: to the left or above, whichever leaves more room."""
    low, high = target.min(axis=0), target.max(axis=0)
    left = low[0] - source[:, 0].max() - 0.3 * (high[1] - low[1])
    above = high[1] - source[:, 1].min() + 0.3 * (high[0] - low[0])
    wide, tall = np.ptp(np.concatenate([source, target])[:, :2], axis=0)
    return np.array([left, 0.0, 0.0] if wide < tall else [0.0, above, 0.0])


def _draw_pair(axes: Axes, source: Array, target: Array, palest: float = PALEST) -> None:
    """Both clouds in their colours; pixels even in an SVG, where each point would be an element."""
    size = float(np.clip(12_000 / (len(source) + len(target)), 0.3, 4.0))
    draw_clouds(axes, (source, SOURCE), (target, TARGET), size=size, palest=palest).set_rasterized(True)


def _draw_matches(axes: Axes, start: Array, end: Array, matches: Matches) -> None:
    """The strongest matches as lines, the darker the heavier, with the scale of their colours."""
    order = np.argsort(matches.weight, kind="stable")[-MATCHES:]  # the strongest on top
    order = order[matches.weight[order] > 0]
    if not len(order):
        return
    ramp = ListedColormap(matplotlib.colormaps["viridis_r"](np.linspace(0.1, 1.0, 256)))  # its yellow is too pale
    lines = LineCollection(list(np.stack([start[order, :2], end[order, :2]], axis=1)), linewidths=0.8, cmap=ramp)
    lines.set_array(matches.weight[order])
    lines.set_clim(0.0, float(matches.weight.max()))
    axes.add_collection(lines)
    scale = axes.inset_axes((0.3, 0.0, 0.4, 0.025))
    bar = axes.figure.colorbar(lines, cax=scale, orientation="horizontal", ticks=[0.0, float(matches.weight.max())])
    bar.ax.set_xticklabels(["weight 0", f"{matches.weight.max():.2g}"])
