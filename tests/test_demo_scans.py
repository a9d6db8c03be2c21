"""The shipped demo scans and the script that makes them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from idam.clouds.surfaces import Surface, spacing_of
from idam.io import read_point_cloud

ROOT = Path(__file__).resolve().parents[1]
SHIPPED = ROOT / "src" / "idam" / "demo"
TRUTH = ROOT / "src" / "idam" / "lab" / "data" / "demo" / "truth.txt"
SCANS = ("source.ply", "target.ply")


@pytest.fixture(scope="module")
def truth() -> np.ndarray:
    return np.loadtxt(TRUTH)


def read(name: str) -> np.ndarray:
    return read_point_cloud(SHIPPED / name).points


def share_near(points: np.ndarray, others: np.ndarray) -> float:
    return float(np.mean(Surface.of(others).nearest(points)[0] < 1.5 * spacing_of(others)))


@pytest.mark.parametrize("name", SCANS)
def test_scan_is_small_enough_to_ship(name: str) -> None:
    assert (SHIPPED / name).stat().st_size <= 200_000
    assert 8_000 <= len(read(name)) <= 15_000


@pytest.mark.parametrize("name", SCANS)
def test_scan_is_in_metres_in_front_of_its_camera(name: str) -> None:
    points = read(name)
    assert np.isfinite(points).all()
    assert points[:, 2].min() > 0.5
    assert points[:, 2].max() < 1.2
    assert 0.002 < spacing_of(points) < 0.004


def test_truth_is_rigid(truth: np.ndarray) -> None:
    assert truth.shape == (4, 4)
    np.testing.assert_array_equal(truth[3], [0, 0, 0, 1])
    np.testing.assert_allclose(truth[:3, :3] @ truth[:3, :3].T, np.eye(3), atol=1e-9)
    assert np.linalg.det(truth[:3, :3]) == pytest.approx(1.0)


def test_truth_is_far_from_identity(truth: np.ndarray) -> None:
    angle = np.degrees(np.arccos((np.trace(truth[:3, :3]) - 1) / 2))
    assert 55 < angle < 65
    assert np.linalg.norm(truth[:3, 3]) > 0.5


def test_half_of_each_scan_is_in_the_other_under_the_truth(truth: np.ndarray) -> None:
    source, target = map(read, SCANS)
    moved = source @ truth[:3, :3].T + truth[:3, 3]
    assert 0.45 < share_near(moved, target) < 0.60
    assert 0.45 < share_near(target, moved) < 0.65


def test_scans_do_not_overlap_before_registration() -> None:
    source, target = map(read, SCANS)
    centred = source - source.mean(axis=0) + target.mean(axis=0)
    assert share_near(source, target) < 0.4
    assert share_near(centred, target) < 0.4


def test_script_makes_the_shipped_files_again(tmp_path: Path) -> None:
    pytest.importorskip("trimesh")
    script = ROOT / "examples" / "make_demo_scans.py"
    printed = subprocess.run(
        [sys.executable, script, tmp_path], check=True, capture_output=True, text=True, timeout=120
    ).stdout
    assert "overlap 0.5" in printed
    for path in (*(SHIPPED / name for name in SCANS), TRUTH):
        assert (tmp_path / path.name).read_bytes() == path.read_bytes(), path.name
