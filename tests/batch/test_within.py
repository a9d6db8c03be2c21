"""Pairs among the scans of a folder."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from idam import rigid
from idam.batch.within import pairs_within
from idam.errors import InputError


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three views each of four lopsided ellipsoids, a broken file, and one that is no scan."""
    random = np.random.default_rng(0)
    for shape in range(4):
        points = random.normal(size=(400, 3))
        points /= np.linalg.norm(points, axis=1, keepdims=True)
        points = points * random.uniform(0.3, 1.0, 3) + np.maximum(points @ random.normal(size=(3, 3)), 0) * 0.3
        for view in range(3):
            seen = points[random.permutation(400)[:300]]
            np.save(tmp_path / f"{view}_of_{shape}.npy", rigid.apply(rigid.exp(random.normal(size=6)), seen))
    (tmp_path / "broken.ply").write_text("ply\n")
    (tmp_path / "README.md").touch()
    return tmp_path


def test_all_pairs_of_a_few(folder: Path) -> None:
    names = sorted(file.name for file in folder.iterdir() if file.name != "README.md")
    pairs = pairs_within(folder)
    assert [(pair.source, pair.target) for pair in pairs] == list(combinations(names, 2))
    assert pairs[0].path(pairs[0].source) == str(folder / names[0])


def test_partners_show_the_same_object(folder: Path) -> None:
    pairs = [(pair.source, pair.target) for pair in pairs_within(folder, partners=2)]
    whole = [pair for pair in pairs if "broken.ply" not in pair]
    assert len(whole) == 4 * 3
    assert all(source.partition("_of_")[2] == target.partition("_of_")[2] for source, target in whole)
    assert len(pairs) - len(whole) == 1  # a row that says what is wrong with it


def test_two_scans_are_the_least(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        pairs_within(tmp_path / "none")
    (tmp_path / "one.ply").touch()
    with pytest.raises(InputError, match="1 scans in it: two or more are needed"):
        pairs_within(tmp_path)
    (tmp_path / "two.ply").touch()
    assert len(pairs_within(tmp_path, partners=3)) == 2
