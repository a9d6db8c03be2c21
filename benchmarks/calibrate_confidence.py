"""Fit the confidence: register synthetic pairs, see which come out right, fit a logistic function to the evidence.

    python benchmarks/calibrate_confidence.py [--pairs 240] [--seed 0] [--write]

Pairs are views of random parts of our own making (60 %: turned anywhere, cropped to 50 to 100 %, sampled
independently, noise to 1 %), of shapes with no one right answer (20 %: sphere, cylinder, plane, box) and of two
different parts (20 %). Right means within 5 degrees and 0.05 of the truth; two different parts are never right. Half of
the pairs fit, the other half check, and with --write all of them fit the shipped coefficients.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import astuple
from pathlib import Path

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from scipy.optimize import minimize

import idam
from idam.data.parts import View, partial_views, random_part
from idam.figures.curves import calibrate

FILE = Path(idam.__file__).parent / "confidence.json"
Array = NDArray[np.float64]


def make_view(rng: np.random.Generator) -> tuple[View, str]:
    """One pair and its kind: part, ambiguous or unrelated."""
    kind = str(rng.choice(["part", "ambiguous", "unrelated"], p=[0.6, 0.2, 0.2]))
    keep, noise = rng.uniform(0.5, 1.0), rng.uniform(0, 0.01)
    if kind == "ambiguous":
        shapes = [
            trimesh.creation.icosphere(4, 1.0),
            trimesh.creation.cylinder(0.4, 1.6, sections=64),
            trimesh.creation.box((1.4, 1.0, 1e-3)),
            trimesh.creation.box((1.0, 1.0, 1.0)),
        ]
        return partial_views(shapes[rng.integers(len(shapes))], rng, 4000, keep, noise), kind
    view = partial_views(random_part(rng), rng, int(rng.integers(1500, 8000)), keep, noise)
    if kind == "unrelated":
        other = partial_views(random_part(rng), rng, len(view.target), keep, noise)
        return View(view.source, other.target, view.transformation), kind
    return view, kind


def is_right(estimate: Array, view: View) -> bool:
    """Within 5 degrees, and 0.05 at the source's centre."""
    cosine = (np.trace(estimate[:3, :3].T @ view.transformation[:3, :3]) - 1) / 2
    centre = np.append(view.source.mean(0), 1.0)
    shift = np.linalg.norm((estimate @ centre - view.transformation @ centre)[:3])
    return bool(cosine >= np.cos(np.radians(5)) and shift <= 0.05)


def fit(evidence: Array, right: Array) -> Array:
    """Bias and weights of the logistic function, by maximum likelihood with a little shrinkage."""
    design = np.c_[np.ones(len(evidence)), evidence]

    def loss(w: Array) -> float:
        logit = design @ w
        return float((np.logaddexp(0, logit) - right * logit).sum() + 0.01 * (w[1:] ** 2).sum())

    return np.asarray(minimize(loss, np.zeros(design.shape[1])).x)


def main() -> None:
    """Measure, fit, print, and write with --write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=240)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--write", action="store_true")
    arguments = parser.parse_args()
    rng = np.random.default_rng(arguments.seed)
    evidence, right, kinds = [], [], []
    for _ in range(arguments.pairs):
        view, kind = make_view(rng)
        result = idam.register(view.source, view.target)
        evidence.append(astuple(result.evidence))
        right.append(kind != "unrelated" and is_right(result.transformation, view))
        kinds.append(kind)
    x, y = np.array(evidence, float), np.array(right, float)
    for kind in ("part", "ambiguous", "unrelated"):
        rows = np.array(kinds) == kind
        print(f"{kind:<10} {rows.sum():>4} pairs, {y[rows].mean():.2f} right")
    half = len(y) // 2
    w = fit(x[:half], y[:half])
    probability = 1 / (1 + np.exp(-(w[0] + x[half:] @ w[1:])))
    sure = probability >= 0.9
    error = calibrate(torch.from_numpy(probability), torch.from_numpy(y[half:])).error
    print(
        f"held-back half: calibration error {error:.3f}; {sure.sum()} sure, {y[half:][sure].mean():.3f} of them right"
    )
    coefficients = [round(float(c), 4) for c in fit(x, y)]
    print("coefficients", coefficients)
    if arguments.write:
        about = f"benchmarks/calibrate_confidence.py --pairs {arguments.pairs} --seed {arguments.seed}"
        FILE.write_text(json.dumps({"about": about, "calibration_error": error, "coefficients": coefficients}) + "\n")


if __name__ == "__main__":
    main()
