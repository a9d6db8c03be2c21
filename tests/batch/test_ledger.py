"""What is kept of a batch, whenever it is stopped."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from cheap import ENVIRONMENT, Cheap
from idam.batch.ledger import Ledger, read_run
from idam.batch.pairs import Pair, as_pairs
from idam.batch.rows import failed_row
from idam.errors import InputError

JOB = {"model": "default", "refine": "gicp"}


@pytest.fixture
def pairs() -> list[Pair]:
    return as_pairs([(f"a{i}", f"b{i}") for i in range(10)])


def rows_of(folder: Path, name: str = "1-of-1") -> Path:
    return folder / "rows" / f"{name}.jsonl"


def test_goes_on_where_it_was(tmp_path: Path, pairs: list[Pair]) -> None:
    with Ledger(tmp_path, JOB, pairs) as ledger:
        assert ledger.todo() == pairs
        for pair in pairs[:3]:
            ledger.append(Cheap()(pair))
        ledger.append(Cheap()(pairs[0]))  # made twice
        ledger.append(failed_row(pairs[3], "x.ply: is\nempty", 0.5))
        assert ledger.todo() == pairs[4:]
    with Ledger(tmp_path, JOB, pairs) as ledger:
        assert ledger.todo() == pairs[4:]
        assert ledger.todo(retry_failed=True) == pairs[3:]
        ledger.append(Cheap()(pairs[3]))
        assert ledger.todo(retry_failed=True) == pairs[4:]
    assert len(rows_of(tmp_path).read_text().splitlines()) == 5
    rows, missing = read_run(tmp_path)
    assert [row["id"] for row in rows] == [pair.id for pair in pairs[:4]]
    assert {row["status"] for row in rows} == {"ok"}
    assert missing == 6


def test_a_good_row_stands_against_a_failed_one_of_any_shard(tmp_path: Path, pairs: list[Pair]) -> None:
    for shard, row in ((1, 1), Cheap()(pairs[0])), ((1, 2), failed_row(pairs[0], "worse", 0.0)):
        with Ledger(tmp_path, JOB, pairs, shard) as ledger:
            ledger.append(row)
    assert [row["status"] for row in read_run(tmp_path)[0]] == ["ok"]


def test_a_line_cut_at_any_byte_is_dropped(tmp_path: Path, pairs: list[Pair]) -> None:
    with Ledger(tmp_path, JOB, pairs) as ledger:
        for pair in pairs[:3]:
            ledger.append(Cheap()(pair))
    whole = rows_of(tmp_path).read_bytes()
    lines = whole.splitlines(keepends=True)
    for cut in {*range(0, len(lines[2]), 97), 1, len(lines[2]) - 1}:
        rows_of(tmp_path).write_bytes(whole[: len(lines[0] + lines[1]) + cut])
        assert len(read_run(tmp_path)[0]) == 2  # while another process may still be writing it
        with Ledger(tmp_path, JOB, pairs) as ledger:
            assert ledger.todo() == pairs[2:]
            ledger.append(Cheap()(pairs[2]))
        assert [json.loads(line)["id"] for line in rows_of(tmp_path).read_text().splitlines()] == [
            pair.id for pair in pairs[:3]
        ]


def test_a_damaged_line_is_named(tmp_path: Path, pairs: list[Pair]) -> None:
    Ledger(tmp_path, JOB, pairs).__exit__(None, None, None)
    rows_of(tmp_path).write_text('{"id": "a0 b0", "status": "ok"}\n{"id"\n')
    with pytest.raises(InputError, match=r"1-of-1.jsonl, line 2: damaged"):
        read_run(tmp_path)


def test_another_job_is_refused(tmp_path: Path, pairs: list[Pair]) -> None:
    with Ledger(tmp_path, JOB, pairs):
        pass
    with pytest.raises(InputError, match=r"holds another job .refine gicp, not plane.: choose another folder"):
        Ledger(tmp_path, JOB | {"refine": "plane"}, pairs)
    with pytest.raises(InputError, match=r"holds another job .other pairs.: choose another folder"):
        Ledger(tmp_path, JOB, pairs[:-1])
    with pytest.raises(InputError, match=r"holds another job .seed None, not 3."):
        Ledger(tmp_path, JOB | {"seed": 3}, pairs)


def test_one_process_a_shard(tmp_path: Path, pairs: list[Pair]) -> None:
    with Ledger(tmp_path, JOB, pairs, (1, 2)) as one, Ledger(tmp_path, JOB, pairs, (2, 2)) as two:
        assert sorted(pair.id for pair in [*one.todo(), *two.todo()]) == sorted(pair.id for pair in pairs)
        with pytest.raises(InputError, match="another process is at this shard"):
            Ledger(tmp_path, JOB, pairs, (2, 2))
    with Ledger(tmp_path, JOB, pairs, (2, 2)):
        pass


def test_a_folder_without_a_batch(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is not the folder of a batch"):
        read_run(tmp_path)


FULL = """
import resource, sys
from cheap import Cheap
from idam.batch.ledger import Ledger
from idam.batch.pairs import as_pairs
pairs = as_pairs([(f"a{i}", f"b{i}") for i in range(10)])
with Ledger(sys.argv[1], {"model": "default", "refine": "gicp"}, pairs) as ledger:
    ledger.append(Cheap()(pairs[0]))
    size = ledger._path.stat().st_size
    resource.setrlimit(resource.RLIMIT_FSIZE, (size + 100, size + 100))
    ledger.append(Cheap()(pairs[1]))
"""


@pytest.mark.skipif(sys.platform == "win32", reason="no limit on the size of files there")
def test_a_full_disk_leaves_whole_rows(tmp_path: Path, pairs: list[Pair]) -> None:
    command = [sys.executable, "-c", FULL, str(tmp_path)]
    done = subprocess.run(command, env=ENVIRONMENT, capture_output=True, text=True, timeout=60, check=False)
    assert "InputError" in done.stderr
    assert "make room, and run the same command to go on" in done.stderr
    assert len(rows_of(tmp_path).read_text().splitlines()) == 1
    assert rows_of(tmp_path).read_text().endswith("\n")
    with Ledger(tmp_path, JOB, pairs) as ledger:
        assert ledger.todo() == pairs[1:]
