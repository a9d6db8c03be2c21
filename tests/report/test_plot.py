"""The picture of one registration: what it shows, and the file it becomes."""

from __future__ import annotations

import subprocess
import sys
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from answers import made_up
from idam.errors import InputError
from idam.io import PointCloud
from idam.result import Matches, RegistrationResult

matplotlib = pytest.importorskip("matplotlib", reason="figures need Matplotlib: pip install 'idam[figures]'")

from matplotlib.collections import LineCollection, PathCollection  # noqa: E402
from matplotlib.figure import Figure  # noqa: E402

from idam.report.plot import MATCHES, POINTS, draw_result, heading, write_plot  # noqa: E402

FAR = np.array([512_300.0, 5_403_200.0, 320.0])


def bumpy(count: int, seed: int = 0) -> np.ndarray:
    points = np.random.default_rng(seed).normal(size=(count, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    return points * [1.0, 0.6, 0.4] + 0.3 * np.maximum(points, 0)


@pytest.fixture
def target() -> np.ndarray:
    return bumpy(500)


@pytest.fixture
def result(target: np.ndarray) -> RegistrationResult:
    """Lays the target, turned by a quarter about z, back on itself; of its matches a third has no weight."""
    transformation = np.array([[0.0, -1, 0, 2], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    weight = np.arange(60.0) - 20
    source = (target - transformation[:3, 3]) @ transformation[:3, :3]
    matches = Matches(source[:60], target[:60], weight.clip(0) / weight.clip(0).sum())
    return made_up(source, target, transformation, confidence=0.871, matches=matches)


@pytest.fixture
def source(target: np.ndarray, result: RegistrationResult) -> np.ndarray:
    return (target - result.transformation[:3, 3]) @ result.transformation[:3, :3]


def points_of(figure: Figure, panel: int) -> np.ndarray:
    """Where the source's points are in a panel, those of the target behind them."""
    (dots,) = [each for each in figure.axes[panel].collections if isinstance(each, PathCollection)]
    return np.asarray(dots.get_offsets())


def lines_of(figure: Figure) -> LineCollection:
    (lines,) = [each for each in figure.axes[1].collections if isinstance(each, LineCollection)]
    return lines


def test_before_they_lie_apart_and_after_on_each_other(
    source: np.ndarray, target: np.ndarray, result: RegistrationResult
) -> None:
    figure = draw_result(source, target, result, "")
    distinct = [len(np.unique(points_of(figure, panel).round(6), axis=0)) for panel in (0, 2)]
    shown = len(points_of(figure, 2))
    assert distinct[1] <= 0.55 * shown
    assert distinct[0] > 0.95 * shown


def test_right_matches_are_parallel_and_the_heavier_the_darker_and_later(
    source: np.ndarray, target: np.ndarray, result: RegistrationResult
) -> None:
    figure = draw_result(source, target, result, "")
    figure.canvas.draw()
    lines = lines_of(figure)
    along = np.diff(np.array(lines.get_segments()), axis=1)[:, 0]
    np.testing.assert_allclose(along, np.broadcast_to(along[0], along.shape), atol=1e-9)
    assert np.linalg.norm(along[0]) > 0.5
    weights = np.asarray(lines.get_array())
    assert len(weights) == 39 and (weights > 0).all() and (np.diff(weights) >= 0).all()
    assert (np.diff(lines.get_colors()[:, :3] @ [0.299, 0.587, 0.114]) <= 1e-3).all()


def test_only_the_strongest_matches_are_drawn(
    source: np.ndarray, target: np.ndarray, result: RegistrationResult
) -> None:
    many = Matches(source[:300], target[:300], np.arange(1, 301) / 45_150)
    figure = draw_result(source, target, replace(result, matches=many), "")
    assert len(lines_of(figure).get_segments()) == MATCHES
    assert f"the {MATCHES} strongest of 300" in figure.axes[1].get_title()


def test_without_matches_there_is_no_scale_of_weights(
    source: np.ndarray, target: np.ndarray, result: RegistrationResult
) -> None:
    none = replace(result, matches=Matches(source[:3], target[:3], np.zeros(3)))
    assert len(draw_result(source, target, none, "").axes) == 3


def test_large_clouds_are_thinned(result: RegistrationResult) -> None:
    large = bumpy(POINTS + 5000)
    assert POINTS < len(points_of(draw_result(large, large, result, ""), 0)) <= 2 * POINTS


def test_clouds_far_apart_are_drawn_closer_and_the_picture_says_so(
    source: np.ndarray, target: np.ndarray, result: RegistrationResult
) -> None:
    away = result.transformation.copy()
    away[:3, 3] += FAR
    figure = draw_result(source, target + FAR, replace(result, transformation=away), "")
    assert "5.427e+06 apart" in figure.axes[0].get_title()
    assert np.ptp(points_of(figure, 0), axis=0).max() < 10
    assert draw_result(source, target, result, "").axes[0].get_title() == "before"


def test_title_says_how_sure_it_is_and_why(result: RegistrationResult) -> None:
    assert heading(result, "a.ply", "b.ply") == "a.ply onto b.ply: confidence 87 %"
    unsure = replace(result, reason="overlap about 5 %", confidence=0.0)
    assert heading(unsure, "a.ply", "b.ply") == "a.ply onto b.ply: confidence < 1 %\noverlap about 5 %"
    assert len(heading(result, "a" * 300, "b" * 300)) < 120


@pytest.mark.parametrize("name", ["$x_1$ 100 %.ply", "点 Größe.ply", "scan\udcff.ply", "a\nb.ply"])
@pytest.mark.parametrize("suffix", ["png", "svg"])
def test_any_name_can_be_shown(
    tmp_path: Path, source: np.ndarray, target: np.ndarray, result: RegistrationResult, name: str, suffix: str
) -> None:
    path = tmp_path / f"look.{suffix}"
    write_plot(path, PointCloud(source), PointCloud(target), result, source_name=name, target_name=name)
    if suffix == "svg":
        ET.parse(path)


def test_same_input_gives_the_same_bytes(
    tmp_path: Path, source: np.ndarray, target: np.ndarray, result: RegistrationResult
) -> None:
    for suffix in ("png", "svg"):
        paths = [tmp_path / f"{name}.{suffix}" for name in "ab"]
        for path in paths:
            write_plot(path, PointCloud(source), PointCloud(target), result, source_name="a", target_name="b")
        assert paths[0].read_bytes() == paths[1].read_bytes()
        assert len(paths[0].read_bytes()) < 1_000_000


def test_what_cannot_be_written_leaves_nothing(
    tmp_path: Path, source: np.ndarray, target: np.ndarray, result: RegistrationResult
) -> None:
    path = tmp_path / "missing" / "a.png"
    with pytest.raises(InputError, match="no folder"):
        write_plot(path, PointCloud(source), PointCloud(target), result, source_name="a", target_name="b")
    assert list(tmp_path.iterdir()) == []


def test_pictures_need_no_torch_and_no_scipy() -> None:
    code = "import sys, idam.report.plot; print(*sorted({'torch', 'scipy', 'idam.lab'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=True)
    assert done.stdout == "\n"
