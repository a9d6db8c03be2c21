"""Pages of made-up pairs: written, taken apart, and opened in a browser."""

from __future__ import annotations

import base64
import html
import json
import re
import shutil
import subprocess
import zlib
from collections.abc import Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from answers import made_up
from idam.io import PointCloud
from idam.report.page import write_report
from idam.report.record import Record
from idam.result import Hypothesis, Matches, RegistrationResult

HERE = (0.0, 0.0, 0.0)
NATIONAL_GRID = (512_300.0, 5_403_200.0, 320.0)
RECORD = Record((1234, None), {"max-angle": 90.0, "init": None}, "m", datetime(2026, 1, 2, 3, 4, tzinfo=timezone.utc))


def bumpy_torus(count: int, seed: int) -> np.ndarray:
    around, across = np.random.default_rng(seed).uniform(0, 2 * np.pi, (2, count))
    radius = 2 + 0.7 * np.cos(across) + 0.1 * np.sin(5 * around)
    return np.stack([radius * np.cos(around), radius * np.sin(around), 0.7 * np.sin(across)], axis=1)


def make_pair(
    count: int = 400,
    *,
    source_at: tuple[float, float, float] = HERE,
    target_at: tuple[float, float, float] = HERE,
    match_count: int = 24,
    confidence: float = 0.873,
    model: str = "gnn-unseen-shapes",
    reason: str = "",
    hypotheses: Sequence[Hypothesis] = (),
) -> tuple[PointCloud, PointCloud, RegistrationResult]:
    rng = np.random.default_rng(0)
    rotation = np.array([[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1.0]])
    target = bumpy_torus(count, seed=1) + target_at
    source = bumpy_torus(count, seed=2) @ rotation + source_at
    transformation = np.eye(4)
    transformation[:3, :3] = rotation
    transformation[:3, 3] = np.asarray(target_at) - rotation @ np.asarray(source_at)
    rows = rng.integers(count, size=match_count)
    weight = np.where(rng.random(match_count) < 0.3, 0.0, rng.random(match_count))
    matches = Matches(source[rows], target[rows], weight / max(weight.sum(), 1))
    result = made_up(
        source,
        target,
        transformation,
        confidence=confidence,
        converged=confidence >= 0.5,
        reason=reason,
        hypotheses=list(hypotheses),
        matches=matches,
        model=model,
        seconds=0.042,
        clouds=(source, target),
    )
    return PointCloud(source), PointCloud(target), result


def write(path: Path, *pair: Any, source_name: str = "source.ply", target_name: str = "target.ply") -> str:
    write_report(path, *(pair or make_pair()), source_name=source_name, target_name=target_name, record=RECORD)
    return path.read_text(encoding="utf-8")


def scene_of(page: str) -> dict[str, Any]:
    text = re.search(r'<script type="application/json" id="scene">(.*?)</script>', page, re.DOTALL)
    assert text
    scene: dict[str, Any] = json.loads(text[1])
    return scene


def decode(text: str, dtype: str, columns: int) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), dtype).reshape(-1, columns).astype(np.float64)


def unpacked(text: str, size: int) -> np.ndarray:
    """Unsigned integers (N, 3) of so many bytes each, as the script of the page unpacks them."""
    planes = np.frombuffer(zlib.decompress(base64.b64decode(text)), np.uint8).reshape(size, 3, -1).astype(np.int64)
    differences = (planes * 256 ** np.arange(size)[:, None, None]).sum(0)
    return (differences.cumsum(1) % 256**size).T


def local_points(cloud: dict[str, Any]) -> np.ndarray:
    return (unpacked(cloud["points"], 2) - 32767.5) * cloud["step"]


def near(points: np.ndarray, others: np.ndarray) -> float:
    """The largest distance of a point to the nearest of the others: the page sorts points anew."""
    return float(max(np.abs(others - point).max(1).min() for point in points))


def move(pose: list[list[float]], points: np.ndarray) -> np.ndarray:
    rows = np.array(pose)
    return points @ rows[:, :3].T + rows[:, 3]


INK = """
const ink = () => viewer.views.map(({ canvas }) => {
  const { width, height } = canvas;
  const copy = Object.assign(document.createElement("canvas"), { width, height }).getContext("2d");
  copy.drawImage(canvas, 0, 0);
  const bytes = copy.getImageData(0, 0, width, height).data;
  let orange = 0, blue = 0;
  for (let i = 0; i < bytes.length; i += 4) {
    orange += bytes[i] - bytes[i + 2] > 60;
    blue += bytes[i + 2] - bytes[i] > 60;
  }
  return [orange, blue];
});
const set = (id, value) => {
  element(id).value = value;
  element(id).dispatchEvent(new Event("input", { bubbles: true }));
};
"""
"""Counts the pixels of each cloud in each view."""


def opened(path: Path, page: str, script: str, *, software: bool = True, paper: Path | None = None) -> Any:
    """What a script returns that runs in the page once it is drawn, in a browser without a window."""
    browser = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if browser is None:
        pytest.skip("no chromium or google-chrome on PATH to open the page in")
    run = f"ready.then(() => {{ viewer.draw(); {INK} return (() => {{ {script} }})(); }})"
    tell = ".then((told) => { document.documentElement.dataset.told = JSON.stringify([Painter.name, told]); })"
    path.write_text(f"{page}<script>{run}{tell}</script>", encoding="utf-8")
    flags = "--headless --no-sandbox --use-angle=swiftshader --enable-unsafe-swiftshader --enable-logging=stderr"
    command = [browser, *flags.split(), "--virtual-time-budget=3000", "--window-size=900,700"]
    command += [f"--user-data-dir={path.with_suffix('.profile')}", f"--print-to-pdf={paper}" if paper else "--dump-dom"]
    # without #webgl the page declines emulated WebGL, which is all that a headless browser has
    address = path.as_uri() + ("" if software else "#webgl")
    done = subprocess.run([*command, address], capture_output=True, text=True, timeout=200, check=True)
    assert "CONSOLE" not in done.stderr, done.stderr
    if paper:
        return None
    told = re.search(r'data-told="([^"]*)"', done.stdout)
    assert told, done.stdout[-500:]
    painter, result = json.loads(html.unescape(told[1]))
    if not software and painter == "SoftwarePainter":
        pytest.skip("this browser has no WebGL 2, not even an emulated one")
    return result
