"""Processes that die, hang and are interrupted, and what is left then."""

from __future__ import annotations

import contextlib
import os
import random
import signal
import subprocess
import sys
import time
from multiprocessing import active_children
from pathlib import Path

import pytest

from cheap import ENVIRONMENT, Named, Threads, settled
from idam.batch import local
from idam.batch.ledger import read_run
from idam.batch.pairs import Pair, as_pairs, by_scan
from idam.batch.rows import Row
from killing import alive, count, descendants, processes, start, until


def pairs_in(folder: Path, names: list[str]) -> list[Pair]:
    """A pair for each name, in a folder of its own to leave marks in."""
    return by_scan(as_pairs([{"source": str(folder / name), "target": "t", "id": name} for name in names]))


def rows(folder: Path, names: list[str], jobs: int = 2, limit: float = 60.0) -> dict[str, Row]:
    return settled(list(local.run(pairs_in(folder, names), Named, jobs, limit)))


def test_the_same_rows_from_any_number_of_processes(tmp_path: Path) -> None:
    names = [f"{i}" for i in range(60)] + ["bad"]
    expected = settled([Named()(pair) for pair in pairs_in(tmp_path, names)])
    assert rows(tmp_path, names, jobs=1) == rows(tmp_path, names, jobs=3) == expected
    assert rows(tmp_path, names[:1], jobs=9) == {"0": expected["0"]}
    assert list(local.run([], Named, 2)) == []


def test_a_process_that_dies_costs_its_pair_one_more_try(tmp_path: Path) -> None:
    names = ["once-a", *(f"{i}" for i in range(20)), "die", "once-b"]
    found = rows(tmp_path, names)
    assert sorted(found) == sorted(names)
    assert [name for name in names if found[name]["status"] == "failed"] == ["die"]
    assert found["die"]["error"] == "its process died 2 times (killed: most often by the system, when memory runs out)"


def test_a_pair_that_never_ends_is_stopped(tmp_path: Path) -> None:
    started = time.monotonic()
    found = rows(tmp_path, ["hang", "0", "1", "2"], limit=0.5)
    assert time.monotonic() - started < 60
    assert found["hang"]["error"] == "took longer than the limit of 0.5 s"
    assert [found[name]["status"] for name in "012"] == ["ok"] * 3


def test_a_process_has_one_thread(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    (row,) = local.run(as_pairs([("a", "b")]), Threads, 1)
    assert row["reason"] == "1"
    assert os.environ["OMP_NUM_THREADS"] == "7"
    assert "OPENBLAS_NUM_THREADS" not in os.environ


def test_leaving_early_leaves_no_process(tmp_path: Path) -> None:
    found = local.run(pairs_in(tmp_path, ["0", "hang", "hang2"]), Named, 3)
    next(found)
    assert len(active_children()) == 3
    found.close()
    assert not active_children()


UNGUARDED = """
from idam.batch import local
from idam.batch.pairs import as_pairs
from cheap import Cheap
print(len(list(local.run(as_pairs([("a", "b")]), Cheap, 1))))
"""


def test_a_script_without_guard_is_told(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(UNGUARDED)
    done = subprocess.run([sys.executable, script], env=ENVIRONMENT, capture_output=True, text=True, check=False)
    assert done.returncode
    assert done.stderr.splitlines()[-1].startswith("idam.errors.InputError: worker processes die before they begin")
    assert "if __name__ == '__main__':" in done.stderr.splitlines()[-1]


@pytest.fixture
def listed(tmp_path: Path) -> Path:
    """A list of a few hundred pairs, some of which fail."""
    kinds = ["bad", "slow", "scan", "scan", "scan"]
    names = [f"{kinds[i % 5]}{i:03} scan{(i * 7) % 100:03}" for i in range(300)]
    (tmp_path / "pairs.txt").write_text("\n".join(names))
    return tmp_path / "pairs.txt"


def interrupted(process: subprocess.Popen[bytes], chance: random.Random) -> bool:
    """Whether a batch was killed: the main process, or a worker first and the main process after it."""
    until(lambda: process.poll() is not None or len(descendants(process.pid)) >= 3)
    time.sleep(chance.uniform(0.0, 0.8))
    if process.poll() is not None:
        return False
    workers = descendants(process.pid)
    if chance.random() < 0.5:
        with contextlib.suppress(ProcessLookupError):
            os.kill(chance.choice(workers), signal.SIGKILL)
        time.sleep(chance.uniform(0.0, 0.3))
    process.kill()
    process.wait()
    assert until(lambda: not alive(workers)), "workers outlive the main process"
    return True


@processes
def test_killed_at_any_moment_nothing_is_lost_or_doubled(tmp_path: Path, listed: Path) -> None:
    chance = random.Random(0)
    assert start(listed, tmp_path / "calm", "--jobs", "1").wait(60) == 0
    kills = 0
    while kills < 5 and interrupted(start(listed, tmp_path / "killed"), chance):
        kills += 1
    assert kills >= 2
    assert start(listed, tmp_path / "killed").wait(60) == 0, (tmp_path / "killed.log").read_text()
    assert settled(read_run(tmp_path / "killed")[0]) == settled(read_run(tmp_path / "calm")[0])
    assert count(tmp_path / "killed") == count(tmp_path / "calm") == 300


@processes
def test_shards_share_a_folder(tmp_path: Path, listed: Path) -> None:
    both = [start(listed, tmp_path / "run", "--shard", str(part), "2", "--jobs", "1") for part in (1, 2)]
    assert [process.wait(60) for process in both] == [0, 0]
    assert start(listed, tmp_path / "alone").wait(60) == 0
    assert settled(read_run(tmp_path / "run")[0]) == settled(read_run(tmp_path / "alone")[0])
    assert count(tmp_path / "run") == 300
