"""What each step of ``idam.register`` costs, and how it grows with the points.

    python benchmarks/steps.py [--points 1000 4000 40000 1000000] [--repeats 7] [--seed 0]
    python benchmarks/steps.py SOURCE TARGET [--repeats 7]

Pairs are two views of one part made here, as ``benchmarks/scale.py`` makes them, or two files. Each step runs alone,
in the order in which ``register`` takes them, on what the steps before have made. The figures are milliseconds of CPU
time, over all threads, of the fastest of the repeats: other programs make steps slower, never faster. The last but one
row is what ``register`` does besides.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scale import make_view

import idam
from idam.align import align, reaches
from idam.align.polish import finished
from idam.clouds.prepared import Prepared
from idam.clouds.pyramid import Pyramid
from idam.describe.invariant import surroundings
from idam.io import read_point_cloud
from idam.models import resolve
from idam.rigid import Array
from idam.search.matching import Matching
from idam.search.scope import Scope
from idam.search.stages import SEEDS, SPARSE_SEEDS, explain, proposals
from idam.solution import dense


class Steps:
    """The steps of one registration, each a method, in order."""

    def __init__(self, source: Array, target: Array) -> None:
        self.points = source, target
        self.descriptor = resolve("default").descriptor

    def check_and_centre(self) -> None:
        """Points checked, strays left out, centre and radius."""
        self.clouds = Pyramid(Prepared.of(self.points[0], "source"), Prepared.of(self.points[1], "target"))

    def thin_and_see_through(self) -> None:
        """Voxel sizes from the ladder, both levels, and what scanners saw through."""
        for pair in (self.clouds.fine, self.clouds.small):
            self.spacing = pair.spacing

    def trees_and_normals(self) -> None:
        """Of both levels."""
        self.fine, self.small = self.clouds.fine.surfaces, self.clouds.small.surfaces

    def neighbours_and_histograms(self) -> None:
        """What the descriptor sees of the clouds to match."""
        pair = self.clouds.small
        spacing = max(pair.source_level.spacing, pair.target_level.spacing)
        for level in (pair.source_level, pair.target_level):
            surroundings(level.points, spacing)

    def features_and_matches(self) -> None:
        """The descriptor, the similarity matrix and the mutual matches."""
        self.matching = Matching.of(self.descriptor, self.clouds.small)

    def agree(self) -> None:
        """Sets of matches that agree on a motion."""
        seeds = SPARSE_SEEDS if self.clouds.sparse else SEEDS
        self.agreed, self.most = next(proposals(self.matching, Scope(np.eye(4)), seeds))

    def refine_score_and_verify(self) -> None:
        """The likeliest candidates on the matched clouds, the best on the fine ones."""
        self.method = "symmetric" if self.clouds.sparse else "gicp"
        candidates = np.concatenate([np.eye(4)[None], self.agreed])
        self.found = explain(candidates, self.matching, Scope(np.eye(4)), self.method, self.fine, self.most)

    def last_stage(self) -> None:
        """On the fine clouds, or patches of all points."""
        start = self.found.best
        if self.method == "symmetric":
            start = align(self.fine, start, reaches(self.method)[1], self.method)
        finished(self.fine, lambda: dense(self.clouds), start, self.method, last=True)

    def all(self) -> list[Callable[[], None]]:
        """In order."""
        return [
            self.check_and_centre,
            self.thin_and_see_through,
            self.trees_and_normals,
            self.neighbours_and_histograms,
            self.features_and_matches,
            self.agree,
            self.refine_score_and_verify,
            self.last_stage,
        ]


def timed(work: Callable[[], Any]) -> float:
    """Milliseconds of CPU time."""
    started = time.process_time()
    work()
    return 1000 * (time.process_time() - started)


def measure(source: Array, target: Array, repeats: int) -> dict[str, float]:
    """Milliseconds of each step, of what is left, and of the whole, by name."""
    idam.register(source[:200], target[:200])  # reads the weights
    runs: list[dict[str, float]] = []
    for _ in range(repeats):
        run = {step.__name__.replace("_", " "): timed(step) for step in Steps(source, target).all()}
        # matching looks at neighbours itself
        run["features and matches"] -= run["neighbours and histograms"]
        runs.append(run | {"whole": timed(lambda: idam.register(source, target))})
    best = {name: min(run[name] for run in runs) for name in runs[0]}
    whole = best.pop("whole")
    return best | {"the rest": max(0.0, whole - sum(best.values())), "whole": whole}


def main() -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", type=Path, nargs="*")
    parser.add_argument("--points", type=int, nargs="+", default=[1000, 4000, 40_000, 1_000_000])
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    if len(arguments.files) not in (0, 2):
        parser.error("give two files, or none")
    if arguments.files:
        source, target = (read_point_cloud(path).points for path in arguments.files)
        pairs = {"files": (source, target)}
    else:
        views = {f"{count:,}": make_view(count, arguments.seed) for count in arguments.points}
        pairs = {name: (view.source, view.target) for name, view in views.items()}
    columns = {name: measure(one, other, arguments.repeats) for name, (one, other) in pairs.items()}
    print(f"| step, ms | {' | '.join(columns)} |", "|---" * (len(columns) + 1) + "|", sep="\n")
    for step in next(iter(columns.values())):
        print(f"| {step} | {' | '.join(f'{column[step]:.1f}' for column in columns.values())} |")


if __name__ == "__main__":
    main()
