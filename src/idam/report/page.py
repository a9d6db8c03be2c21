"""One registration as a page to look at: a self-contained HTML file that opens offline in any browser.

Python fills in the figures and packs the points; ``page.html`` beside this file draws them.
"""

from __future__ import annotations

import base64
import html
import json
import math
import re
from dataclasses import asdict
from importlib import resources
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from idam import rigid
from idam.clouds.surfaces import nearest_within, spacing_of
from idam.io import PointCloud, format_transform, write_text
from idam.report.view import approach, chance, frame, guess_up, sample
from idam.result import Matches, RegistrationResult
from idam.search.judge import CONVERGED

__all__ = ["MAX_POINTS", "write_report", "write_view"]

MAX_POINTS = 100_000
"""Points of each cloud a page shows at most."""

TOUCHING = 1.5
"""Spacings of the target within which a view counts points as touching, as ``register`` does."""

_STEPS = 65535
"""Coordinates are sent as 16-bit integers: steps along the longest side of a cloud's bounding box."""

_VERDICTS = (
    (0.9, "high", "The clouds are very likely aligned."),
    (0.7, "fair", "The clouds are probably aligned; a look at the picture settles it."),
    (CONVERGED, "fair", "The clouds may be misaligned: check the picture before using the transform."),
    (0.0, "low", "The clouds are probably misaligned: do not use the transform unchecked."),
)
"""From this confidence on: the style of the bar, and what it means."""

_EVIDENCE = {
    "likelihood": "How much likelier the features make the answer than chance, as a logarithm",
    "overlap": "Overlap: mean share of both clouds that lies on the other, 0 to 1",
    "contained": "Share of the better covered cloud that lies on the other, 0 to 1",
    "support": "Share of the feature matches that the answer brings together",
    "violation": "Share of the points that lie where the other scan saw through",
    "close": "Share of what touches that touches at a finer resolution, too",
    "off": "Distance from the other surface, as a share of the reach",
    "border": "How cleanly each sparse cloud ends where the other goes on, 0 to 1",
    "fixed": "How firmly the surfaces hold each other where they do so least, 0 for a slide, to 1",
    "lead": "How far it is ahead of the next best answer, in logits",
}
"""What the fields of :class:`idam.search.judge.Evidence` are called on the page."""

RUNNERS_UP = 3
"""Other answers a page names at most."""

_Rows = list[tuple[str, str]]


def write_report(
    path: str | PathLike[str],
    source: PointCloud,
    target: PointCloud,
    result: RegistrationResult,
    *,
    source_name: str,
    target_name: str,
) -> None:
    """Write the page of one registration: the pair before and after, the feature matches, and the figures.

    The page refers to nothing outside itself. It shows at most :data:`MAX_POINTS` of each cloud, and says so. The same
    input gives the same bytes.

    Args:
        path: the HTML file to write, atomically.
        source: the source as it was given to ``register``, not moved.
        target: the target.
        result: what ``register`` returned for them.
        source_name: what the page calls the source, such as its file name.
        target_name: what the page calls the target.

    Raises:
        InputError: the file cannot be written.
    """
    level, verdict = _verdict(result.confidence)
    _write(
        path,
        (source, target),
        (source_name, target_name),
        result.transformation,
        result.matches,
        kind="judged",
        title=_escape(f"{source_name} onto {target_name}: {chance(result.confidence)} confidence"),
        overline="idam registration report",
        confidence=_escape(chance(result.confidence)),
        confidence_percent=f"{100 * result.confidence:.1f}",
        level=level,
        verdict=verdict,
        reason=_escape(f"{result.reason[:1].upper()}{result.reason[1:]}." if result.reason else ""),
        headlines=_headlines(
            result.transformation, result.fitness, result.inlier_rmse, result.max_correspondence_distance
        ),
        evidence=_rows(_evidence(result)),
        details=_rows(_details(result, source, target, source_name, target_name)),
    )


