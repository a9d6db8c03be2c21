"""Many scans put together as a page to look at: a self-contained HTML file that opens offline in any browser.

Python fills in the figures, draws the graph and packs the points; ``merge.html`` beside this file shows them, with
``viewer.js``, which it shares with the page of a pair.
"""

from __future__ import annotations

import colorsys
import math
from os import PathLike
from typing import Any

import numpy as np

from idam import rigid
from idam.io import PointCloud, write_text
from idam.many.result import Link, MergeResult
from idam.report.graph import draw_graph
from idam.report.markup import escape, fill, number, plain_json, template
from idam.report.pack import packed, thinned
from idam.report.record import Record
from idam.report.view import frame, guess_up
from idam.result import chance
from idam.rigid import Array

__all__ = ["write_merge_report"]

MOST_POINTS = 400_000
"""Points of all scans together that a page shows: 60 scans still turn smoothly without a graphics card."""
MOST_OF_ONE = 25_000
"""Points of one scan that a page shows at most."""
FAR_APART = 6.0
"""Radii of the model beyond which scans as given are too far apart to be drawn in one picture."""


def write_merge_report(path: str | PathLike[str], result: MergeResult, *, record: Record | None = None) -> None:
    """Write the page of a merge: all scans before and after, the graph of links, and which scans have no sure place.

    The page refers to nothing outside itself. The same result and date give the same bytes, but for the time it took.

    Raises:
        InputError: the file cannot be written.
    """
    record = record or Record()
    colors = palette(len(result.names))
    placed = [scan for scan in result.components[0] if result.poses[scan] is not None]
    used = [link for link in result.links if link.used]
    level, verdict = verdict_of(result)
    page = fill(
        template("merge.html"),
        made=escape(record.made),
        unit=escape(record.lengths),
        title=escape(f"{len(placed)} of {len(result.names)} scans placed"),
        level=level,
        verdict=escape(verdict),
        placed=f"{len(placed)} of {len(result.names)}",
        components=str(sum(result.poses[scans[0]] is not None for scans in result.components)),
        links=f"{len(used)} of {len(result.links)}",
        least=escape(least_confidence(result)),
        seconds=number(result.seconds, 3),
        scans="\n".join(scan_row(result, scan, colors[scan]) for scan in range(len(result.names))),
        table="\n".join(link_row(result, link) for link in sorted(result.links, key=lambda link: -link.confidence)),
        graph=draw_graph(result, colors),
        scene=plain_json(scene(result, colors)),
    )
    write_text(path, page)


def verdict_of(result: MergeResult) -> tuple[str, str]:
    """What the result comes to: the style, and a sentence."""
    placed = sum(result.poses[scan] is not None for scan in result.components[0])
    if result.complete:
        return "high", "Every scan has its place in one frame, checked by more than one link."
    if placed == len(result.names):
        return "fair", "Every scan has its place in one frame, but some places hang on one link: see the scans below."
    if placed:
        return "fair", f"{len(result.names) - placed} scans have no sure place in the largest component: see below."
    return "low", "No two scans could be put together with trust."


def least_confidence(result: MergeResult) -> str:
    """The least confidence of a scan of the largest component."""
    scans = result.components[0]
    least = min((result.confidence[scan] for scan in scans if result.poses[scan] is not None), default=0.0)
    return chance(least)


# The tables


def scan_row(result: MergeResult, scan: int, color: str) -> str:
    """A scan: a switch in its colour, its component, its confidence, and what is doubtful."""
    pose = result.poses[scan]
    shown = result.clouds[scan] is not None
    switch = f'<input type="checkbox" class="show" data-scan="{scan}" {"checked" if shown else "disabled"}>'
    name = f'<label>{switch}<span class="swatch" style="--swatch: {color}"></span>{escape(result.names[scan])}</label>'
    component = "" if pose is None else str(result.component_of(scan))
    sure = "not placed" if pose is None else escape(chance(result.confidence[scan]))
    style = ' class="doubtful"' if result.reason[scan] else ""
    return f"<tr{style}><td>{name}</td><td>{component}</td><td>{sure}</td><td>{escape(result.reason[scan])}</td></tr>"


def link_row(result: MergeResult, link: Link) -> str:
    """A link: its ends, whether it is used, and its figures, with what to sort them by."""
    degrees, shift = link.loop_error or (math.nan, math.nan)
    loose = looseness(result, link)
    cells = [
        (escape(result.names[link.source]), ""),
        (escape(result.names[link.target]), ""),
        ("used" if link.used else "rejected", ""),
        (escape(chance(link.confidence)), str(link.confidence)),
        (f"{100 * link.overlap:.0f} %", str(link.overlap)),
        (number(link.residual, 3), str(link.residual)),
        (f"{number(degrees, 2)}°, {number(shift, 2)}" if link.loop_error else "no loop", sortable(degrees)),
        (f"{number(math.degrees(loose[0]), 2)}°, {number(loose[1], 2)}", sortable(loose[0])),
        (escape(link.reason), ""),
    ]
    row = "".join(f'<td data-value="{value}">{text}</td>' if value else f"<td>{text}</td>" for text, value in cells)
    return f'<tr class="{"used" if link.used else "rejected"}">{row}</tr>'


