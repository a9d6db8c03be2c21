"""Trust: how often ``idam.register`` is right, how sure it says it is, and how often it is sure and wrong, by family.

    python benchmarks/trust.py [FOLDER...] [--pairs 10] [--family NAME ...] [--seed 0] [--json FILE]

Families are drawn by :mod:`idam.lab.data.sensor_pairs`, ``--pairs`` of each (0 for none). Where nothing that both scans
see fixes the place, no answer can be known, and a sure one counts as wrong. Folders hold measured pairs, in one of
three forms:

- scans and a ``pairs.json`` with ``pairs`` of ``source``, ``target``, ``transformation`` and, for all, ``success``:
  ``rotation_deg`` and the ``centroid_shift`` of the source's centroid;
- ``FAMILY_N.npz`` with ``source``, ``target``, ``truth`` and perhaps ``observable``, ``max_rot_deg`` and
  ``max_centroid_shift``;
- ``NAME_N.npz`` with ``points``, a view of the part ``NAME.STL``: right where 97 % of them come to lie within 2 % of
  its extent of its surface, so that symmetric poses count.

A family's line: pairs, those whose place is known, right answers, sure ones (confidence 0.9 and more), sure and wrong
ones, the mean confidence, the calibration error (expected, ten bins), and the risk, the share of wrong answers among
the surest quarter, half and all.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import datetime, timezone
from itertools import chain, groupby
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

import idam
from idam.io import read_point_cloud
from idam.lab.data.parts import sample_surface
from idam.lab.data.sensor_pairs import FAMILIES, SensorPair, draw_sensor_pair
from idam.lab.evaluation.metrics import motion_error
from idam.lab.evaluation.record import processor
from idam.rigid import apply

Array = NDArray[np.float64]

SURE = 0.9
COVERED = (0.25, 0.5, 1.0)
"""Shares of the pairs, the surest first, at which the risk is given."""
INDOORS = ("corridor", "pillars", "stairwell", "room")
DEGREES, INDOOR_SHIFT, OUTDOOR_SHIFT = 3.0, 0.3, 0.5
"""What counts as right in scenes, in degrees and metres."""
PART_DEGREES, PART_SHIFT = 5.0, 0.05
"""What counts as right of drawn parts, in degrees and radii."""
ON_SURFACE, SHARE_ON_SURFACE = 0.02, 0.97
"""What counts as right of parts with a mesh: extents from its surface, and the share of points that near."""


@dataclass(frozen=True)
class Case:
    """A pair to register.

    Attributes:
        family: what it counts to.
        name: its own.
        source: (N, 3).
        target: (P, 3).
        right: says of a transform (4, 4) whether it is right.
        known: whether the place can be known.
    """

    family: str
    name: str
    source: Array
    target: Array
    right: Callable[[Array], bool]
    known: bool = True


def within(truth: Array, source: Array, degrees: float, shift: float) -> Callable[[Array], bool]:
    """Says whether a transform is as near to the truth as this, at the source's centroid."""

    def right(estimate: Array) -> bool:
        angle, distance = motion_error(estimate, truth, source.mean(0))
        return bool(angle <= degrees and distance <= shift)

    return right


def drawn(family: str, count: int, seed: int) -> Iterator[Case]:
    """Pairs of a family of our own."""
    for number in range(count):
        pair = draw_sensor_pair(np.random.default_rng((seed, FAMILIES.index(family), number)), family)
        right = within(pair.transformation, pair.source, *limits(pair))
        yield Case(family, f"{family}_{number}", pair.source, pair.target, right, not pair.free)


def limits(pair: SensorPair) -> tuple[float, float]:
    """Degrees and shift within which an answer is right."""
    if "model" in pair.sensors:
        whole = pair.source if pair.sensors[0] == "model" else pair.target
        return PART_DEGREES, PART_SHIFT * float(np.linalg.norm(whole - whole.mean(0), axis=1).max())
    return DEGREES, INDOOR_SHIFT if pair.family in INDOORS else OUTDOOR_SHIFT