def write_view(
    path: str | PathLike[str],
    source: PointCloud,
    target: PointCloud,
    transformation: NDArray[np.float64],
    *,
    source_name: str,
    target_name: str,
) -> None:
    """Write a page of two clouds, before and after a transform (4, 4), without a confidence: nothing is known of it.

    The arguments are those of :func:`write_report`. Fitness is measured within one and a half spacings of the target.

    Raises:
        InputError: the file cannot be written.
    """
    centre = target.points.mean(axis=0)
    around = target.points - centre
    distance = TOUCHING * spacing_of(around)
    rows, apart = nearest_within(rigid.apply(transformation, source.points) - centre, around, distance)
    rmse = float(np.sqrt(np.mean(apart**2))) if len(apart) else 0.0
    names = [("Source", source_name, source), ("Target", target_name, target)]
    _write(
        path,
        (source, target),
        (source_name, target_name),
        transformation,
        Matches(np.empty((0, 3)), np.empty((0, 3)), np.empty(0)),
        kind="unjudged",
        title=_escape(f"{source_name} and {target_name}"),
        overline="idam view",
        **dict.fromkeys(("confidence", "confidence_percent", "level", "verdict", "reason", "evidence"), ""),
        headlines=_headlines(transformation, len(rows) / len(source.points), rmse, distance),
        details=_rows([(what, f"{name}, {len(cloud.points):,} points") for what, name, cloud in names]),
    )


def _write(
    path: str | PathLike[str],
    clouds: tuple[PointCloud, PointCloud],
    names: tuple[str, str],
    transformation: NDArray[np.float64],
    matches: Matches,
    **fields: str,
) -> None:
    """Fill the template and write it."""
    shown = [sample(cloud.points, MAX_POINTS) for cloud in clouds]
    template = resources.files("idam.report").joinpath("page.html").read_text(encoding="utf-8")
    page = _fill(
        template,
        source_name=_escape(names[0]),
        target_name=_escape(names[1]),
        matrix=_matrix(transformation),
        matrix_text=_escape(format_transform(transformation)),
        source_count=_count(shown[0], clouds[0].points),
        target_count=_count(shown[1], clouds[1].points),
        scene=_json(_scene(shown[0], shown[1], transformation, matches)),
        **fields,
    )
    write_text(path, page)


# The figures


def _headlines(transformation: NDArray[np.float64], fitness: float, rmse: float, distance: float) -> str:
    """Lay out the four figures at the top as cards."""
    shift = float(np.linalg.norm(transformation[:3, 3]))
    cards = [
        ("Fitness", f"{100 * fitness:.1f} %", f"of the source lies within {_number(distance, 3)} of the target"),
        ("Inlier RMSE", _number(rmse, 3), "distance of those points, in the input’s unit"),
        ("Rotation", _degrees(transformation[:3, :3]), "angle, about one axis"),
        ("Translation", _number(shift), "length, in the input’s unit"),
    ]
    return "\n".join(
        f'<div class="card"><h2>{label}</h2><p class="figure">{value}</p><p class="note">{note}</p></div>'
        for label, value, note in cards
    )


def _details(
    result: RegistrationResult, source: PointCloud, target: PointCloud, source_name: str, target_name: str
) -> _Rows:
    """Name the other figures."""
    kept = int(np.count_nonzero(result.matches.weight))
    moved = result.apply(source.points.mean(axis=0)) - source.points.mean(axis=0)
    return [
        ("Source", f"{source_name}, {len(source.points):,} points"),
        ("Target", f"{target_name}, {len(target.points):,} points"),
        ("Source’s centroid moves by", _number(float(np.linalg.norm(moved)))),
        ("Inlier pairs", f"{len(result.correspondence_set):,}"),
        ("Max correspondence distance", _number(result.max_correspondence_distance)),
        ("Feature matches", f"{kept:,} agree, {len(result.matches.weight) - kept:,} do not"),
        ("Model", result.model),
        ("Time", f"{_number(result.seconds, 3)} s"),
    ]


def _evidence(result: RegistrationResult) -> _Rows:
    """Name what the confidence was computed from, and the best of the other answers."""
    rows = [(_EVIDENCE.get(name, name), _number(value, 2)) for name, value in asdict(result.evidence).items()]
    for place, other in enumerate(result.hypotheses[:RUNNERS_UP], start=2):
        turn = _degrees(result.transformation[:3, :3].T @ other.transformation[:3, :3])
        rows.append((f"Answer {place}, {turn} away from this one", f"score {_number(other.score, 2)}"))
    return rows


def _rows(rows: _Rows) -> str:
    """Lay out labels and values as the rows of a table."""
    return "\n".join(f"<tr><th>{_escape(label)}</th><td>{_escape(value)}</td></tr>" for label, value in rows)


