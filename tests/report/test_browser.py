"""The page of one registration in a browser: drawn, blended, measured, printed."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from idam.io import PointCloud
from idam.result import Hypothesis
from pages import NATIONAL_GRID, local_points, make_pair, opened, scene_of, write

DRAWN = """
const seen = [ink()];
element("matches-before").click();
for (const share of [0, 20, 50, 100]) { set("blend", share); viewer.draw(); seen.push(ink()); }
set("blend", 0);
element("own").click();
viewer.draw();
seen.push(ink());
return seen;"""


@pytest.mark.parametrize("software", [False, True])
def test_both_clouds_are_drawn_and_blend_into_each_other(tmp_path: Path, software: bool) -> None:
    path = tmp_path / "page.html"
    source_cloud, *pair = make_pair()
    painted = PointCloud(source_cloud.points, np.tile(np.array([30, 30, 255], np.uint8), (400, 1)))
    page = write(path, painted, *pair)
    seen = np.array(opened(path, page, DRAWN, software=software))  # (6, 2 views, orange and blue)
    assert seen[0].min() > 200
    source, faded, both, target, own = seen[1:, 1]
    assert source[0] > 200 and source[1] == 0
    assert target[1] > 200 and target[0] == 0
    assert source[0] > faded[0] > both[0]  # the source shines through what covers it
    assert own[0] == 0 and own[1] == source[0]  # the source in a blue of its own


USED = """
HTMLElement.prototype.setPointerCapture = () => {};
const told = {};
for (const view of viewer.views) {
  const found = viewer.members(view.frame).flatMap(({ cloud, points, matrix }) =>
    [...Array(points.length / 3).keys()].map((row) => ({
      cloud, row, at: projected(matrix, points.subarray(3 * row, 3 * row + 3), view.frame),
    })));
  const front = found.reduce((a, b) => (a.at[2] < b.at[2] ? a : b)), box = view.canvas.getBoundingClientRect();
  const click = () => ["pointerdown", "pointerup"].forEach((name) => view.canvas.dispatchEvent(new PointerEvent(
    name, { pointerId: 1, clientX: box.left + front.at[0], clientY: box.top + front.at[1] })));
  click(); // not measuring yet
  const before = viewer.marks.length;
  element("measure").click();
  click();
  element("measure").click();
  told[view.id] = [before, viewer.marks.length];
  element("measure").click();
  click();
  told[view.id].push(viewer.marks.map(({ cloud, row }) => [cloud.name, row]), [[front.cloud.name, front.row]]);
  element("measure").click();
}
element("measure").click();
viewer.marks = [{ cloud: clouds[0], row: 7 }, { cloud: clouds[1], row: 11 }];
viewer.draw();
told.measured = element("measured").textContent;
element("answer").selectedIndex = 1;
element("answer").dispatchEvent(new Event("input", { bubbles: true }));
viewer.draw();
told.matrices = [...document.querySelectorAll(".matrix")].filter((each) => each.offsetParent)
  .map((each) => each.dataset.text);
told.pose = subject("after").layers[0][0][0].pose;
return told;"""


def test_distances_are_true_far_from_the_origin_and_other_answers_can_be_seen(tmp_path: Path) -> None:
    path = tmp_path / "page.html"
    away = (NATIONAL_GRID[0] + 250.0, *NATIONAL_GRID[1:])  # so far that they are drawn closer together
    source, target, result = make_pair(source_at=away, target_at=NATIONAL_GRID)
    other = result.transformation @ np.diag([-1.0, -1, 1, 1])
    result.hypotheses.append(Hypothesis(other, 0.1))
    page = write(path, source, target, result)
    scene = scene_of(page)
    assert scene["before"]["gap"]
    told = opened(path, page, USED)

    for view in ("before", "after"):  # a click picks the point in front, but only if one is measuring
        idle, stopped, marks, expected = told[view]
        assert (idle, stopped) == (0, 0)
        assert marks == expected

    (one, another) = (
        local_points(scene[name])[row] + scene[name]["centre"] for name, row in (("source", 7), ("target", 11))
    )
    found = [float(text) for text in re.findall(r"(?:before|after) ([\d.]+) \(", told["measured"])]
    lengths = [np.linalg.norm(another - one), np.linalg.norm(another - result.apply(one))]
    assert found == pytest.approx(lengths, abs=2 * scene["source"]["step"])
    assert "in m:" in told["measured"]

    (text,) = told["matrices"]
    np.testing.assert_array_equal(np.array([line.split() for line in text.splitlines()], float), other)
    np.testing.assert_allclose(np.array(told["pose"])[:, :3], other[:3, :3])


def test_page_prints_with_its_pictures(tmp_path: Path) -> None:
    path, paper = tmp_path / "page.html", tmp_path / "page.pdf"
    opened(path, write(path), "", paper=paper)
    data = paper.read_bytes()
    assert data.startswith(b"%PDF")
    assert data.count(b"/Subtype /Image") >= 2
