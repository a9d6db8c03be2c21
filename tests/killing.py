"""Processes of a batch of cheap work, to look at and to kill."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from cheap import ENVIRONMENT

processes = pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs /proc to see the processes of a batch")


def descendants(process: int) -> list[int]:
    """All processes below one."""
    found = []
    for task in Path(f"/proc/{process}/task").glob("*/children"):
        try:
            children = [int(child) for child in task.read_text().split()]
        except OSError:
            continue
        found += [*children, *(below for child in children for below in descendants(child))]
    return found


def alive(ids: list[int]) -> list[int]:
    """Those of some processes that still run."""

    def state(process: int) -> str:
        try:
            return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
        except OSError:
            return "X"

    return [process for process in ids if state(process) not in "XZ"]


def until(condition: Callable[[], bool], seconds: float = 30.0) -> bool:
    """Whether something comes true in time."""
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        time.sleep(0.01)
    return condition()


def start(pairs: Path, folder: Path, *args: str) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-c", "import cheap; cheap.main()", str(pairs), str(folder), *args]
    with folder.with_suffix(".log").open("a") as log:
        return subprocess.Popen(command, env=ENVIRONMENT, stderr=log, start_new_session=True)


def count(folder: Path) -> int:
    return sum(len(file.read_bytes().splitlines()) for file in folder.glob("rows/*.jsonl"))
