"""Fit the judge: register synthetic pairs, see which answers are right, fit what ranks them and how sure they are.

    python benchmarks/fit_judge.py collect FILE [--pairs 400] [--seed 0] [--data MODELNET40]
    python benchmarks/fit_judge.py fit FILE... [--json docs/results/confidence.json] [--write]
    python benchmarks/fit_judge.py check FILE... [--json docs/results/confidence-fresh.json]

The shipped fit is of ``collect seed-1.jsonl --pairs 420 --seed 1`` and the same with 2, both with --data, by the search
as it was before it left out the flanks of peaks. Seeds 3 and 4 are for ``check``: pairs judged by the shipped fit.

Pairs are of the sensors' families (:mod:`idam.lab.data.sensor_pairs`), scans as the general model learnt from, though
not those, views of random parts (300 to 8000 points sampled independently, noise to 2 %), shapes with no one right
answer (sphere, cylinder, plane, box), two different parts, and, with --data, disjoint halves of ModelNet40's shapes.
Right means within 3 degrees and 0.3 m (indoors) or 0.5 m of the truth in scenes, within 5 degrees and 0.05 radii
elsewhere. Two different parts are never right, nor is an answer whose place nothing in the scene fixes.

What ranks answers is fitted by how often it chooses a right one among those found; the confidence, by a logistic
regression on the chosen ones. Each family is also left out of the fit and judged by the others: these are the figures
to expect of scans that the fit never saw.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.optimize import minimize

import idam
from idam import rigid
from idam.clouds.pyramid import Pyramid
from idam.errors import InputError
from idam.lab.data.general import Material, draw_halves, draw_scans
from idam.lab.data.modelnet40 import load
from idam.lab.data.parts import View, partial_views, random_part
from idam.lab.data.sensor_pairs import FAMILIES, draw_sensor_pair
from idam.lab.evaluation.metrics import motion_error
from idam.models import resolve
from idam.registration import order, prepared
from idam.search.judge import FEATURES, GEOMETRIC, LEADS, features, leads
from idam.search.ranking import Answer
from idam.search.scope import Scope
from idam.search.stages import search

Array = NDArray[np.float64]

FILE = Path(idam.__file__).parent / "search" / "judge.json"
INDOORS = ("corridor", "pillars", "stairwell", "room")
SURE = 0.9


@dataclass(frozen=True)
class Pair:
    """A pair to register; ``right`` says of a transform (4, 4) whether it is right, None where none can be known."""

    family: str
    source: Array
    target: Array
    truth: Array
    within: tuple[float, float] | None


def draws(shapes: NDArray[np.float32]) -> list[tuple[str, Callable[[np.random.Generator], Pair]]]:
    """How to draw a pair, in the order they are drawn in."""
    material = Material(shapes)
    sensed = [(family, lambda rng, family=family: as_sensed(family, rng)) for family in FAMILIES]
    halves = [("halves", lambda rng: plain("halves", draw_halves(material, rng)))] * 2 if len(shapes) else []
    return [
        *sensed,
        *[("scan", lambda rng: plain("scan", draw_scans(material, rng)))] * 3,
        *[("view", lambda rng: viewed("view", random_part(rng), rng))] * 3,
        ("ambiguous", lambda rng: viewed("ambiguous", ambiguous(rng), rng)),
        *[("unrelated", unrelated)] * 2,
        *halves,
    ]


def as_sensed(family: str, rng: np.random.Generator) -> Pair:
    """A pair with the patterns of real sensors."""
    pair = draw_sensor_pair(rng, family)
    within = 3.0, 0.3 if family in INDOORS else 0.5
    if "model" in pair.sensors:
        whole = pair.source if pair.sensors[0] == "model" else pair.target
        within = 5.0, 0.05 * float(np.linalg.norm(whole - whole.mean(0), axis=1).max())
    return Pair(family, pair.source, pair.target, pair.transformation, None if pair.free else within)


def plain(family: str, pair: Any) -> Pair:
    """A pair in the unit sphere."""
    return Pair(family, pair.source, pair.target, pair.transformation, (5.0, 0.05))


def viewed(family: str, mesh: Any, rng: np.random.Generator) -> Pair:
    """Two views of a mesh."""
    return plain(family, view_of(mesh, rng))


def view_of(mesh: Any, rng: np.random.Generator) -> View:
    """Two views of a mesh, cropped to 40 to 100 %, with noise to 2 %."""
    keep, noise = rng.uniform(0.4, 1.0), rng.uniform(0, 0.02) * rng.uniform()
    return partial_views(mesh, rng, int(300 * 27 ** rng.uniform()), keep, noise)


def ambiguous(rng: np.random.Generator) -> Any:
    """A mesh with more than one right answer."""
    return [
        trimesh.creation.icosphere(4, 1.0),
        trimesh.creation.cylinder(0.4, 1.6, sections=64),
        trimesh.creation.box((1.4, 1.0, 1e-3)),
        trimesh.creation.box((1.0, 1.0, 1.0)),
    ][rng.integers(4)]


def unrelated(rng: np.random.Generator) -> Pair:
    """Views of two different parts."""
    one, other = view_of(random_part(rng), rng), view_of(random_part(rng), rng)
    return Pair("unrelated", one.source, other.target, one.transformation, None)


def collect(file: Path, count: int, seed: int, data: Path | None) -> None:
    """Write what is known of the answers of ``count`` pairs, a JSON line for each."""
    shapes = load(data, "train").points.numpy()[::8] if data else np.empty((0, 0, 3), np.float32)
    with file.open("w") as out:
        for number, (_, draw) in zip(range(count), cycle(draws(shapes)), strict=False):
            record = judged(draw(np.random.default_rng((seed, number))))
            if record is not None:
                print(json.dumps(record), file=out, flush=True)


def judged(pair: Pair) -> dict[str, Any] | None:
    """The features of a pair's answers, the ones of the last stage, and whether each is right."""
    truth = pair.truth
    try:
        clouds = prepared(pair.source, "source"), prepared(pair.target, "target")
        if order(clouds[1]) < order(clouds[0]):
            clouds, truth = clouds[::-1], rigid.inverse(truth)
        pyramid = Pyramid(*clouds)
        method = "symmetric" if pyramid.sparse else "gicp"
        found = search(pyramid, resolve("default").descriptors, None, Scope(np.eye(4)), method)
    except InputError:
        return None
    centroid, right = clouds[0].points.mean(0), []
    for answer in found.answers:
        degrees, shift = motion_error(pyramid.leave(answer.transformation), truth, centroid)
        right.append(pair.within is not None and degrees <= pair.within[0] and shift <= pair.within[1])
    return {
        "family": pair.family,
        "known": pair.within is not None,
        "features": [features(answer).tolist() for answer in found.answers],
        "right": [bool(x) for x in right],
    }


