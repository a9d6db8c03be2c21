"""The HTML page of one registration."""

from __future__ import annotations

import base64
import json
import re
import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import asdict
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from answers import EVIDENCE, made_up
from idam.errors import InputError
from idam.io import PointCloud
from idam.report.page import MAX_POINTS, RUNNERS_UP, write_report
from idam.result import Hypothesis, Matches, RegistrationResult

HERE = (0.0, 0.0, 0.0)
NATIONAL_GRID = (512_300.0, 5_403_200.0, 320.0)


def bumpy_torus(count: int, seed: int) -> np.ndarray:
    around, across = np.random.default_rng(seed).uniform(0, 2 * np.pi, (2, count))
    radius = 2 + 0.7 * np.cos(across) + 0.1 * np.sin(5 * around)
    return np.stack([radius * np.cos(around), radius * np.sin(around), 0.7 * np.sin(across)], axis=1)


def make_pair(
    count: int = 400,
    *,
    source_at: tuple[float, float, float] = HERE,
    target_at: tuple[float, float, float] = HERE,
    match_count: int = 24,
    confidence: float = 0.873,
    model: str = "gnn-unseen-shapes",
    reason: str = "",
    hypotheses: Sequence[Hypothesis] = (),
) -> tuple[PointCloud, PointCloud, RegistrationResult]:
    rng = np.random.default_rng(0)
    rotation = np.array([[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1.0]])
    target = bumpy_torus(count, seed=1) + target_at
    source = bumpy_torus(count, seed=2) @ rotation + source_at
    transformation = np.eye(4)
    transformation[:3, :3] = rotation
    transformation[:3, 3] = np.asarray(target_at) - rotation @ np.asarray(source_at)
    rows = rng.integers(count, size=match_count)
    weight = np.where(rng.random(match_count) < 0.3, 0.0, rng.random(match_count))
    matches = Matches(source[rows], target[rows], weight / max(weight.sum(), 1))
    result = made_up(
        source,
        target,
        transformation,
        confidence=confidence,
        converged=confidence >= 0.5,
        reason=reason,
        hypotheses=list(hypotheses),
        matches=matches,
        model=model,
        seconds=0.042,
        clouds=(source, target),
    )
    return PointCloud(source), PointCloud(target), result


def write(path: Path, *pair: Any, source_name: str = "source.ply", target_name: str = "target.ply") -> str:
    write_report(path, *(pair or make_pair()), source_name=source_name, target_name=target_name)
    return path.read_text(encoding="utf-8")


def scene_of(page: str) -> dict[str, Any]:
    text = re.search(r'<script type="application/json" id="scene">(.*?)</script>', page, re.DOTALL)
    assert text
    scene: dict[str, Any] = json.loads(text[1])
    return scene


def decode(text: str, dtype: str, columns: int) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), dtype).reshape(-1, columns).astype(np.float64)


def local_points(cloud: dict[str, Any]) -> np.ndarray:
    return (decode(cloud["points"], "<u2", 3) - 32767.5) * cloud["step"]


def move(pose: list[list[float]], points: np.ndarray) -> np.ndarray:
    rows = np.array(pose)
    return points @ rows[:, :3].T + rows[:, 3]


