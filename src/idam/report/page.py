"""One registration as a page to look at and to print: a self-contained HTML file that opens offline in any browser.

Python fills in the figures and packs the points; ``page.html`` beside this file shows them, with ``viewer.js``, which
it shares with the page of a merge.
"""

from __future__ import annotations

from dataclasses import asdict
from os import PathLike

import numpy as np
from numpy.typing import NDArray

from idam import rigid
from idam.clouds.surfaces import nearest_within, spacing_of
from idam.io import PointCloud, format_transform, write_text
from idam.report.markup import escape, fill, number, plain_json, rows, template
from idam.report.motion import Motion, motion_of
from idam.report.pack import thinned
from idam.report.palette import SOURCE, TARGET, TARGET_ON_DARK
from idam.report.record import Record
from idam.report.scene import pair_scene
from idam.result import Hypothesis, Matches, RegistrationResult, chance
from idam.search.judge import CONVERGED

__all__ = ["MAX_POINTS", "write_report", "write_view"]

MAX_POINTS = 100_000
"""Points of each cloud a page shows at most."""

TOUCHING = 1.5
"""Spacings of the target within which a view counts points as touching, as ``register`` does."""

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
    "geometric_lead": "How far it is ahead as far as the surfaces alone tell, in logits",
}
"""What the fields of :class:`idam.search.judge.Evidence` are called on the page."""

RUNNERS_UP = 3
"""Other answers a page offers at most."""


def write_report(
    path: str | PathLike[str],
    source: PointCloud,
    target: PointCloud,
    result: RegistrationResult,
    *,
    source_name: str,
    target_name: str,
    record: Record | None = None,
) -> None:
    """Write the page of one registration: the pair before and after, the feature matches, and the figures.

    The page refers to nothing outside itself. It shows at most :data:`MAX_POINTS` of each cloud, and says so. The same
    input and the same date give the same bytes.

    Args:
        path: the HTML file to write, atomically.
        source: the source as it was given to ``register``, not moved.
        target: the target.
        result: what ``register`` returned for them.
        source_name: what the page calls the source, such as its file name.
        target_name: what the page calls the target.
        record: files, options and unit, for a report to hand in; None for the date and version alone.

    Raises:
        InputError: the file cannot be written.
    """
    record = record or Record()
    level, verdict = _verdict(result.confidence)
    answers = [Hypothesis(result.transformation, 0.0), *result.hypotheses[:RUNNERS_UP]]
    _write(
        path,
        (source, target),
        (source_name, target_name),
        [answer.transformation for answer in answers],
        result.matches,
        record,
        kind="judged",
        title=escape(f"{source_name} onto {target_name}: {chance(result.confidence)} confidence"),
        overline="idam registration report",
        confidence=escape(chance(result.confidence)),
        confidence_percent=f"{100 * result.confidence:.1f}",
        level=level,
        verdict=verdict,
        reason=escape(f"{result.reason[:1].upper()}{result.reason[1:]}." if result.reason else ""),
        choices=_choices(result),
        headlines=_headlines(
            motion_of(result.transformation, source.points),
            (result.fitness, result.inlier_rmse, result.max_correspondence_distance),
            record,
        ),
        evidence=rows(_evidence(result)),
        details=rows(
            [*record.of_files((source_name, target_name), (source, target)), *_details(result), *record.of_run()]
        ),
    )


def write_view(
    path: str | PathLike[str],
    source: PointCloud,
    target: PointCloud,
    transformation: NDArray[np.float64],
    *,
    source_name: str,
    target_name: str,
    record: Record | None = None,
) -> None:
    """Write a page of two clouds, before and after a transform (4, 4), without a confidence: nothing is known of it.

    The arguments are those of :func:`write_report`. Fitness is measured within one and a half spacings of the target.

    Raises:
        InputError: the file cannot be written.
    """
    record = record or Record()
    centre = target.points.mean(axis=0)
    around = target.points - centre
    distance = TOUCHING * spacing_of(around)
    inliers, apart = nearest_within(rigid.apply(transformation, source.points) - centre, around, distance)
    rmse = float(np.sqrt(np.mean(apart**2))) if len(apart) else 0.0
    _write(
        path,
        (source, target),
        (source_name, target_name),
        [transformation],
        Matches(np.empty((0, 3)), np.empty((0, 3)), np.empty(0)),
        record,
        kind="unjudged",
        title=escape(f"{source_name} and {target_name}"),
        overline="idam view",
        **dict.fromkeys(("confidence", "confidence_percent", "level", "verdict", "reason", "evidence", "choices"), ""),
        headlines=_headlines(
            motion_of(transformation, source.points), (len(inliers) / len(source.points), rmse, distance), record
        ),
        details=rows([*record.of_files((source_name, target_name), (source, target)), *record.of_run()]),
    )