def fit(records: list[dict[str, Any]]) -> dict[str, Any]:
    """The ranking's weights, those of the surfaces alone, and the confidence's."""
    # how firmly an answer is held is known of those that were looked at closely, and ranks none
    ranks = [name for name in FEATURES if name != "fixed"]
    weights, geometry = ranking(records, ranks), ranking(records, GEOMETRIC)
    said, right = summaries(records, weights, geometry)
    design = np.c_[np.ones(len(said)), said]

    def unlikely(w: Array) -> float:
        logit = design @ w
        return float((np.logaddexp(0, logit) - right * logit).sum() + 0.3 * (w[1:] ** 2).sum())

    bounds: list[tuple[float | None, None]] = [(None, None)] + [(0.0, None)] * said.shape[1]
    bias, *known = minimize(unlikely, np.zeros(len(bounds)), method="L-BFGS-B", bounds=bounds).x

    def named(names: Sequence[str], values: Sequence[float] | Array) -> dict[str, float]:
        return {name: round(float(w), 4) for name, w in zip(names, values, strict=True)}

    return {
        "weights": named(FEATURES, weights),
        "geometry": named(FEATURES, geometry),
        "bias": round(float(bias), 4),
        "confidence": named(FEATURES, known[: len(FEATURES)]),
        "leads": named(LEADS, known[len(FEATURES) :]),
    }


def ranking(records: list[dict[str, Any]], names: Sequence[str]) -> Array:
    """Weights of the features (9,), those named, by the share of the softmax that right answers have."""
    told = [(np.array(r["features"]), np.array(r["right"])) for r in records if any(r["right"]) and not all(r["right"])]

    def loss(w: Array) -> float:
        total = 0.02 * len(told) * float((w / 10) @ (w / 10))
        for x, right in told:
            z = x @ w
            total += np.logaddexp.reduce(z) - np.logaddexp.reduce(z[right])
        return float(total)

    free = [(0.0, None if name in names else 0.0) for name in FEATURES]
    weights: Array = minimize(loss, [float(high is None) for _, high in free], method="L-BFGS-B", bounds=free).x
    return weights


