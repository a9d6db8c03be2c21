"""A batch on a Ray cluster."""

from __future__ import annotations

import os
import signal
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from cheap import Cheap, settled
from idam.batch import distributed
from idam.batch.ledger import read_run
from idam.batch.pairs import as_pairs
from idam.errors import MissingDependencyError
from killing import count, descendants, processes, start, until

needs_ray = pytest.mark.skipif(find_spec("ray") is None, reason="needs Ray: pip install 'idam[ray]'")


def actors(process: int) -> list[int]:
    """Processes of a batch that hold Ray's actors."""

    def title(process: int) -> bytes:
        try:
            return Path(f"/proc/{process}/cmdline").read_bytes()
        except OSError:
            return b""

    return [below for below in descendants(process) if title(below).startswith(b"ray::MapWorker")]


@needs_ray
@processes
@pytest.mark.timeout(700)  # Ray takes long to start on a busy machine
def test_an_actor_that_dies_loses_and_doubles_nothing(tmp_path: Path) -> None:
    pairs = tmp_path / "pairs.txt"
    kinds = ["bad", "slow", "slow", "slow", "scan"]
    pairs.write_text("\n".join(f"{kinds[i % 5]}{i:03} scan{i * 7 % 50:03}" for i in range(600)))
    assert start(pairs, tmp_path / "calm").wait(60) == 0
    process = start(pairs, tmp_path / "ray", "--engine", "distributed")
    assert until(lambda: len(actors(process.pid)) == 2 and 0 < count(tmp_path / "ray") < 500, 300)
    os.kill(actors(process.pid)[0], signal.SIGKILL)
    assert process.wait(300) == 0, (tmp_path / "ray.log").read_text()
    assert settled(read_run(tmp_path / "ray")[0]) == settled(read_run(tmp_path / "calm")[0])
    assert count(tmp_path / "ray") == 600


def test_without_ray_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'idam\[ray\]'"):
        next(distributed.run(as_pairs([("a", "b")]), Cheap))