def _write(
    path: str | PathLike[str],
    clouds: tuple[PointCloud, PointCloud],
    names: tuple[str, str],
    answers: list[NDArray[np.float64]],
    matches: Matches,
    record: Record,
    **fields: str,
) -> None:
    """Fill the template and write it."""
    shown = thinned(clouds[0], MAX_POINTS), thinned(clouds[1], MAX_POINTS)
    page = fill(
        template("page.html"),
        source_colour=SOURCE,
        target_colour=TARGET,
        target_colour_dark=TARGET_ON_DARK,
        source_name=escape(names[0]),
        target_name=escape(names[1]),
        made=escape(record.made),
        unit=escape(record.lengths),
        matrices="\n".join(_matrix(answer, place) for place, answer in enumerate(answers)),
        motions="\n".join(_motion(motion_of(answer, clouds[0].points), place) for place, answer in enumerate(answers)),
        source_count=_count(shown[0], clouds[0]),
        target_count=_count(shown[1], clouds[1]),
        scene=plain_json(pair_scene(shown[0], shown[1], answers, matches)),
        **fields,
    )
    write_text(path, page)


def _headlines(motion: Motion, fit: tuple[float, float, float], record: Record) -> str:
    """Lay out the four figures at the top as cards: fitness, RMSE, and the distance that both were measured at."""
    fitness, rmse, distance = fit
    unit = f" {record.unit}" if record.unit else ""
    cards = [
        ("Fitness", f"{100 * fitness:.1f} %", f"of the source lies within {number(distance, 3)}{unit} of the target"),
        ("Inlier RMSE", f"{number(rmse, 3)}{unit}", f"distance of those points, in {record.lengths}"),
        ("Rotation", f"{number(motion.degrees)}°", "angle, about one axis"),
        ("Shift", f"{number(motion.distance)}{unit}", f"of the source’s centroid, in {record.lengths}"),
    ]
    return "\n".join(
        f'<div class="card"><h2>{label}</h2><p class="figure">{escape(value)}</p>'
        f'<p class="note">{escape(note)}</p></div>'
        for label, value, note in cards
    )


def _details(result: RegistrationResult) -> list[tuple[str, str]]:
    """Name the other figures."""
    kept = int(np.count_nonzero(result.matches.weight))
    return [
        ("Inlier pairs", f"{len(result.correspondence_set):,}"),
        ("Max correspondence distance", number(result.max_correspondence_distance)),
        ("Feature matches", f"{kept:,} agree, {len(result.matches.weight) - kept:,} do not"),
        ("Model", result.model),
        ("Time", f"{number(result.seconds, 3)} s"),
    ]


def _evidence(result: RegistrationResult) -> list[tuple[str, str]]:
    """Name what the confidence was computed from."""
    return [(_EVIDENCE.get(name, name), number(value, 2)) for name, value in asdict(result.evidence).items()]


def _choices(result: RegistrationResult) -> str:
    """The answers to look at, as the options of a list: the one given, and the best of the others."""
    labels = [f"1: the answer, confidence {chance(result.confidence)}"]
    for place, other in enumerate(result.hypotheses[:RUNNERS_UP], start=2):
        turn = np.degrees(float(rigid.angle(result.rotation.T @ other.transformation[:3, :3])))
        labels.append(f"{place}: {number(turn)}° away, score {number(other.score, 2)}")
    return "".join(f"<option>{escape(label)}" for label in labels)


def _matrix(transformation: NDArray[np.float64], place: int) -> str:
    """Lay out a 4x4 as a table with all the digits of its doubles; of several, the first is shown."""
    text = format_transform(transformation)
    lines = ["".join(f"<td>{cell}</td>" for cell in line.split()) for line in text.splitlines()]
    body = "\n".join(f"<tr>{line}</tr>" for line in lines)
    hidden = " hidden" if place else ""
    return (
        f'<div class="scroll" data-answer="{place}"{hidden}>'
        f'<table class="matrix" data-text="{escape(text)}">{body}</table></div>'
    )


def _motion(motion: Motion, place: int) -> str:
    """Lay out a motion as a table; of several, the first is shown."""
    body = rows([(name.capitalize(), value) for name, value in motion.written()])
    return f'<table class="details motion" data-answer="{place}"{" hidden" if place else ""}>{body}</table>'


def _count(shown: PointCloud, cloud: PointCloud) -> str:
    """How many points there are, and how many of them are shown if not all."""
    if len(shown.points) == len(cloud.points):
        return f"{len(cloud.points):,} points"
    return f"showing {len(shown.points):,} of {len(cloud.points):,} points"


def _verdict(confidence: float) -> tuple[str, str]:
    """Say what a confidence means: the style of its bar, and a sentence."""
    return next((level, verdict) for least, level, verdict in _VERDICTS if confidence >= least or least == 0)
