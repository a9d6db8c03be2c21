"""Real scans, for research only: they stay outside the repository."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest

import idam
from idam.io import read_point_cloud
from motions import degrees

BESIDE = Path(__file__).resolve().parents[2] / "shared" / "scans"


@pytest.fixture
def scans() -> Path:
    folder = Path(os.environ.get("IDAM_SCANS") or BESIDE)
    if not (folder / "bunny" / "pairs.json").is_file():
        pytest.skip(f"no scans at {folder}: set IDAM_SCANS to the folder that holds bunny/pairs.json")
    return folder


def test_bunny_comes_out_right_with_no_option_given(scans: Path) -> None:
    folder = scans / "bunny"
    description = json.loads((folder / "pairs.json").read_text())
    pair = next(p for p in description["pairs"] if (p["source"], p["target"]) == ("bun045.ply", "bun000.ply"))
    truth = np.array(pair["transformation"])
    centre = read_point_cloud(folder / pair["source"]).points.mean(0)
    result = idam.register(folder / pair["source"], folder / pair["target"])
    assert degrees(result.transformation, truth) < 5.0
    assert np.linalg.norm(result.apply(centre) - (truth[:3, :3] @ centre + truth[:3, 3])) < 0.01