class Outline(HTMLParser):
    """The page as a browser reads it: its tags, their attributes, and the text inside <bdi> and <title>."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.attributes: list[tuple[str, str]] = []
        self.texts: dict[str, list[str]] = {"bdi": [], "title": [], "td": []}
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += [(name, value or "") for name, value in attrs]
        if tag in self.texts:
            self.texts[tag].append("")

    def handle_data(self, data: str) -> None:
        if self.tags and self.tags[-1] in self.texts:
            self.texts[self.tags[-1]][-1] += data

    def handle_endtag(self, tag: str) -> None:
        self.tags.append("/" + tag)


def test_page_refers_to_nothing_outside_itself(tmp_path: Path) -> None:
    page = write(tmp_path / "page.html")
    assert not re.search(r"https?:|//\w+\.|@import|url\(|\bfetch\(|XMLHttpRequest|\bimport\(|WebSocket", page)
    links = [value for name, value in Outline(page).attributes if name in {"src", "href", "srcset", "action", "data"}]
    assert links == ["data:,"]  # the empty icon, so that no server is asked for one
    assert "default-src 'none'" in page  # and the browser is told to keep it so


def test_every_field_of_the_template_is_filled(tmp_path: Path) -> None:
    assert "{{" not in write(tmp_path / "page.html")


@pytest.mark.parametrize("place", [HERE, NATIONAL_GRID], ids=["at the origin", "in a national grid"])
def test_payload_reproduces_the_points_within_half_a_step(tmp_path: Path, place: tuple[float, float, float]) -> None:
    source, target, result = make_pair(source_at=place, target_at=place)
    scene = scene_of(write(tmp_path / "page.html", source, target, result))
    for cloud, points in ((scene["source"], source.points), (scene["target"], target.points)):
        extent = np.ptp(points, axis=0).max()
        assert cloud["step"] == pytest.approx(extent / 65535)
        error = local_points(cloud) + cloud["centre"] - points
        assert np.abs(error).max() <= 0.5 * cloud["step"] + 1e-9


@pytest.mark.parametrize("place", [HERE, NATIONAL_GRID], ids=["at the origin", "in a national grid"])
def test_poses_lay_the_source_where_it_was_and_where_it_belongs(
    tmp_path: Path, place: tuple[float, float, float]
) -> None:
    source, target, result = make_pair(source_at=place, target_at=place)
    scene = scene_of(write(tmp_path / "page.html", source, target, result))
    local, origin = local_points(scene["source"]), np.array(scene["target"]["centre"])
    tolerance = scene["source"]["step"]
    np.testing.assert_allclose(move(scene["before"]["pose"], local), source.points - origin, atol=tolerance)
    np.testing.assert_allclose(
        move(scene["after"]["pose"], local), result.apply(source.points) - origin, atol=tolerance
    )
    assert scene["before"]["gap"] == ""


def test_clouds_far_apart_are_drawn_closer_and_the_page_knows(tmp_path: Path) -> None:
    scene = scene_of(write(tmp_path / "page.html", *make_pair(target_at=NATIONAL_GRID)))
    assert scene["before"]["gap"] == "5,427,432"
    assert scene["before"]["radius"] < 5 * scene["after"]["radius"]
    assert 2 < scene["after"]["radius"] < 4


def test_matches_go_from_weak_to_strong_in_the_frames_of_their_clouds(tmp_path: Path) -> None:
    source, target, result = make_pair(target_at=NATIONAL_GRID)
    scene = scene_of(write(tmp_path / "page.html", source, target, result))
    ends, weights = decode(scene["matches"]["ends"], "<f4", 6), decode(scene["matches"]["weights"], "<f4", 1)[:, 0]
    order = np.argsort(result.matches.weight, kind="stable")
    np.testing.assert_allclose(weights, result.matches.weight[order], rtol=1e-6)
    np.testing.assert_allclose(ends[:, :3] + scene["source"]["centre"], result.matches.source[order], atol=1e-6)
    np.testing.assert_allclose(ends[:, 3:] + scene["target"]["centre"], result.matches.target[order], atol=1e-6)


def test_large_clouds_are_thinned_and_the_page_says_so(tmp_path: Path) -> None:
    source, target, result = make_pair(MAX_POINTS + 23_456)
    page = write(tmp_path / "page.html", source, target, result)
    scene = scene_of(page)
    assert "showing 100,000 of 123,456 points" in page
    assert len(local_points(scene["source"])) == len(local_points(scene["target"])) == MAX_POINTS
    assert page == write(tmp_path / "again.html", source, target, result)


def test_points_that_are_not_finite_are_left_out(tmp_path: Path) -> None:
    source, target, result = make_pair()
    source.points[7] = np.nan
    page = write(tmp_path / "page.html", source, target, result)
    assert len(local_points(scene_of(page)["source"])) == len(source.points) - 1
    assert "showing 399 of 400 points" in page


def test_same_input_gives_the_same_bytes(tmp_path: Path) -> None:
    assert write(tmp_path / "a.html") == write(tmp_path / "b.html")


@pytest.mark.parametrize(
    "name",
    [
        "</script><script>alert(1)</script>.ply",
        "\"><img src=x onerror='alert(1)'>&amp;.ply",
        "<!--<script>.ply",
        "{{scene}} {{matrix}}.ply",
        "scan \u2028 Größe 点.ply",
    ],
)
def test_names_are_shown_as_they_are_and_never_become_markup(tmp_path: Path, name: str) -> None:
    plain = Outline(write(tmp_path / "plain.html"))
    pair = make_pair(model=name)
    outline = Outline(write(tmp_path / "page.html", *pair, source_name=name, target_name=name))
    assert outline.tags == plain.tags
    assert outline.texts["bdi"] == [name, name]
    assert outline.texts["title"] == [f"{name} onto {name}: 87 % confidence"]
    assert name in outline.texts["td"]  # the model


def test_scene_could_not_end_its_script_element(tmp_path: Path) -> None:
    from idam.report.page import _json

    value = {"name": "</script><!--<script>&\u2028"}
    text = _json(value)
    assert not set("<>&\u2028") & set(text)
    assert json.loads(text) == value


def test_file_name_that_is_not_unicode_is_no_obstacle(tmp_path: Path) -> None:
    assert "scan?.ply" in write(tmp_path / "page.html", source_name="scan\udcff.ply")


def test_figures_are_in_the_page_itself(tmp_path: Path) -> None:
    page = write(tmp_path / "page.html")
    for text in ("87 %", "75.0 %", "0.0123", "36.87°", "within 0.0500 of", "gnn-unseen-shapes", "0.0420 s"):
        assert text in page


def test_what_the_confidence_is_computed_from_is_in_the_page(tmp_path: Path) -> None:
    page = write(tmp_path / "page.html")
    for label, value in (
        ("likelier", "1.5"),
        ("mean share of both clouds", "0.50"),
        ("better covered cloud", "0.62"),
        ("feature matches", "0.88"),
        ("saw through", "0.12"),
        ("finer resolution", "0.75"),
        ("other surface", "0.062"),
        ("ends where the other goes on", "1.0"),
        ("next best answer", "2.2"),
    ):
        assert re.search(rf"<th>[^<]*{label}[^<]*</th><td>{value}</td>", page)
    for name in asdict(EVIDENCE):  # each in words
        assert f"<th>{name}</th>" not in page


def test_reason_is_said_where_there_is_one(tmp_path: Path) -> None:
    assert 'id="reason"></p>' in write(tmp_path / "page.html")
    page = write(tmp_path / "page.html", *make_pair(confidence=0.2, reason="overlap <10 %"))
    assert 'id="reason">Overlap &lt;10 %.</p>' in page


def test_best_runners_up_are_named(tmp_path: Path) -> None:
    turned = make_pair()[2].transformation @ np.diag([-1.0, -1, 1, 1])
    others = [Hypothesis(turned, score=0.4 - 0.01 * n) for n in range(RUNNERS_UP + 2)]
    page = write(tmp_path / "page.html", *make_pair(hypotheses=others))
    assert "<th>Answer 2, 180.0° away from this one</th><td>score 0.40</td>" in page
    assert page.count("away from this one") == RUNNERS_UP


@pytest.mark.parametrize(
    ("confidence", "shown", "meaning"),
    [
        (1.0, "&gt; 99 %", "very likely aligned"),
        (0.8, "80 %", "probably aligned"),
        (0.5, "50 %", "may be misaligned"),
        (0.49, "49 %", "probably misaligned"),
        (0.0, "&lt; 1 %", "probably misaligned"),
    ],
)
def test_confidence_is_said_in_words_and_never_certain(
    tmp_path: Path, confidence: float, shown: str, meaning: str
) -> None:
    page = write(tmp_path / "page.html", *make_pair(confidence=confidence))
    assert f'id="confidence">{shown}<' in page
    assert meaning in page


def test_copied_matrix_is_exact(tmp_path: Path) -> None:
    source, target, result = make_pair(target_at=NATIONAL_GRID)
    text = dict(Outline(write(tmp_path / "page.html", source, target, result)).attributes)["data-text"]
    np.testing.assert_array_equal(np.array([line.split() for line in text.splitlines()], float), result.transformation)


@pytest.mark.parametrize("path", ["a file/page.html", "a folder"])
def test_page_that_cannot_be_written_raises_input_error(tmp_path: Path, path: str) -> None:
    (tmp_path / "a file").touch()
    (tmp_path / "a folder").mkdir()
    with pytest.raises(InputError):
        write(tmp_path / path)
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["a file", "a folder"]  # no half-written remains


COUNT_INK = """<script>
draw();
const ink = views.flatMap(({ canvas }) => {
  const { width, height } = canvas;
  const copy = Object.assign(document.createElement("canvas"), { width, height }).getContext("2d");
  copy.drawImage(canvas, 0, 0);
  const bytes = copy.getImageData(0, 0, width, height).data;
  let orange = 0, blue = 0;
  for (let i = 0; i < bytes.length; i += 4) {
    orange += bytes[i] - bytes[i + 2] > 60;
    blue += bytes[i + 2] - bytes[i] > 60;
  }
  return [orange, blue];
});
Object.assign(document.documentElement.dataset, { painter: Painter.name, ink: ink.join(" ") });
</script>"""


@pytest.mark.parametrize(
    ("painter", "match_count"), [("WebGLPainter", 24), ("WebGLPainter", 0), ("SoftwarePainter", 24)]
)
def test_browser_draws_both_clouds_in_both_views(tmp_path: Path, painter: str, match_count: int) -> None:
    browser = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if browser is None:
        pytest.skip("no chromium or google-chrome on PATH to open the page in")
    path = tmp_path / "page.html"
    path.write_text(write(path, *make_pair(match_count=match_count)) + COUNT_INK, encoding="utf-8")
    # without #webgl the page declines emulated WebGL, which is all that a headless browser has
    address = path.as_uri() + ("#webgl" if painter == "WebGLPainter" else "")
    flags = "--headless=new --no-sandbox --use-angle=swiftshader --enable-unsafe-swiftshader --enable-logging=stderr"
    command = [
        browser,
        *flags.split(),
        "--window-size=900,700",
        f"--user-data-dir={tmp_path / 'profile'}",
        "--dump-dom",
    ]
    run = subprocess.run([*command, address], capture_output=True, text=True, timeout=200, check=True)
    if painter == "WebGLPainter" and 'data-painter="Software' in run.stdout:
        pytest.skip("this browser has no WebGL 2, not even an emulated one")

    assert "CONSOLE" not in run.stderr, run.stderr
    assert f'data-painter="{painter}"' in run.stdout
    assert "<title>source.ply onto target.ply: 87 % confidence</title>" in run.stdout
    ink = re.search(r'data-ink="([\d ]+)"', run.stdout)
    assert ink
    assert min(map(int, ink[1].split())) > 200
