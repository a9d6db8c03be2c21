"""Fit the confidence: register synthetic pairs, see which come out right, fit a logistic function to the evidence.

    python benchmarks/calibrate_confidence.py [--pairs 300] [--seed 0] [--json FILE] [--plot FILE] [--write]

Pairs are views of random parts of our own making (40 %: turned anywhere, cropped to 40 to 100 %, 300 to 8000 points
sampled independently, noise to 2 %), scans of things, rooms and streets as the general model learnt from, though not
those (25 %), of shapes with no one right answer (15 %: sphere, cylinder, plane, box) and of two different parts (20 %).
Right means within 5 degrees and 0.05 of the truth; two different parts are never right. Every second pair fits and the
others check; with --write all of them fit the shipped coefficients.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from scipy.optimize import minimize

import idam
from idam.lab.data.general import Material, draw_scans
from idam.lab.data.parts import View, partial_views, random_part
from idam.lab.evaluation.metrics import motion_error
from idam.lab.figures.curves import calibrate
from idam.search.confidence import features

FILE = Path(idam.__file__).parent / "confidence.json"
Array = NDArray[np.float64]
OURS = Material(np.empty((0, 0, 3), np.float32))


def make_view(rng: np.random.Generator) -> tuple[View, str]:
    """One pair and its kind: part, scan, ambiguous or unrelated."""
    kind = str(rng.choice(["part", "scan", "ambiguous", "unrelated"], p=[0.4, 0.25, 0.15, 0.2]))
    keep, noise = rng.uniform(0.4, 1.0), rng.uniform(0, 0.02) * rng.uniform()
    if kind == "scan":
        pair = draw_scans(OURS, rng)
        return View(pair.source, pair.target, pair.transformation), kind
    if kind == "ambiguous":
        shapes = [
            trimesh.creation.icosphere(4, 1.0),
            trimesh.creation.cylinder(0.4, 1.6, sections=64),
            trimesh.creation.box((1.4, 1.0, 1e-3)),
            trimesh.creation.box((1.0, 1.0, 1.0)),
        ]
        return partial_views(shapes[rng.integers(len(shapes))], rng, 4000, keep, noise), kind
    view = partial_views(random_part(rng), rng, int(300 * 27 ** rng.uniform()), keep, noise)
    if kind == "unrelated":
        other = partial_views(random_part(rng), rng, len(view.target), keep, noise)
        return View(view.source, other.target, view.transformation), kind
    return view, kind


def is_right(estimate: Array, view: View) -> bool:
    """Within 5 degrees, and 0.05 at the source's centre."""
    degrees, shift = motion_error(estimate, view.transformation, view.source.mean(0))
    return degrees <= 5 and shift <= 0.05


def register_all(count: int, seed: int) -> tuple[Array, Array, list[str]]:
    """What the confidence is computed from, whether the answer is right, and the kind, of ``count`` pairs."""
    rng = np.random.default_rng(seed)
    evidence, right, kinds = [], [], []
    for _ in range(count):
        view, kind = make_view(rng)
        result = idam.register(view.source, view.target)
        evidence.append(features(result.evidence))
        right.append(kind != "unrelated" and is_right(result.transformation, view))
        kinds.append(kind)
    return np.array(evidence, float), np.array(right, float), kinds


def fit(evidence: Array, right: Array) -> Array:
    """Bias and weights of the logistic function, by maximum likelihood with a little shrinkage.

    No weight is negative: more of any evidence must not make an answer less sure.
    """
    design = np.c_[np.ones(len(evidence)), evidence]

    def loss(w: Array) -> float:
        logit = design @ w
        return float((np.logaddexp(0, logit) - right * logit).sum() + 0.01 * (w[1:] ** 2).sum())

    bounds = [(None, None)] + [(0.0, None)] * evidence.shape[1]
    return np.asarray(minimize(loss, np.zeros(design.shape[1]), method="L-BFGS-B", bounds=bounds).x)


def probability(w: Array, evidence: Array) -> Array:
    """What the logistic function says."""
    return np.asarray(1 / (1 + np.exp(-(w[0] + evidence @ w[1:]))))


def draw(path: Path, said: Array, right: Array) -> None:
    """The reliability diagram, and the share of wrong answers among the surest: the risk at each coverage."""
    from matplotlib.figure import Figure

    from idam.report.style import BLUE, ORANGE

    curve = calibrate(torch.from_numpy(said), torch.from_numpy(right))
    figure = Figure((9, 4), dpi=120, layout="constrained")
    left, beside = figure.subplots(1, 2)
    left.plot([0, 1], [0, 1], color="0.6", linewidth=1)
    left.scatter(curve.predicted, curve.observed, 10 + 4 * curve.count, color=BLUE, alpha=0.8)
    title = f"calibration error {curve.error:.3f}; larger dots stand for more pairs"
    left.set(xlabel="confidence", ylabel="share right", title=title)
    order = np.argsort(-said, kind="stable")
    answered = np.arange(1, len(said) + 1)
    beside.plot(answered / len(said), 1 - np.cumsum(right[order]) / answered, color=ORANGE)
    beside.set(
        xlabel="share of pairs answered, the surest first", ylabel="share of those wrong", title="risk, coverage"
    )
    figure.savefig(path)


def main() -> None:
    """Measure, fit, print, and write with --write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, help="write what was measured here")
    parser.add_argument("--plot", type=Path, help="draw the curves of the pairs held back here")
    parser.add_argument("--write", action="store_true", help="ship the coefficients")
    arguments = parser.parse_args()
    x, y, kinds = register_all(arguments.pairs, arguments.seed)
    for kind in dict.fromkeys(kinds):
        rows = np.array(kinds) == kind
        print(f"{kind:<10} {rows.sum():>4} pairs, {y[rows].mean():.2f} right")
    said, right = probability(fit(x[::2], y[::2]), x[1::2]), y[1::2]
    sure = said >= 0.9
    error = calibrate(torch.from_numpy(said), torch.from_numpy(right)).error
    print(f"held back: calibration error {error:.3f}; {sure.sum()} sure, {right[sure].mean():.3f} of them right")
    coefficients = [round(float(c), 4) for c in fit(x, y)]
    print("coefficients", coefficients)
    about = f"benchmarks/calibrate_confidence.py --pairs {arguments.pairs} --seed {arguments.seed}"
    summary = {"about": about, "calibration_error": error, "coefficients": coefficients}
    if arguments.plot is not None:
        draw(arguments.plot, said, right)
    if arguments.json is not None:
        pairs = [{"kind": k, "features": e, "right": r} for k, e, r in zip(kinds, x.tolist(), y.tolist(), strict=True)]
        arguments.json.write_text(json.dumps({**summary, "pairs": pairs}, indent=1))
    if arguments.write:
        FILE.write_text(json.dumps(summary) + "\n")


if __name__ == "__main__":
    main()
