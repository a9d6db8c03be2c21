"""Free-running fuzz: the fuzz tests over and over, with fresh seeds, until the time is up.

    python benchmarks/fuzz.py --minutes 10

Each round runs every fuzz test with so many fresh inputs and prints its seed. At the end comes a table of inputs and
seconds by kind. What fails is shrunk by Hypothesis, printed, and kept in .hypothesis/fuzz, so that the next round tries
it first; a file that fails is put, as small as it got, into tests/io/found, where a test reads it from then on. Exit
code 1 if anything failed.
"""

from __future__ import annotations

import argparse
import json
import os
import secrets
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from pathlib import Path

TESTS = Path(__file__).parents[1] / "tests"
FOUND = TESTS / "io" / "found"


def main() -> None:
    """Run rounds until the time is up or a round fails."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0, help="when to start no further round")
    parser.add_argument("--examples", type=int, default=200, help="of each test in a round")
    parser.add_argument("--inputs", type=int, default=10**9, help="when to stop before the time is up")
    options, picked = parser.parse_known_args()
    started, rounds, failed = time.monotonic(), 0, False
    inputs: Counter[str] = Counter()
    seconds: defaultdict[str, float] = defaultdict(float)
    peak = 0.0
    while not failed and time.monotonic() - started < 60 * options.minutes and inputs.total() < options.inputs:
        seed = secrets.randbelow(2**32)
        figures, memory, output = run_round(seed, options.examples, picked)
        failed, rounds, peak = bool(output), rounds + 1, max(peak, memory)
        for name, (count, spent) in figures.items():
            inputs[kind_of(name)] += int(count)
            seconds[kind_of(name)] += spent
        print(f"{time.monotonic() - started:6.0f} s  seed {seed:10d}  {inputs.total():9,d} inputs", flush=True)
        if failed:
            print(output)
    print("\n| kind | inputs | seconds of processor time |\n|---|---|---|")
    for name, count in sorted(inputs.items()):
        print(f"| {name} | {count:,} | {seconds[name]:.0f} |")
    print(f"| all | {inputs.total():,} | {sum(seconds.values()):.0f} |")
    print(f"\n{rounds} rounds, {'failures' if failed else 'no failure'}, at most {peak:.2f} GB of memory")
    sys.exit(failed)


def run_round(seed: int, examples: int, picked: list[str]) -> tuple[dict[str, list[float]], float, str]:
    """What a round took, by test; gigabytes of memory at most; and what pytest printed if anything failed."""
    with tempfile.TemporaryDirectory() as folder:
        log, found = Path(folder) / "log.json", Path(folder) / "found"
        found.mkdir()
        done = subprocess.run(
            [
                sys.executable,
                "-m",
                "pytest",
                *map(str, sorted(TESTS.glob("test_fuzz*.py"))),
                "-q",
                "--timeout=36000",
                f"--hypothesis-seed={seed}",
                *picked,
            ],
            env={**os.environ, "IDAM_FUZZ": f"{examples}", "IDAM_FUZZ_LOG": f"{log}", "IDAM_FUZZ_FOUND": f"{found}"},
            capture_output=True,
            text=True,
            check=False,
        )
        for path in found.iterdir():
            FOUND.mkdir(exist_ok=True)
            (FOUND / f"{seed}-{path.name}").write_bytes(path.read_bytes())
        figures = json.loads(log.read_text()) if log.exists() else {}
        return figures, figures.pop("peak GB", 0.0), "" if done.returncode == 0 else done.stdout + done.stderr


def kind_of(test: str) -> str:
    """What a test is about, in words: its name without its parameters."""
    return test.partition("[")[0].removeprefix("test_").replace("_", " ")


if __name__ == "__main__":
    main()
