"""Free-running fuzz: tests/test_fuzz.py over and over, with fresh seeds, until the time is up.

    python benchmarks/fuzz.py --minutes 10

Each round runs every test of the file with so many fresh inputs and prints the seed, the inputs and the failures. What
fails is shrunk by Hypothesis, printed, and kept in .hypothesis/fuzz, so that the
next round tries it first; put it into a test of its own. Exit code 1 if anything failed.
"""

from __future__ import annotations

import argparse
import os
import re
import secrets
import subprocess
import sys
import time
from pathlib import Path

TESTS = Path(__file__).parents[1] / "tests" / "test_fuzz.py"
EXAMPLES = re.compile(r"(\d+) passing examples, (\d+) failing examples")


def main() -> None:
    """Run rounds until the time is up or a round fails."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0, help="when to start no further round")
    parser.add_argument("--examples", type=int, default=200, help="of each test in a round")
    parser.add_argument("tests", nargs="*", help="what pytest is to pick, such as -k damaged_files")
    options, picked = parser.parse_known_args()
    started, total, failed = time.monotonic(), 0, False
    while not failed and time.monotonic() - started < 60 * options.minutes:
        seed = secrets.randbelow(2**32)
        inputs, output = run_round(seed, options.examples, [*options.tests, *picked])
        failed = inputs is None
        total += inputs or 0
        print(f"{time.monotonic() - started:6.0f} s  seed {seed:10d}  {total:9,d} inputs", flush=True)
        if failed:
            print(output)
    print(f"{total:,} inputs in {time.monotonic() - started:.0f} s: {'failures' if failed else 'no failure'}")
    sys.exit(failed)


def run_round(seed: int, examples: int, picked: list[str]) -> tuple[int | None, str]:
    """How many inputs a round took, None if one failed, and what pytest printed."""
    arguments = ["-q", "-x", "--timeout=3600", "--hypothesis-show-statistics", f"--hypothesis-seed={seed}"]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", str(TESTS), *arguments, *picked],
        env={**os.environ, "IDAM_FUZZ": str(examples)},
        capture_output=True,
        text=True,
        check=False,
    )
    counts = [int(good) + int(bad) for good, bad in EXAMPLES.findall(done.stdout)]
    return (sum(counts) if done.returncode == 0 else None), done.stdout + done.stderr


if __name__ == "__main__":
    main()