def looseness(result: MergeResult, link: Link) -> tuple[float, float]:
    """One standard deviation of a link in the directions that hold it least, about the source's centre.

    Returns:
        Of rotation in radians, and of translation in input units; infinite where nothing holds it.
    """
    cloud = result.clouds[link.source]
    if cloud is None or not link.information.any():
        return math.inf, math.inf
    there = rigid.adjoint(rigid.transform(np.eye(3), cloud.points.mean(0)))
    values, vectors = np.linalg.eigh(there.T @ link.information @ there)
    if values[0] <= 0:
        return math.inf, math.inf
    covariance = vectors / values @ vectors.T
    rotation, translation = (float(np.linalg.eigvalsh(covariance[i : i + 3, i : i + 3])[-1]) for i in (0, 3))
    return math.sqrt(max(rotation, 0.0)), math.sqrt(max(translation, 0.0))


def sortable(value: float) -> str:
    """A number to sort by; what is missing comes last."""
    return str(value) if math.isfinite(value) else "1e99"


# The scene


def scene(result: MergeResult, colors: list[str]) -> dict[str, Any]:
    """What the page's script draws: each scan about its own centre, with its poses before and after.

    ``before`` is where a scan is drawn, ``given`` where it lay as it was given: they differ only where scans too far
    apart are drawn side by side.
    """
    each = min(MOST_OF_ONE, MOST_POINTS // max(1, len(result.names)))
    clouds = [None if cloud is None else thinned(cloud, each) for cloud in result.clouds]
    centres = [None if cloud is None else (cloud.points.min(0) + cloud.points.max(0)) / 2 for cloud in clouds]
    after = [placed(result, scan, centres[scan]) for scan in range(len(clouds))]
    views = []
    for component, scans in enumerate(result.components):
        if result.poses[scans[0]] is not None:
            inside = [
                rigid.apply(pose, local(clouds[scan], centres[scan]))
                for scan in scans
                if (pose := after[scan]) is not None
            ]
            views.append({"component": component, **frame(np.concatenate(inside))})
    before, given, apart = as_given(clouds, centres, max([view["radius"] for view in views], default=0.0))
    whole = [
        rigid.apply(pose, local(cloud, centre))
        for cloud, centre, pose in zip(clouds, centres, before, strict=True)
        if cloud is not None
    ]
    return {
        "scans": [
            None
            if cloud is None
            else {
                "name": result.names[scan].encode("utf-8", "replace").decode("utf-8"),
                "cloud": packed(cloud),
                "color": color,
                "component": result.component_of(scan) if result.poses[scan] is not None else -1,
                "before": rows(before[scan]),
                "given": rows(given[scan]),
                "after": rows(after[scan]),
            }
            for scan, (cloud, color) in enumerate(zip(clouds, colors, strict=True))
        ],
        "views": views,
        "before": frame(np.concatenate(whole)),
        "apart": apart,
        "up": guess_up(np.concatenate(whole) if not views else np.concatenate(inside)),
    }


def local(cloud: PointCloud | None, centre: Array | None) -> Array:
    """Points about a scan's centre."""
    assert cloud is not None
    assert centre is not None
    return np.asarray(cloud.points - centre)


def placed(result: MergeResult, scan: int, centre: Array | None) -> Array | None:
    """The pose (4, 4) of a scan's points about its centre, in its component's frame about the first scan's centroid."""
    pose = result.poses[scan]
    if pose is None or centre is None:
        return None
    first = result.clouds[result.components[result.component_of(scan)][0]]
    assert first is not None
    moved = rigid.apply(pose, centre[None])[0] - first.points.mean(0)
    return rigid.transform(pose[:3, :3], moved)


def as_given(
    clouds: list[PointCloud | None], centres: list[Array | None], radius: float
) -> tuple[list[Array], list[Array], bool]:
    """Where the scans' points about their centres are drawn and where they lie, as given.

    They are drawn side by side where they lie too far apart to be seen.
    """
    some = np.stack([centre for centre in centres if centre is not None])
    middle = some.mean(0)
    largest = max(
        float(np.abs(local(cloud, centre)).max())
        for cloud, centre in zip(clouds, centres, strict=True)
        if cloud is not None
    )
    apart = float(np.linalg.norm(some - middle, axis=1).max()) > FAR_APART * max(radius, largest)
    side = math.ceil(math.sqrt(len(clouds)))
    given = [np.zeros(3) if centre is None else centre - middle for centre in centres]
    grid = [
        np.array([scan % side - (side - 1) / 2, (side - 1) / 2 - scan // side, 0.0]) * 2 * largest
        for scan in range(len(clouds))
    ]
    drawn, lying = ([rigid.transform(np.eye(3), place) for place in some] for some in (grid if apart else given, given))
    return drawn, lying, apart


def rows(pose: Array | None) -> list[list[float]] | None:
    """The upper three rows of a pose."""
    upper: list[list[float]] | None = None if pose is None else pose[:3].tolist()
    return upper


def palette(count: int) -> list[str]:
    """So many colours that are far apart: hues by the golden ratio, in three shades."""
    shades = [(0.72, 0.86), (0.55, 0.62), (0.85, 0.98)]
    colors = []
    for i in range(count):
        hue = (0.58 + i * (math.sqrt(5) - 1) / 2) % 1
        rgb = colorsys.hsv_to_rgb(hue, *shades[i % 3])
        colors.append("#" + "".join(f"{round(255 * value):02x}" for value in rgb))
    return colors
