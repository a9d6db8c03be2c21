"""What is kept between calls, damaged, and options of any kind: used, or refused in one line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from safetensors.numpy import load, save

import fuzzing
import idam
from fuzzing import check_refusal, damaged, examples, limits, needs_proc, read_or_refuse
from idam.batch.ledger import Ledger, read_run
from idam.batch.pairs import as_pairs, read_pairs
from idam.errors import InputError
from idam.many.files import read_poses
from idam.many.pairs import Kept

figures = fuzzing.figures
pytestmark = needs_proc


def scan(count: int = 150) -> np.ndarray:
    random = np.random.default_rng(0)
    points = random.normal(size=(count, 3)) * [1.0, 0.6, 0.3]
    return points + np.maximum(points, 0) * 0.4


SCAN = scan()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("kept")


# --- prepared clouds -------------------------------------------------------------------------------------------------


def saved(folder: Path) -> bytes:
    path = folder / "whole.idam"
    if not path.exists():
        idam.prepare(SCAN).save(path)
    return path.read_bytes()


def use(path: Path) -> Any:
    """A prepared cloud read, and registered."""
    result = idam.register(path, SCAN, refine="none")
    assert np.isfinite(result.transformation).all()
    return result


def test_damaged_prepared_clouds(folder: Path) -> None:
    valid = saved(folder)
    assert read_or_refuse(folder / "a.idam", valid, use) is not None

    @examples(40)
    @given(damaged(valid))
    def check(data: bytes) -> None:
        read_or_refuse(folder / "a.idam", data, idam.Prepared.load)

    check()


CHANGES = {
    "empty": lambda array: array[:0],
    "one row": lambda array: array[:1],
    "a row less": lambda array: array[:-1],
    "on its side": lambda array: array.T,
    "flat": np.ravel,
    "deeper": lambda array: array[None],
    "twice": lambda array: np.repeat(array, 2, axis=0),
    "NaN": lambda array: array * np.nan,
    "zero": lambda array: array * 0,
    "huge": lambda array: array.astype(np.float64) * 1e300,
    "half": lambda array: array.astype(np.float16),
    "whole": lambda array: np.sign(array).astype(np.int8),
}
VALUES = [None, -1, 0, 1, 1e308, float("nan"), "x", [], [0.1], {"a": 1}, ["x"] * 3]
ABOUT = ["format", "name", "radius", "sizes"]


def spoiled(data: bytes, changes: list[tuple[int, str]], abouts: list[tuple[str, Any]]) -> bytes:
    """A whole file that holds something else under a name or two."""
    arrays = load(data)
    header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
    metadata = header["__metadata__"]
    about = json.loads(metadata["idam"]) | dict(abouts)
    for place, change in changes:
        name = sorted(arrays)[place % len(arrays)]
        with np.errstate(all="ignore"):
            arrays[name] = np.ascontiguousarray(CHANGES[change](arrays[name]))
    return bytes(save(arrays, {**metadata, "idam": json.dumps(about)}))


def test_prepared_clouds_that_hold_something_else(folder: Path) -> None:
    valid = saved(folder)

    @examples(60)
    @given(
        st.lists(st.tuples(st.integers(0, 9), st.sampled_from([*CHANGES])), max_size=2),
        st.lists(st.tuples(st.sampled_from(ABOUT), st.sampled_from(VALUES)), max_size=1),
    )
    def check(changes: list[tuple[int, str]], abouts: list[tuple[str, Any]]) -> None:
        read_or_refuse(folder / "b.idam", spoiled(valid, changes, abouts), use)

    check()


# --- batches and merges ----------------------------------------------------------------------------------------------

PAIRS = [("a.ply", "b.ply"), ("b.ply", "c.ply"), ("a.ply", "c.ply")]
JOB = {"idam": "0", "weights": "x", "max_angle": 180.0}


def batch(run: Path) -> Path:
    with Ledger(run, JOB, as_pairs(PAIRS)) as ledger:
        for pair, status in zip(as_pairs(PAIRS), ("ok", "failed"), strict=False):
            ledger.append({"id": pair.id, "status": status, "error": "", "confidence": 0.5})
    return run


@pytest.mark.parametrize("name", ["manifest.json", "pairs.jsonl", "rows/1-of-1.jsonl"])
def test_damaged_batches(folder: Path, name: str) -> None:
    run = batch(folder / name.replace("/", "-"))
    whole = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}

    def go_on(path: Path) -> Any:
        rows, missing = read_run(run)
        with Ledger(run, JOB, as_pairs(PAIRS)) as ledger:
            ledger.todo()
        return len(rows), missing

    @examples(40)
    @given(damaged(whole[run / name]))
    def check(data: bytes) -> None:
        for path, content in whole.items():
            path.write_bytes(content)
        (run / name).write_bytes(data)
        with limits():
            try:
                go_on(run)
            except InputError as error:
                check_refusal(error, run)

    check()


ROW = {"error": "", "transformation": np.eye(4).tolist(), "information": np.eye(6).tolist(), "reach": 0.1}
ROWS = "".join(json.dumps({"key": f"{n}", **ROW, "confidence": 0.5}) + "\n" for n in range(4))


@examples(60)
@given(damaged(ROWS.encode()))
def test_damaged_pairs_of_a_merge(folder: Path, data: bytes) -> None:
    def keep(path: Path) -> Any:
        kept = Kept(path)
        for row in kept.rows.values():
            assert row["error"] or np.isfinite(np.array(row["transformation"], float)).all()
        kept.add("new", {**ROW, "confidence": 0.5})
        assert "new" in Kept(path).rows
        return kept

    read_or_refuse(folder / "kept.jsonl", data, keep)


TABLES = {
    "pairs.csv": b"source,target,id,max_angle,voxel_size\na.ply,b.ply,1,30,0.5\nb.ply,c.ply,2,,\n",
    "pairs.jsonl": b'{"source": "a.ply", "target": "b.ply", "max_angle": 30}\n{"source": "b.ply", "target": "c.ply"}\n',
    "pairs.txt": b"a.ply b.ply\n# all\nb.ply c.ply\n",
}


@pytest.mark.parametrize("name", TABLES)
def test_damaged_tables_of_pairs(folder: Path, name: str) -> None:
    @examples(60)
    @given(damaged(TABLES[name]))
    def check(data: bytes) -> None:
        read_or_refuse(folder / f"table-{name}", data, read_pairs)

    check()


POSES = json.dumps(
    {"a.ply": {"matrix": np.eye(4).tolist(), "component": 0}, "b.ply": np.eye(4).tolist(), "c": None}
).encode()


@examples(60)
@given(damaged(POSES))
def test_damaged_poses(folder: Path, data: bytes) -> None:
    read_or_refuse(folder / "poses.json", data, read_poses)


# --- options ---------------------------------------------------------------------------------------------------------

NUMBERS = (
    st.integers() | st.floats() | st.sampled_from([0, 1, 180, 90.0, 1e-300, 1e300, np.float32(3), np.int8(2), np.nan])
)
ANYTHING = (
    NUMBERS
    | st.none()
    | st.booleans()
    | st.text(max_size=5)
    | st.binary(max_size=3)
    | st.lists(st.floats(), max_size=4)
    | st.sampled_from(
        [
            "gicp",
            "none",
            "default",
            "gnn-",
            "a/b",
            "..",
            ".",
            "/",
            "cuda",
            "default+default",
            np.eye(4),
            np.eye(3),
            [[1]],
        ]
    )
)
OPTIONS = ("model", "init", "max_angle", "voxel_size", "max_correspondence_distance", "refine", "seed", "device")


@examples(60)
@given(st.dictionaries(st.sampled_from(OPTIONS), ANYTHING, min_size=1, max_size=2))
def test_options_of_any_kind(options: dict[str, Any]) -> None:
    with limits():
        try:
            result = idam.register(SCAN, SCAN, **{"refine": "none", **options})
        except idam.MissingDependencyError:
            return
        except InputError as error:
            check_refusal(error)
            return
    assert np.isfinite(result.transformation).all() and 0 <= result.confidence <= 1


@examples(60)
@given(
    st.lists(
        st.sampled_from([*OPTIONS, "x", ""]).flatmap(
            lambda name: st.text(max_size=6).map(lambda text: f"{name}={text}")
        ),
        max_size=3,
    )
)
def test_settings_of_a_batch(settings: list[str]) -> None:
    from idam.batch.options import check_options, parse_options

    with limits():
        try:
            check_options(parse_options(settings))
        except idam.MissingDependencyError:
            return
        except InputError as error:
            check_refusal(error)