def _matrix(transformation: NDArray[np.float64]) -> str:
    """Lay out the 4x4 as table rows, the translation with decimals to suit its size."""
    largest = float(np.abs(transformation[:3, 3]).max())
    decimals = min(9, max(3, 6 - math.floor(math.log10(largest)))) if largest else 6
    rows = [[*(f"{value:.6f}" for value in row[:3]), f"{row[3]:.{decimals}f}"] for row in transformation[:3].tolist()]
    rows.append(["0", "0", "0", "1"])
    return "\n".join("<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in rows).replace("-", "−")


def _degrees(rotation: NDArray[np.float64]) -> str:
    """Write the angle of a rotation (3, 3)."""
    # the arc sine of the chord, unlike the arc cosine of the trace, is accurate for small angles too
    angle = 2 * math.asin(min(1.0, float(np.linalg.norm(rotation - np.eye(3))) / math.sqrt(8)))
    return f"{_number(math.degrees(angle))}°"


def _count(shown: NDArray[np.float64], points: NDArray[np.float64]) -> str:
    """How many points there are, and how many of them are shown if not all."""
    if len(shown) == len(points):
        return f"{len(points):,} points"
    return f"showing {len(shown):,} of {len(points):,} points"


def _verdict(confidence: float) -> tuple[str, str]:
    """Say what a confidence means: the style of its bar, and a sentence."""
    return next((level, verdict) for least, level, verdict in _VERDICTS if confidence >= least or least == 0)


def _number(value: float, digits: int = 4) -> str:
    """Write a number of any unit and size to that many significant digits."""
    if not math.isfinite(value):
        return "n/a"
    magnitude = math.floor(math.log10(abs(value))) if value else 0
    style = f",.{max(0, digits - 1 - magnitude)}f" if -5 <= magnitude <= 9 else f".{digits - 1}e"
    return format(value, style).replace("-", "−")


# The scene


def _scene(
    source: NDArray[np.float64], target: NDArray[np.float64], transformation: NDArray[np.float64], matches: Matches
) -> dict[str, Any]:
    """Gather what the page's script draws, in coordinates around the target's centre.

    A cloud's own coordinates are relative to its centre, so that float32 is enough for what was in metres of a
    national grid; the two poses of the source take its coordinates to the target's.
    """
    clouds = [_cloud(source), _cloud(target)]
    centres = [np.array(cloud["centre"]) for cloud in clouds]
    local = [points - centre for points, centre in zip((source, target), centres, strict=True)]
    rotation = transformation[:3, :3]
    moved = rotation @ centres[0] + transformation[:3, 3] - centres[1]
    offset, gap = approach(local, centres[0] - centres[1])
    return {
        "source": clouds[0],
        "target": clouds[1],
        "matches": _matches(matches, centres),
        "before": {
            "pose": _pose(np.eye(3), offset),
            "gap": _number(gap) if gap else "",
            **frame(local[0] + offset, local[1]),
        },
        "after": {"pose": _pose(rotation, moved), "gap": "", **frame(local[0] @ rotation.T + moved, local[1])},
        "up": guess_up(target),
    }


def _cloud(points: NDArray[np.float64]) -> dict[str, Any]:
    """Points as 16-bit integers: coordinate = centre + step (integer - 32767.5)."""
    low, high = points.min(axis=0), points.max(axis=0)
    centre = (low + high) / 2
    step = float((high - low).max()) / _STEPS or 1.0
    quantised = np.rint((points - centre) / step + _STEPS / 2).clip(0, _STEPS)
    return {"points": _base64(quantised, "<u2"), "centre": centre.tolist(), "step": step}


def _matches(matches: Matches, centres: list[NDArray[np.float64]]) -> dict[str, Any]:
    """Sort matches from weak to strong, so that the strong are drawn last; each end relative to its cloud's centre."""
    order = np.argsort(matches.weight, kind="stable")
    ends = [(matches.source - centres[0])[order], (matches.target - centres[1])[order]]
    return {
        "ends": _base64(np.concatenate(ends, axis=1), "<f4"),
        "weights": _base64(matches.weight[order], "<f4"),
        "strongest": _number(float(matches.weight.max(initial=0)), 2),
    }


def _pose(rotation: NDArray[np.float64], translation: NDArray[np.float64]) -> list[list[float]]:
    """Put the upper three rows of a 4x4 together."""
    rows: list[list[float]] = np.column_stack([rotation, translation]).tolist()
    return rows


# Text


def _base64(values: NDArray[Any], dtype: str) -> str:
    return base64.b64encode(np.ascontiguousarray(values, dtype).tobytes()).decode("ascii")


def _json(value: Any) -> str:
    """JSON that cannot end the script element it stands in."""
    text = json.dumps(value, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _escape(text: str) -> str:
    """Any text, even a file name that is not Unicode, for use in HTML."""
    return html.escape(text.encode("utf-8", "replace").decode("utf-8"))


def _fill(template: str, **fields: str) -> str:
    """Put each field in place of its ``{{name}}``, in one pass: what is put in is not searched again."""
    return re.sub(r"\{\{(\w+)\}\}", lambda match: fields[match[1]], template)
