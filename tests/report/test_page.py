"""The HTML page of one registration."""

from __future__ import annotations

import json
import re
from dataclasses import asdict
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from answers import EVIDENCE
from idam import __version__, rigid
from idam.errors import InputError
from idam.io import PointCloud
from idam.report.page import MAX_POINTS, RUNNERS_UP, write_report
from idam.result import Hypothesis
from pages import HERE, NATIONAL_GRID, decode, local_points, make_pair, move, near, scene_of, unpacked, write


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
        shown = local_points(cloud) + cloud["centre"]
        assert len(shown) == len(points)
        assert max(near(shown, points), near(points, shown)) <= 0.5 * cloud["step"] + 1e-9


@pytest.mark.parametrize("place", [HERE, NATIONAL_GRID], ids=["at the origin", "in a national grid"])
def test_poses_lay_the_source_where_it_was_and_where_it_belongs(
    tmp_path: Path, place: tuple[float, float, float]
) -> None:
    source, target, result = make_pair(source_at=place, target_at=place)
    scene = scene_of(write(tmp_path / "page.html", source, target, result))
    local, origin = local_points(scene["source"]), np.array(scene["target"]["centre"])
    tolerance = scene["source"]["step"]
    after = scene["answers"][0]
    assert near(source.points - origin, move(scene["before"]["pose"], local)) < tolerance
    assert near(result.apply(source.points) - origin, move(after["pose"], local)) < tolerance
    assert (scene["before"]["place"], after["place"]) == (scene["before"]["pose"], after["pose"])
    assert scene["before"]["gap"] == ""


def test_clouds_far_apart_are_drawn_closer_and_the_page_knows(tmp_path: Path) -> None:
    scene = scene_of(write(tmp_path / "page.html", *make_pair(target_at=NATIONAL_GRID)))
    assert scene["before"]["gap"] == "5,427,432"
    assert scene["before"]["radius"] < 5 * scene["answers"][0]["radius"]
    assert 2 < scene["answers"][0]["radius"] < 4
    # what is measured is the true distance, not that of the picture
    assert np.linalg.norm(np.array(scene["before"]["place"])[:, 3]) == pytest.approx(5_427_432, rel=1e-5)


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
    from idam.report.markup import plain_json

    value = {"name": "</script><!--<script>&\u2028"}
    text = plain_json(value)
    assert not set("<>&\u2028") & set(text)
    assert json.loads(text) == value


def test_file_name_that_is_not_unicode_is_no_obstacle(tmp_path: Path) -> None:
    assert "scan?.ply" in write(tmp_path / "page.html", source_name="scan\udcff.ply")


def test_figures_are_in_the_page_itself(tmp_path: Path) -> None:
    page = write(tmp_path / "page.html")
    for text in ("87 %", "75.0 %", "0.0123 m", "36.87°", "within 0.0500 m of", "gnn-unseen-shapes", "0.0420 s"):
        assert text in page


def test_page_says_how_it_came_about(tmp_path: Path) -> None:
    page = write(tmp_path / "page.html")
    assert f"2026-01-02 03:04 UTC, idam {__version__}" in page
    for label, value in (
        ("Source", "source.ply, 1,234 bytes, 400 points"),
        ("Target", "target.ply, 400 points"),
        ("Options", "max-angle 90.0"),
        ("Unit of lengths", "m"),
        ("Date", "2026-01-02 03:04 UTC"),
    ):
        assert f"<th>{label}</th><td>{value}</td>" in page


def test_page_without_a_record_has_the_date_and_units_of_the_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "86400")
    write_report(tmp_path / "page.html", *make_pair(), source_name="a", target_name="b")
    page = (tmp_path / "page.html").read_text()
    assert "1970-01-02 00:00 UTC" in page
    assert 'data-unit="units of the files"' in page


def test_headline_is_the_shift_of_the_centroid_not_of_a_far_origin(tmp_path: Path) -> None:
    source, target, result = make_pair(source_at=NATIONAL_GRID, target_at=NATIONAL_GRID)
    assert np.linalg.norm(result.translation) > 1e6
    page = write(tmp_path / "page.html", source, target, result)
    shown = re.search(r'<h2>Shift</h2><p class="figure">([\d.]+) m</p>', page)
    assert shown
    centroid = source.points.mean(0)
    assert float(shown[1]) == pytest.approx(np.linalg.norm(result.apply(centroid) - centroid), rel=1e-3)


def test_numbers_on_paper_move_points_of_a_national_grid_by_less_than_a_millimetre(tmp_path: Path) -> None:
    source, target, result = make_pair(source_at=NATIONAL_GRID, target_at=NATIONAL_GRID)
    page = write(tmp_path / "page.html", source, target, result)
    table = re.search(r'<table class="matrix"[^>]*>(.*?)</table>', page, re.DOTALL)
    assert table
    matrix = np.array(re.findall(r"<td>([^<]*)</td>", table[1]), float).reshape(4, 4)
    expected = result.apply(source.points)
    assert np.abs(source.points @ matrix[:3, :3].T + matrix[:3, 3] - expected).max() < 1e-3

    local = re.search(r'<table class="details motion"[^>]*>(.*?)</table>', page, re.DOTALL)
    assert local
    centroid, axis, degrees, shift = (
        np.array(text.split(), float) for text in re.findall(r"<td>([^<]*)</td>", local[1])
    )
    turn = rigid.rotation_exp(np.radians(degrees) * axis)
    far = centroid + 10_000 * np.eye(3)  # ten kilometres
    for points in (source.points, far):
        moved = (points - centroid) @ turn.T + centroid + shift
        assert np.abs(moved - result.apply(points)).max() < 1e-3


def test_colours_of_the_scans_are_in_the_page_with_their_points(tmp_path: Path) -> None:
    source, target, result = make_pair()
    tint = np.arange(1200).reshape(400, 3).astype(np.uint8)
    painted = PointCloud(source.points, tint)
    grey = PointCloud(target.points, attributes={"intensity": np.arange(400.0)})
    scene = scene_of(write(tmp_path / "page.html", painted, grey, result))
    shown = local_points(scene["source"]) + scene["source"]["centre"]
    nearest = [int(np.abs(source.points - point).max(1).argmin()) for point in shown]
    np.testing.assert_array_equal(unpacked(scene["source"]["colours"], 1), tint[nearest])
    greys = unpacked(scene["target"]["colours"], 1)
    assert greys.min() == 0 and greys.max() == 255
    assert (greys == greys[:, :1]).all()
    assert scene_of(write(tmp_path / "plain.html"))["source"]["colours"] == ""


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
    source, _, result = make_pair()
    turned = result.transformation @ np.diag([-1.0, -1, 1, 1])
    others = [Hypothesis(turned, score=0.4 - 0.01 * n) for n in range(RUNNERS_UP + 2)]
    page = write(tmp_path / "page.html", *make_pair(hypotheses=others))
    assert "<option>1: the answer, confidence 87 %<option>2: 180.0° away, score 0.40<option>" in page
    assert page.count("° away") == RUNNERS_UP
    # each with its matrix, its motion and its picture, of which the first is shown
    assert page.count('data-answer="1" hidden') == 2
    scene = scene_of(page)
    assert len(scene["answers"]) == 1 + RUNNERS_UP
    local, origin = local_points(scene["source"]), np.array(scene["target"]["centre"])
    moved = move(scene["answers"][1]["pose"], local)
    assert near(rigid.apply(turned, source.points) - origin, moved) < scene["source"]["step"]


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
