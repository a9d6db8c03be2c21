"""Draw the pictures of ``docs/numbers.md`` and measure the figures beside them.

``python examples/draw_numbers.py`` in a clone, with ``idam[figures]``. Four pairs are made up: two views of a machine
part, one that shares little, a corridor without doors, and a box.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure

import idam
from idam import rigid
from idam.demo import scans
from idam.io import read_point_cloud, read_transform
from idam.io.files import write_text
from idam.report.markup import number
from idam.report.palette import SOURCE, TARGET
from idam.report.panels import dot, draw_clouds, empty_grid, legend, project, same_scale
from idam.report.style import look, save_as
from idam.result import chance
from idam.rigid import Array

ROOT = Path(__file__).resolve().parents[1]
DOCS, TRUTH = ROOT / "docs", ROOT / "src" / "idam" / "lab" / "data" / "demo" / "truth.txt"
SHOWN = 4000
"""Points of each cloud in a picture."""

DPI = 100

Pair = tuple[Array, Array, Array]
"""Source (N, 3), target (P, 3), and the true transform (4, 4)."""


def good() -> Pair:
    """Two views of the machine part of the demo."""
    source, target = (read_point_cloud(path).points for path in scans())
    return source, target, read_transform(TRUTH)


def little() -> Pair:
    """One view of the part, cut in two that share a strip."""
    part = read_point_cloud(scans()[0]).points
    random = np.random.default_rng(1)
    along = part @ [1.0, 0.3, 0.0]
    low, high = np.quantile(along, [0.42, 0.5])
    truth = rigid.exp(np.array([0.4, 0.9, -0.5, 0.05, 0.02, -0.03]))
    source, target = (random.permutation(piece)[:6000] for piece in (part[along < high], part[along > low]))
    return rigid.apply(rigid.inverse(truth), source + noise(random, source, 0.0005)), target, truth


def corridor() -> Pair:
    """Scans from two places, 3 m apart, in a corridor with nothing in it but floor, walls and ceiling."""
    random = np.random.default_rng(2)
    truth = rigid.exp(np.array([0.0, 0.0, 0.7, 3.0, 0.0, 0.0]))

    def scan() -> Array:
        half = np.array([10.0, 1.0, 1.3])
        side = random.integers(4, size=12_000)
        points = random.uniform(-half, half, (12_000, 3))
        points[np.arange(12_000), 1 + side // 2] = np.where(side % 2, 1, -1) * half[1 + side // 2]
        return points + noise(random, points, 0.01)

    return rigid.apply(rigid.inverse(rigid.exp(np.array([0, 0, 0.7, 0, 0, 0.0]))), scan()), scan(), truth


def box() -> Pair:
    """A box from all around, which fits itself after half a turn."""
    random = np.random.default_rng(3)
    half = np.array([0.6, 0.4, 0.25])
    truth = rigid.exp(np.array([0.0, 0.0, 0.65, 0.1, 0.0, 0.0]))

    def scan() -> Array:
        areas = np.repeat([half[1] * half[2], half[0] * half[2], half[0] * half[1]], 2)
        face = random.choice(6, 4000, p=areas / areas.sum())
        points = random.uniform(-half, half, (4000, 3))
        points[np.arange(4000), face // 2] = np.where(face % 2, 1, -1) * half[face // 2]
        return points + noise(random, points, 0.002)

    return rigid.apply(rigid.inverse(truth), scan()), scan(), truth


def noise(random: np.random.Generator, points: Array, scale: float) -> Array:
    """Noise of points."""
    return random.normal(scale=scale, size=points.shape)


CASES: dict[str, tuple[str, Callable[[], Pair], int]] = {
    "good": ("a good fit", good, 1),
    "little": ("little overlap", little, 1),
    "corridor": ("an empty corridor", corridor, 2),
    "box": ("a box", box, 2),
}
"""What each pair is called, how it is made, and which axis points up."""


def draw(source: Array, target: Array, result: idam.RegistrationResult, up: int, path: Path) -> None:
    """The answer, and the best of the others where there is one."""
    poses = [("the answer", result.transformation)]
    poses += [(f"another, score {other.score:.2f}", other.transformation) for other in result.hypotheses[:1]]
    random = np.random.default_rng(0)
    few = [random.permutation(points)[:SHOWN] for points in (source, target)]
    with look(), matplotlib.rc_context({"savefig.dpi": DPI}):
        figure = Figure((2.6 * len(poses), 2.6), layout="constrained")
        panels = empty_grid(figure, 1, len(poses))[0]
        for axes, (title, pose) in zip(panels, poses, strict=True):
            moved = project(rigid.apply(pose, few[0]), up)
            draw_clouds(axes, (moved, SOURCE), (project(few[1], up), TARGET), size=1.0)
            axes.set_title(title)
        same_scale(panels)
        legend(figure, [dot(SOURCE, "source"), dot(TARGET, "target")])
        save_as(figure, path)


def measured(pair: Pair, result: idam.RegistrationResult) -> dict[str, str]:
    """The figures of a result, by what the page calls them."""
    source, _, truth = pair
    turned = np.degrees(rigid.angle(truth[:3, :3].T @ result.rotation))
    moved = np.linalg.norm(rigid.apply(result.transformation, source) - rigid.apply(truth, source), axis=1).mean()
    return {
        "off": f"{number(float(turned), 2)}°, {number(float(moved), 2)}",
        "confidence": chance(result.confidence),
        "fitness": f"{result.fitness:.2f}",
        "within": number(result.max_correspondence_distance, 2),
        "inlier RMSE": number(result.inlier_rmse, 2),
        "lead": f"{result.evidence.lead:.1f}",
        "least held": number(float(result.strength.fixed[0]), 2),
        "deviation": number(float(np.sqrt(np.diag(result.covariance)[3:].max())), 2),
        "reason": result.reason or "accepted",
    }


def table(head: str, columns: dict[str, dict[str, str]]) -> str:
    """A table with a row for each pair."""
    names = list(next(iter(columns.values())))
    lines = [[head, *names], ["---"] * (1 + len(names))]
    lines += [[pair, *(figures[name] for name in names)] for pair, figures in columns.items()]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def main() -> None:
    """Draw the pictures, and put the figures into the page."""
    figures, evidence = {}, {}
    for case, (name, make, up) in CASES.items():
        pair = make()
        result = idam.register(pair[0], pair[1])
        draw(pair[0], pair[1], result, up, DOCS / "images" / f"numbers-{case}.png")
        figures[name] = measured(pair, result)
        evidence[name] = {key: number(value + 0.0, 2) for key, value in asdict(result.evidence).items()}
    page = DOCS / "numbers.md"
    text = page.read_text(encoding="utf-8")
    for mark, columns in (("figures", figures), ("evidence", evidence)):
        text = re.sub(
            rf"(?<=<!-- {mark} -->\n).*?(?=<!-- end -->)",
            lambda _, columns=columns: f"\n{table('pair', columns)}\n\n",  # type: ignore[misc]
            text,
            count=1,
            flags=re.DOTALL,
        )
    write_text(page, text)


if __name__ == "__main__":
    main()
