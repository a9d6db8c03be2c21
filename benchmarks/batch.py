"""What `idam batch` promises, measured: nothing lost under kills, the same rows however run, speed, memory.

    python benchmarks/batch.py [--parts kills engines speed memory] [--pairs 1000] [--kills 20] [--json FILE]

Pairs are of views of one shape made here, so that no data is needed, and one in twenty has a broken file. Times are of
whole commands, from the shell; on a busy machine compare within a run, never across runs.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from datetime import datetime, timezone
from importlib.util import find_spec
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

import idam
from idam import rigid
from idam.batch.ledger import read_run

Record = dict[str, Any]


def make_pairs(folder: Path, count: int, points: int) -> Path:
    """A list of pairs of views of a shape, all pairs of as few scans as have so many; one in twenty is broken."""
    generator = np.random.default_rng(0)
    shape = generator.normal(size=(2 * points, 3))
    shape /= np.linalg.norm(shape, axis=1, keepdims=True)
    shape = shape * [1.0, 0.6, 0.3] + np.maximum(shape, 0) * 0.4
    scans = next(number for number in range(2, count + 2) if number * (number - 1) // 2 >= count)
    for number in range(scans):
        view = shape[generator.permutation(2 * points)[:points]]
        np.save(folder / f"{number}.npy", rigid.apply(rigid.exp(generator.normal(size=6)), view))
    lines = [f"{source}.npy {target}.npy" for source, target in list(combinations(range(scans), 2))[:count]]
    for number in range(0, count, 20):
        (folder / f"broken{number}.ply").write_text("ply\n")
        lines[number] = f"broken{number}.ply {lines[number].split()[1]}"
    (folder / "pairs.txt").write_text("\n".join(lines))
    return folder / "pairs.txt"


def start(pairs: Path, run: Path, *options: str) -> subprocess.Popen[bytes]:
    """A batch, from the shell."""
    command = [sys.executable, "-m", "idam", "batch", str(pairs), "-o", str(run), *options]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL)


def finish(pairs: Path, run: Path, *options: str) -> tuple[float, float]:
    """A whole batch; the seconds that it took, on the clock and of all cores (but for Ray's own processes)."""
    started = time.perf_counter()
    process = start(pairs, run, *options)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode not in (0, 1) or not lines_of(run):
        raise SystemExit(f"{shlex.join(options)}: failed with exit code {process.returncode}")
    return time.perf_counter() - started, usage.ru_utime + usage.ru_stime


def rows_of(run: Path) -> dict[str, Record]:
    """Rows by id, without the seconds."""
    return {row["id"]: {**row, "seconds": None} for row in read_run(run)[0]}


def lines_of(run: Path) -> int:
    """Rows written, doubled ones and all."""
    return sum(file.read_bytes().count(b"\n") for file in run.glob("rows/*"))


def descendants(process: int) -> list[int]:
    """All processes below one."""
    found = []
    for task in Path(f"/proc/{process}/task").glob("*/children"):
        with contextlib.suppress(OSError):
            for child in map(int, task.read_text().split()):
                found += [child, *descendants(child)]
    return found


def compared(run: Path, calm: dict[str, Record]) -> Record:
    """How the rows of a run differ from those of an undisturbed one."""
    rows = rows_of(run)
    return {
        "lost": len(calm.keys() - rows.keys()),
        "doubled": lines_of(run) - len(rows),
        "different": sum(rows[name] != calm[name] for name in rows),
    }


def kills(pairs: Path, folder: Path, calm: dict[str, Record], count: int) -> Record:
    """Kill the main process, to be started again, or one below it, at random moments over a whole batch."""
    chance, run = random.Random(0), folder / "killed"
    killed = {"main": 0, "workers": 0}
    process = start(pairs, run)
    for goal in sorted(chance.sample(range(len(calm)), count)):
        while lines_of(run) < goal and process.poll() is None:
            time.sleep(0.01)
        time.sleep(chance.uniform(0, 0.5))
        workers = descendants(process.pid)
        if workers and chance.random() < 0.5:
            with contextlib.suppress(ProcessLookupError):
                os.kill(chance.choice(workers), signal.SIGKILL)
                killed["workers"] += 1
        else:
            process.kill()
            process.wait()
            killed["main"] += 1
            process = start(pairs, run)
    process.wait()
    return {"killed": killed, **compared(run, calm)}


def engines(pairs: Path, folder: Path, calm: dict[str, Record]) -> Record:
    """The rows of one process, two, two shards in one folder, and Ray, against one another."""
    found: Record = {}
    finish(pairs, folder / "two", "--jobs", "2")
    found["two processes"] = compared(folder / "two", calm)
    for shard in [start(pairs, folder / "shards", "--shard", f"{part}/2", "--jobs", "1") for part in (1, 2)]:
        shard.wait()
    found["two shards"] = compared(folder / "shards", calm)
    if find_spec("ray") is not None:
        finish(pairs, folder / "ray", "--engine", "ray", "--jobs", "2")
        found["ray"] = compared(folder / "ray", calm)
    failed = [row for row in calm.values() if row["status"] == "failed"]
    found["failed"] = {"rows": len(failed), "with a reason": sum(bool(row["error"]) for row in failed)}
    return found


def speed(pairs: Path, folder: Path, repeats: int) -> Record:
    """Pairs a second and processor time of each, starting included; each way once a round, in turn."""
    names = [line.split() for line in pairs.read_text().splitlines()]
    ways: dict[str, tuple[str, ...]] = {"1 process": ("--jobs", "1"), "2 processes": ("--jobs", "2")}
    if find_spec("ray") is not None:
        ways["ray, 2 actors"] = ("--engine", "ray", "--jobs", "2")
    loop = "idam.register in a loop"
    seconds: dict[str, list[tuple[float, float]]] = {name: [] for name in (loop, *ways)}
    for number in range(repeats):
        started = time.perf_counter(), time.process_time()
        for source, target in names:
            with contextlib.suppress(idam.InputError):
                idam.register(pairs.parent / source, pairs.parent / target)
        seconds[loop].append((time.perf_counter() - started[0], time.process_time() - started[1]))
        for way, options in ways.items():
            seconds[way].append(finish(pairs, folder / f"{way} {number}", *options))
    best = {way: min(wall for wall, _ in times) for way, times in seconds.items()}
    return {
        "pairs": len(names),
        "seconds": seconds,
        "pairs_per_second": {way: len(names) / wall for way, wall in best.items()},
        "cpu_ms_per_pair": {way: 1000 * min(cpu for _, cpu in times) / len(names) for way, times in seconds.items()},
        "speed_up_of_2": best["1 process"] / best["2 processes"],
        "load": os.getloadavg(),
    }


def memory(pairs: Path, count: int) -> Record:
    """Megabytes of the main process and of a worker, while a batch of many pairs runs."""
    names = [[str(pairs.parent / name) for name in line.split()] for line in pairs.read_text().splitlines()]
    many: Iterator[Record] = (
        {"id": number, "source": names[number % len(names)][0], "target": names[number % len(names)][1]}
        for number in range(count)
    )
    found: Record = {"pairs": [], "main_mb": [], "worker_mb": []}
    for done, _ in enumerate(idam.register_pairs(many, jobs=1), 1):
        if done % (count // 10) == 0:
            found["pairs"].append(done)
            found["main_mb"].append(resident(os.getpid()))
            found["worker_mb"].append(max(map(resident, descendants(os.getpid()))))
    return found


def resident(process: int) -> float:
    """Megabytes of a process in memory."""
    return int(Path(f"/proc/{process}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parts = ("kills", "engines", "speed", "memory")
    parser.add_argument("--parts", nargs="+", choices=parts, default=parts)
    parser.add_argument("--pairs", type=int, default=1000)
    parser.add_argument("--points", type=int, default=200)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--memory-pairs", type=int, default=10_000)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    from idam.lab.evaluation.record import processor  # PyTorch with it, which workers that import this do not need

    results: Record = {
        "command": shlex.join(["python", *sys.argv]),
        "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "processor": processor(),
    }
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        pairs = make_pairs(folder, arguments.pairs, arguments.points)
        if {"kills", "engines"} & set(arguments.parts):
            finish(pairs, folder / "calm", "--jobs", "1")
            calm = rows_of(folder / "calm")
        if "kills" in arguments.parts:
            results["kills"] = kills(pairs, folder, calm, arguments.kills)
        if "engines" in arguments.parts:
            results["engines"] = engines(pairs, folder, calm)
        if "speed" in arguments.parts:
            results["speed"] = speed(pairs, folder, arguments.repeats)
        if "memory" in arguments.parts:
            results["memory"] = memory(pairs, arguments.memory_pairs)
    text = json.dumps(results, indent=1)
    print(text)
    if arguments.json is not None:
        arguments.json.write_text(text + "\n")


if __name__ == "__main__":
    main()
