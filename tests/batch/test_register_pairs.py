"""Pairs registered from Python, and the rows of them."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import idam
import idam.rigid
from idam.batch.pairs import as_pairs, by_scan
from idam.batch.rows import COLUMNS, Row
from idam.batch.work import KEPT, Register
from idam.errors import InputError


@pytest.fixture(scope="module")
def clouds() -> list[np.ndarray]:
    """Three views of one lopsided ellipsoid."""
    random = np.random.default_rng(0)
    shape = random.normal(size=(300, 3))
    shape /= np.linalg.norm(shape, axis=1, keepdims=True)
    shape = shape * [1.0, 0.6, 0.3] + np.maximum(shape, 0) * 0.4
    turns = [idam.rigid.rotation_exp(vector) for vector in random.normal(size=(3, 3))]
    return [shape[random.permutation(300)[:200]] @ turn.T + random.normal(size=3) for turn in turns]


@pytest.fixture(scope="module")
def folder(clouds: list[np.ndarray], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The views as files, and broken ones."""
    folder = tmp_path_factory.mktemp("clouds")
    for number, cloud in enumerate(clouds):
        np.save(folder / f"{number}.npy", cloud)
    (folder / "empty.ply").touch()
    (folder / "few.xyz").write_text("0 0 0\n1 1 1\n")
    return folder


def without_time(row: Row) -> Row:
    return row | {"seconds": None}


def test_rows_are_what_register_says(folder: Path, clouds: list[np.ndarray]) -> None:
    names = [(str(folder / "0.npy"), str(folder / "1.npy")), (str(folder / "2.npy"), str(folder / "1.npy"))]
    rows = {row["id"]: row for row in idam.register_pairs(names, jobs=2, refine="plane")}
    assert sorted(rows) == [f"{source} {target}" for source, target in names]
    for source, target in names:
        row, result = rows[f"{source} {target}"], idam.register(source, target, refine="plane")
        assert list(row) == list(COLUMNS)
        assert (row["source"], row["target"], row["status"], row["error"]) == (source, target, "ok", None)
        for name in ("transformation", "information"):
            assert np.array_equal(row[name], getattr(result, name))
        for name in ("confidence", "converged", "reason", "fitness", "inlier_rmse"):
            assert row[name] == getattr(result, name)
        assert 0 < row["seconds"] < 100
        assert json.loads(json.dumps(row)) == row
    in_memory = [(clouds[0], clouds[1]), (clouds[2], clouds[1])]
    other = {row["id"]: row for row in idam.register_pairs(in_memory, jobs=1, refine="plane")}
    for number, (source, target) in enumerate(names):
        assert other[str(number)]["source"] is None
        assert other[str(number)]["transformation"] == rows[f"{source} {target}"]["transformation"]


FAULTS = {
    "empty.ply": "is empty",
    "missing.ply": "no such file",
    "few.xyz": "2 points",
    "notes.doc": "unknown point cloud format",
}


def test_what_is_wrong_with_a_pair_is_its_row(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    work = Register({})
    given = [*((name, "0.npy") for name in FAULTS), ("0.npy", "1.npy")]
    rows = {row["source"]: row for row in map(work, by_scan(as_pairs(given)))}
    assert rows.pop("0.npy")["status"] == "ok"
    for row in rows.values():
        assert row["status"] == "failed"
        assert FAULTS[row["source"]] in row["error"]
        assert "\n" not in row["error"]
        assert row["transformation"] is row["confidence"] is row["converged"] is None


def test_a_pair_has_options_of_its_own(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    work = Register({"max_angle": 180.0})
    (folder / "bad.txt").write_text("1 2 3")
    base = {"source": "0.npy", "target": "1.npy"}
    told = idam.register("0.npy", "1.npy", max_angle=5.0)
    own = [
        {"max_angle": 5.0},
        {"max_angle": 500.0},
        {"voxel_size": -1.0},
        {"init": "bad.txt"},
        {"init": np.zeros((4, 4))},
    ]
    pairs = as_pairs([base | options | {"id": number} for number, options in enumerate(own)])
    ok, *failed = [work(pair) for pair in by_scan(pairs)]
    assert np.array_equal(ok["transformation"], told.transformation)
    messages = ["max_angle must be", "voxel_size must be", "bad.txt: holds no 4 x 4", "init is not a rigid transform"]
    for row, message in zip(failed, messages, strict=True):
        assert message in row["error"]


def test_whatever_register_raises_is_a_row(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*args: Any, **options: Any) -> None:
        raise ZeroDivisionError("float division\nby zero")

    monkeypatch.setattr("idam.registration.register", broken)
    (pair,) = as_pairs([(folder / "0.npy", folder / "1.npy")])
    assert Register({})(pair)["error"] == "ZeroDivisionError: float division by zero"


def test_a_scan_is_read_once_for_pairs_that_follow_one_another(
    folder: Path, monkeypatch: pytest.MonkeyPatch, counting: Callable[[str], list[Any]]
) -> None:
    read = counting("idam.registration.prepare")
    monkeypatch.setattr("idam.registration.register", lambda *args, **options: 1 / 0)
    work = Register({})
    star = [(folder / "0.npy", folder / f"{i % 3}.npy") for i in range(9)]
    pairs = as_pairs([{"source": source, "target": target, "id": i} for i, (source, target) in enumerate(star)])
    for pair in by_scan(pairs):
        work(pair)
    assert len(read) == 3
    cloud = np.load(folder / "0.npy")
    many = as_pairs([(cloud.copy(), cloud.copy()) for _ in range(KEPT)])
    for pair in by_scan(many):
        work(pair)
    assert len(work._scans) == KEPT
    monkeypatch.setattr("idam.batch.work.KEPT_POINTS", 5 * len(cloud))
    work(by_scan(many)[0])
    assert len(work._scans) == 5


@pytest.fixture
def counting(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], list[Any]]:
    """Counts calls of a function, which goes on doing what it does."""

    def count(name: str) -> list[Any]:
        module, _, function = name.rpartition(".")
        calls: list[Any] = []
        original = getattr(__import__(module, fromlist=[function]), function)

        def counted(*args: Any, **options: Any) -> Any:
            calls.append(args)
            return original(*args, **options)

        monkeypatch.setattr(name, counted)
        return calls

    return count


WRONG = [
    ({"refine": "grind"}, "unknown refinement 'grind'"),
    ({"speed": 3}, "unknown option 'speed': the ones for all pairs are model"),
    ({"init": np.eye(4)}, "unknown option 'init'"),
    ({"model": "huge"}, "unknown model 'huge'"),
    ({"jobs": 0}, "jobs and time_limit must be positive"),
    ({"time_limit": 0.0}, "jobs and time_limit must be positive"),
]


@pytest.mark.parametrize(("options", "message"), WRONG, ids=[message for _, message in WRONG])
def test_wrong_options_are_refused_before_any_pair(options: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        idam.register_pairs([("missing.ply", "missing.xyz")], **options)
