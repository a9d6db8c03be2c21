"""The page of a merge in a browser: drawn, and measured on, with the viewer that it shares with the page of a pair."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from idam import rigid
from idam.io import PointCloud
from idam.many.result import Link, MergeResult
from idam.report.merge import write_merge_report
from idam.report.palette import SOURCE, TARGET
from pages import NATIONAL_GRID, opened, write


def merged(count: int, place: np.ndarray) -> MergeResult:
    """Scans of one cloud, each in a pose of its own, the last one not placed."""
    random = np.random.default_rng(0)
    poses = [rigid.exp(np.r_[random.normal(size=3), random.normal(scale=5, size=3)]) for _ in range(count)]
    poses = [rigid.inverse(poses[0]) @ pose for pose in poses]
    cloud = random.normal(size=(300, 3))
    clouds = [PointCloud(rigid.apply(rigid.inverse(pose), cloud) + place) for pose in poses]
    there = rigid.transform(np.eye(3), place)
    placed = [there @ pose @ rigid.inverse(there) for pose in poses[:-1]]
    links = [
        Link(n, n + 1, np.eye(4), np.eye(6), 0.9996, 0.6, 0.01, used=n < count - 2, reason="") for n in range(count - 1)
    ]
    names = [f"<scan {n}>.ply" for n in range(count)]
    components = [list(range(count - 1)), [count - 1]]
    confidence = np.array([0.9996] * (count - 1) + [0.0])
    return MergeResult(
        names, [*placed, None], components, confidence, [""] * (count - 1) + ["no link"], links, 0.1, 1.0, clouds
    )


def test_merge_page_is_drawn_and_measures_true_distances(tmp_path: Path) -> None:
    path = tmp_path / "report.html"
    result = merged(5, np.array(NATIONAL_GRID))
    write_merge_report(path, result)
    page = path.read_text(encoding="utf-8")
    assert "{{" not in page
    assert "<td>&gt; 99 %</td>" in page and "100" not in page.partition("<tbody>")[2].partition("</tbody>")[0]
    script = """
    viewer.marks = [{ cloud: scans[0], row: 0 }, { cloud: scans[1], row: 0 }];
    viewer.draw();
    const lengths = viewer.views.map((view) => {
      const [a, b] = viewer.marks.map((mark) => viewer.located(view, mark).place);
      return Math.hypot(...a.map((value, i) => b[i] - value));
    });
    const spots = scans.slice(0, 2).map(({ step, centre, points }) =>
      centre.map((value, i) => value + step * (points[i] - HALF_RANGE)));
    const all = viewer.members(viewer.views[1].frame).length;
    element("none").click();
    viewer.draw();
    return { lengths, spots, all, none: viewer.members(viewer.views[1].frame).length };"""
    told = opened(path, page, script)
    one, other = np.array(told["spots"])
    moved = [rigid.apply(pose, point[None])[0] for pose, point in zip(result.poses[:2], (one, other), strict=True)]
    expected = [np.linalg.norm(other - one), np.linalg.norm(moved[1] - moved[0])]
    assert told["lengths"] == pytest.approx(expected, abs=1e-3)
    assert (told["all"], told["none"]) == (4, 0)


def test_source_and_target_have_the_colours_of_the_pictures(tmp_path: Path) -> None:
    page = write(tmp_path / "page.html")
    assert f"--source: {SOURCE}; --target: {TARGET};" in page
