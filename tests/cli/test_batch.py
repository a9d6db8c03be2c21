"""``idam batch``: pairs in, rows kept, a table out."""

from __future__ import annotations

import csv
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

import idam
import idam.rigid
from idam import cli
from idam.batch import local
from idam.io import write_point_cloud


class Run(NamedTuple):
    code: int
    out: str
    err: str


Call = Callable[..., Run]


@pytest.fixture
def call(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Call:
    """Runs the command line in this process."""

    def run(*args: Any) -> Run:
        monkeypatch.setattr(sys, "argv", ["idam", *map(str, args)])
        with pytest.raises(SystemExit) as stopped:
            cli.main()
        return Run(int(stopped.value.code or 0), *capfd.readouterr())

    return run


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Work in this process: for tests of what does not hang on processes."""
    monkeypatch.setattr(local, "run", lambda pairs, build, jobs, limit: map(build(), pairs))


@pytest.fixture
def scans(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder, with three views of a lopsided ellipsoid and a broken file in scans/."""
    random = np.random.default_rng(0)
    shape = random.normal(size=(300, 3))
    shape /= np.linalg.norm(shape, axis=1, keepdims=True)
    shape = shape * [1.0, 0.6, 0.3] + np.maximum(shape, 0) * 0.4
    folder = tmp_path / "scans"
    folder.mkdir()
    for number, vector in enumerate(random.normal(size=(3, 3))):
        np.save(folder / f"{number}.npy", shape[random.permutation(300)[:200]] @ idam.rigid.rotation_exp(vector).T)
    (folder / "broken.ply").write_text("ply\n")
    (folder / "notes.md").write_text("not a scan\n")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def kept(run: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for file in run.glob("rows/*") for line in file.read_text().splitlines()]


def test_from_a_list_of_pairs_to_a_table(scans: Path, call: Call) -> None:
    (scans / "pairs.csv").write_text("source,target\nscans/0.npy,scans/1.npy\nscans/broken.ply,scans/1.npy\n")
    done = call("batch", "pairs.csv", "-o", "run", "--jobs", 2, "--set", "refine=plane")
    assert (done.code, done.err) == (1, "")
    assert done.out == "2 pairs, 1 failed. For a table: idam batch --collect run -o results.csv\n"
    before = kept(scans / "run")
    again = call("batch", "pairs.csv", "-o", "run", "--jobs", 2, "--set", "refine=plane")
    assert again == done
    assert kept(scans / "run") == before
    assert call("batch", "--collect", "run", "-o", "results.csv") == Run(0, "2 rows: results.csv\n", "")
    with (scans / "results.csv").open(encoding="utf-8", newline="") as file:
        good, bad = csv.DictReader(file)
    expected = idam.register("scans/0.npy", "scans/1.npy", refine="plane")
    assert np.array_equal(np.array(good["transformation"].split(), float), expected.transformation.ravel())
    assert (bad["status"], bad["source"]) == ("failed", "scans/broken.ply")
    assert "broken.ply" in bad["error"]


@pytest.mark.usefixtures("here")
def test_failed_pairs_again_when_asked(scans: Path, call: Call) -> None:
    (scans / "pairs.txt").write_text("scans/0.npy scans/1.npy\nscans/broken.ply scans/1.npy\n")
    assert call("batch", "pairs.txt", "-o", "run").code == 1
    write_point_cloud(scans / "scans/broken.ply", np.load(scans / "scans/2.npy"))
    assert call("batch", "pairs.txt", "-o", "run").code == 1
    assert len(kept(scans / "run")) == 2
    assert call("batch", "pairs.txt", "-o", "run", "--retry-failed").code == 0
    assert [row["status"] for row in kept(scans / "run")] == ["ok", "failed", "ok"]
    assert call("batch", "--collect", "run", "-o", "all.csv").out == "2 rows: all.csv\n"


@pytest.mark.usefixtures("here")
def test_within_a_folder(scans: Path, call: Call) -> None:
    (scans / "scans/broken.ply").unlink()
    assert call("batch", "--within", "scans", "-o", "run") == Run(
        0, "3 pairs, 0 failed. For a table: idam batch --collect run -o results.csv\n", ""
    )
    assert {row["id"] for row in kept(scans / "run")} == {"0.npy 1.npy", "0.npy 2.npy", "1.npy 2.npy"}


@pytest.mark.usefixtures("here")
def test_shards_and_a_table_before_the_end(scans: Path, call: Call) -> None:
    for part in ("1/2", "2/2"):
        missing = 4 * 3 // 2 - len(kept(scans / "run"))
        if part == "2/2":
            early = call("batch", "--collect", "run", "-o", "early.jsonl")
            assert (early.code, early.err) == (
                1,
                f"idam: {missing} pairs have no row yet: run the same command to go on\n",
            )
        call("batch", "--within", "scans", "-o", "run", "--shard", part)
    assert len(kept(scans / "run")) == len({row["id"] for row in kept(scans / "run")}) == 6
    assert call("batch", "--collect", "run", "-o", "all.jsonl").code == 0
    rows = [json.loads(line) for line in (scans / "all.jsonl").read_text().splitlines()]
    assert [row["id"] for row in rows][:2] == ["0.npy 1.npy", "0.npy 2.npy"]


REFUSED = {
    ("batch",): "give one of: a file of PAIRS, --within FOLDER, or --collect RUN",
    ("batch", "pairs.txt", "--within", "scans", "-o", "run"): "give one of",
    ("batch", "pairs.txt"): "give the folder of the run, or the table, as -o",
    ("batch", "none.txt", "-o", "run"): "none.txt: no such file",
    ("batch", "pairs.txt", "-o", "run", "--shard", "0/4"): "shard '0/4': give I/N with I from 1 to N, such as 3/16",
    ("batch", "pairs.txt", "-o", "run", "--shard", "3"): "shard '3': give I/N",
    ("batch", "pairs.txt", "-o", "run", "--engine", "dask"): "unknown engine 'dask': local or ray",
    ("batch", "pairs.txt", "-o", "run", "--address", "auto"): "--address needs --engine ray",
    ("batch", "pairs.txt", "-o", "run", "--set", "refine=grind"): "unknown refinement 'grind'",
    (
        "batch",
        "pairs.txt",
        "-o",
        "run",
        "--set",
        "grind=1",
    ): "unknown setting 'grind=1': give NAME=VALUE with one of",
    (
        "batch",
        "pairs.txt",
        "-o",
        "run",
        "--set",
        "max_angle=wide",
    ): "setting 'max_angle=wide': 'wide' is no value",
    ("batch", "pairs.txt", "-o", "run", "--set", "max_angle=200"): "max_angle must be",
    ("batch", "pairs.txt", "-o", "run", "--time-limit", "0"): "the time limit must be more than 0 s",
    ("batch", "--within", "none", "-o", "run"): "none: no such folder",
    ("batch", "--within", "empty", "-o", "run"): "empty: 0 scans in it: two or more are needed",
    ("batch", "--collect", "scans", "-o", "table.csv"): "scans: is not the folder of a batch",
    ("batch", "--collect", "scans", "-o", "table.xls"): "unknown table format",
}


@pytest.mark.parametrize("args", REFUSED, ids=[" ".join(args[1:]) for args in REFUSED])
def test_bad_input_is_one_line(scans: Path, call: Call, args: tuple[str, ...]) -> None:
    (scans / "pairs.txt").write_text("scans/0.npy scans/1.npy\n")
    (scans / "empty").mkdir()
    refused = call(*args)
    assert (refused.code, refused.out) == (2, "")
    assert REFUSED[args] in refused.err
    assert refused.err.count("\n") == 1
    assert not (scans / "run").exists()


@pytest.mark.usefixtures("here")
def test_the_folder_of_another_job_is_refused(scans: Path, call: Call) -> None:
    (scans / "pairs.txt").write_text("scans/0.npy scans/1.npy\n")
    assert call("batch", "pairs.txt", "-o", "run").code == 0
    refused = call("batch", "pairs.txt", "-o", "run", "--set", "max_angle=90")
    assert refused == Run(
        2, "", "idam: run: holds another job (max_angle 180.0, not 90.0): choose another folder, or do the same job\n"
    )


def test_the_page_about_many_pairs_runs(scans: Path, call: Call) -> None:
    for number in range(3):
        write_point_cloud(scans / f"scans/{number}.ply", np.load(scans / f"scans/{number}.npy"))
    (scans / "scans/broken.ply").unlink()
    text = (Path(__file__).resolve().parents[2] / "docs/many-pairs.md").read_text(encoding="utf-8")
    python = re.findall(r"^```python\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    names: dict[str, Any] = {"__name__": "__main__"}
    exec(python[0], names)
    for command in ("idam batch pairs.csv -o run/", "idam batch --collect run/ -o results.csv"):
        assert f"\n{command}\n" in text
        assert call(*command.split()[1:]).code == 0
    exec(python[1] + "assert len(good) == 3\n", names)
    exec(python[2] + '    assert row["status"] == "ok"\n', names)


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGINT for a group of processes there")
def test_interrupted_it_says_how_to_go_on(scans: Path) -> None:
    lines = [f'{{"id": {i}, "source": "scans/0.npy", "target": "scans/1.npy"}}\n' for i in range(1000)]
    command = [sys.executable, "-m", "idam", "batch", "-", "-o", "run", "--jobs", "2"]
    process = subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stdin is not None
    process.stdin.write("".join(lines))
    process.stdin.close()
    process.stdin = None
    end = time.monotonic() + 60
    while not kept_lines(scans / "run") and time.monotonic() < end:
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGINT)  # as Ctrl-C does on a terminal
    out, err = process.communicate(timeout=30)
    left = 1000 - kept_lines(scans / "run")
    assert (process.returncode, out) == (130, "")
    said = re.fullmatch(r"idam: interrupted: (\d+) pairs are left: run the same command to go on\n", err)
    assert said is not None
    assert int(said[1]) in (left, left + 1)  # one may have been written at that moment
    with pytest.raises(ProcessLookupError):
        for _ in range(300):  # soon no process of it is left
            os.killpg(process.pid, 0)
            time.sleep(0.1)


def kept_lines(run: Path) -> int:
    return sum(file.read_bytes().count(b"\n") for file in run.glob("rows/*"))