def summaries(records: list[dict[str, Any]], weights: Array, geometry: Array) -> tuple[Array, Array]:
    """Features and leads of each pair's best answer (N, 12), and whether it is right (N,)."""
    said, right = [], []
    nothing = features(Answer(np.eye(4)))  # an only answer has to be better than this
    for record in records:
        known = np.array([*record["features"], nothing])
        best = int((known[:-1] @ weights).argmax())
        ahead = [float(z[best] - np.delete(z, best).max()) for z in (known @ weights, known @ geometry)]
        said.append([*known[best], *leads(*ahead)])
        right.append(record["right"][best])
    return np.array(said), np.array(right, float)


def confidences(records: list[dict[str, Any]], held: dict[str, Any]) -> tuple[Array, Array]:
    """What a fit says of pairs (N,), and whether it is right (N,)."""
    weights, geometry, known = (
        np.array([held[part][name] for name in FEATURES]) for part in ("weights", "geometry", "confidence")
    )
    said, right = summaries(records, weights, geometry)
    known = np.append(known, [held["leads"][name] for name in LEADS])
    return 1 / (1 + np.exp(-(held["bias"] + said @ known))), right


def figures(said: Array, right: Array, records: list[dict[str, Any]]) -> dict[str, float]:
    """Of a family: pairs, right ones, those with a right answer among the found ones, sure ones, calibration error."""
    sure, bins = said >= SURE, np.minimum((said * 10).astype(int), 9)
    return {
        "pairs": len(said),
        "right": int(right.sum()),
        "found": sum(any(record["right"]) for record in records),
        "sure": int(sure.sum()),
        "sure and wrong": int((sure & (right == 0)).sum()),
        "mean confidence": float(said.mean()),
        "calibration error": float(sum(abs((said - right)[bins == n].sum()) for n in range(10)) / len(said)),
    }


def by_family(said: Array, right: Array, records: list[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Each family's figures, and those of all."""
    families = np.array([record["family"] for record in records])
    rows = {name: np.flatnonzero(families == name) for name in dict.fromkeys(families.tolist())}
    rows["all"] = np.arange(len(records))
    return {name: figures(said[row], right[row], [records[n] for n in row]) for name, row in rows.items()}


def left_out(records: list[dict[str, Any]]) -> tuple[Array, Array]:
    """What is said of pairs (N,) by fits to all other families, and whether it is right (N,)."""
    said, right = np.zeros(len(records)), np.zeros(len(records))
    families = np.array([record["family"] for record in records])
    for family in dict.fromkeys(families.tolist()):
        inside = np.flatnonzero(families == family)
        mine = [records[n] for n in inside]
        said[inside], right[inside] = confidences(mine, fit([records[n] for n in np.flatnonzero(families != family)]))
    return said, right


def main() -> None:
    """Collect; or fit, print and write; or check, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("collect", "fit", "check"))
    parser.add_argument("files", type=Path, nargs="+")
    parser.add_argument("--pairs", type=int, default=400)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--data", type=Path, help="folder of ModelNet40")
    parser.add_argument("--json", type=Path, help="write the figures here")
    parser.add_argument("--write", action="store_true", help="with fit: ship it")
    arguments = parser.parse_args()
    if arguments.write and arguments.what != "fit":
        parser.error("--write ships a fit: use it with fit")
    if arguments.what == "collect":
        collect(arguments.files[0], arguments.pairs, arguments.seed, arguments.data)
        return
    records = [json.loads(line) for file in arguments.files for line in file.read_text().splitlines()]
    shipped = json.loads(FILE.read_text()) if arguments.what == "check" else None
    said, right = left_out(records) if shipped is None else confidences(records, shipped)
    table = by_family(said, right, records)
    for family, row in table.items():
        print(f"{family:<12}", " ".join(f"{name} {value:.3g}" for name, value in row.items()))
    files = " ".join(file.name for file in arguments.files)
    about = {"about": f"benchmarks/fit_judge.py {arguments.what} {files}, {len(records)} pairs"}
    held = {**about, **(fit(records) if shipped is None else {})}
    print(json.dumps(held, indent=1))
    if arguments.json is not None:
        name = "left out" if shipped is None else "fresh"
        arguments.json.write_text(json.dumps({**held, name: table}, indent=1) + "\n")
    if arguments.write:
        FILE.write_text(json.dumps(held, indent=1) + "\n")


if __name__ == "__main__":
    main()