def measured(folder: Path) -> Iterator[Case]:
    """Pairs of a folder."""
    if (folder / "pairs.json").exists():
        about = json.loads((folder / "pairs.json").read_text())
        success = about["success"]["rotation_deg"], about["success"]["centroid_shift"]
        for pair in about["pairs"]:
            source, target = (read_point_cloud(folder / pair[side]).points for side in ("source", "target"))
            right = within(np.array(pair["transformation"]), source, *success)
            yield Case(f"{folder.parent.name}/{folder.name}", pair["name"], source, target, right)
    for path in sorted(folder.glob("*.npz")):
        family = path.stem.rsplit("_", 1)[0]
        held = {key: np.asarray(value, float) for key, value in np.load(path).items()}
        if "points" in held:
            mesh = path.with_name(f"{family}.STL")
            target = np.asarray(read_point_cloud(mesh).points)
            yield Case(folder.name, path.stem, held["points"], target, on_surface(mesh, held["points"]))
            continue
        shift = INDOOR_SHIFT if family in INDOORS else OUTDOOR_SHIFT
        success = float(held.get("max_rot_deg", DEGREES)), float(held.get("max_centroid_shift", shift))
        right = within(held["truth"], held["source"], *success)
        known = bool(held.get("observable", True))
        yield Case(f"{folder.name}/{family}", path.stem, held["source"], held["target"], right, known)


def on_surface(path: Path, points: Array) -> Callable[[Array], bool]:
    """Says whether a transform lays points (N, 3) on the surface of a mesh."""
    import trimesh

    mesh = trimesh.load(path)
    dense = cKDTree(sample_surface(mesh, 200_000, np.random.default_rng(0)))
    reach = ON_SURFACE * float(np.max(mesh.extents))

    def right(estimate: Array) -> bool:
        return bool(np.mean(dense.query(apply(estimate, points))[0] < reach) >= SHARE_ON_SURFACE)

    return right


def register(case: Case) -> dict[str, Any]:
    """What comes of a pair; a refusal is an answer of no confidence."""
    started, reason = time.perf_counter(), ""
    right, confidence = False, 0.0
    try:
        result = idam.register(case.source, case.target)
    except idam.InputError as refusal:
        reason = str(refusal)
    else:
        confidence, reason = float(result.confidence), result.reason
        right = case.known and case.right(result.transformation)
    return {
        "family": case.family,
        "name": case.name,
        "known": case.known,
        "right": right,
        "confidence": confidence,
        "reason": reason,
        "seconds": time.perf_counter() - started,
    }


def summary(records: list[dict[str, Any]]) -> dict[str, float]:
    """The figures of a family."""
    said = np.array([record["confidence"] for record in records])
    right = np.array([record["right"] for record in records])
    sure, surest = said >= SURE, np.argsort(-said, kind="stable")
    bins = np.minimum((said * 10).astype(int), 9)
    gaps = [abs((said - right)[bins == number].sum()) for number in range(10)]
    figures: dict[str, float] = {
        "pairs": len(records),
        "known": sum(record["known"] for record in records),
        "right": int(right.sum()),
        "sure": int(sure.sum()),
        "sure and wrong": int((sure & ~right).sum()),
        "mean confidence": float(said.mean()),
        "calibration error": float(sum(gaps) / len(records)),
    }
    for share in COVERED:
        answered = surest[: max(1, round(share * len(records)))]
        figures[f"risk at {share:.0%}"] = float(1 - right[answered].mean())
    figures["median seconds"] = float(np.median([record["seconds"] for record in records]))
    return figures


def line(name: str, cells: list[Any]) -> str:
    """Of a table."""
    texts = [f"{cell:.2f}" if isinstance(cell, float) else str(cell) for cell in cells]
    return f"| {name} | " + " | ".join(texts) + " |"


def main() -> None:
    """Measure, print, and write with --json."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="*")
    parser.add_argument("--pairs", type=int, default=10, help="of each family that is drawn; 0 for none")
    parser.add_argument("--family", action="append", choices=FAMILIES, help="only these; may be given several times")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, help="write every pair's record here")
    arguments = parser.parse_args()
    sets = [drawn(family, arguments.pairs, arguments.seed) for family in arguments.family or FAMILIES]
    sets += [measured(folder) for folder in arguments.folders]
    records: list[dict[str, Any]] = []
    families: dict[str, dict[str, float]] = {}
    for name, cases in groupby(chain.from_iterable(sets), key=lambda case: case.family):
        found = [register(case) for case in cases]
        families[name] = summary(found)
        if not records:
            columns = list(families[name])
            print(line("", columns), "|---" * (len(columns) + 1) + "|", sep="\n")
        print(line(name, list(families[name].values())), flush=True)
        records += found
    families["all"] = summary(records)
    print(line("all", list(families["all"].values())))
    if arguments.json is not None:
        about = {
            "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
            "processor": processor(),
            "idam": idam.__version__,
            "pairs": arguments.pairs,
            "seed": arguments.seed,
        }
        arguments.json.write_text(json.dumps({**about, "families": families, "records": records}, indent=1))


if __name__ == "__main__":
    main()
