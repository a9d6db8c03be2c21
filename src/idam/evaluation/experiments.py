"""Running methods over pairs: the paper's experiments (section 4), or anyone's own pairs."""

from __future__ import annotations

import time
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from idam.data.modelnet40 import experiment_shapes
from idam.data.pairs import EXPERIMENTS, Pairs, experiment_noise, fixed_pairs
from idam.errors import InputError
from idam.evaluation.methods import Method
from idam.evaluation.metrics import Metrics, measure

__all__ = ["TEST_SEED", "Row", "read_pairs", "run", "test_pairs"]

TEST_SEED = 1
"""Of the test pairs: with the index, all that they depend on."""


@dataclass(frozen=True)
class Row:
    """One method on one set of pairs.

    Attributes:
        method: its name.
        model: the weights it used, if it was given any by name.
        metrics: its errors.
        seconds_per_pair: median wall-clock time.
        pairs: how many.
    """

    method: str
    model: str | None
    metrics: Metrics
    seconds_per_pair: float
    pairs: int

    def to_dict(self) -> dict[str, Any]:
        """One flat record, for JSON."""
        return {
            "method": self.method,
            "model": self.model,
            "pairs": self.pairs,
            **self.metrics.to_dict(),
            "seconds_per_pair": self.seconds_per_pair,
        }


def test_pairs(experiment: str, folder: str | Path) -> Pairs:
    """The test pairs of an experiment, the same on every machine.

    Raises:
        InputError: there is no such experiment, or the folder does not hold ModelNet40.
    """
    if experiment not in EXPERIMENTS:
        raise InputError(f"unknown experiment {experiment!r}: choose {', '.join(EXPERIMENTS)}")
    shapes = experiment_shapes(experiment, folder, "test")
    return fixed_pairs(shapes.points, TEST_SEED, experiment_noise(experiment))


def read_pairs(path: str | Path) -> Pairs:
    """Pairs from an ``.npz`` with ``source`` (n, P, 3), ``target`` (n, Q, 3), ``R`` (n, 3, 3) and ``t`` (n, 3).

    Raises:
        InputError: the file is missing, or not of that form.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file; give an .npz of pairs")
    try:
        # NumPy does not close a file that it opened and found to be broken
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file, np.errstate(over="ignore"):
            arrays = [np.asarray(file[key], np.float32) for key in ("source", "target", "R", "t")]
    except KeyError as error:
        raise InputError(f"{path}: {error.args[0]}; it needs the arrays source, target, R and t") from None
    except (OSError, TypeError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: cannot be read as .npz ({error})") from None
    source, target, rotation, translation = arrays
    count = len(source) if source.ndim == 3 else -1
    expected = [(count, source.shape[1] if source.ndim == 3 else 0, 3), (count, -1, 3), (count, 3, 3), (count, 3)]
    for name, array, shape in zip(("source", "target", "R", "t"), arrays, expected, strict=True):
        fits = len(array.shape) == len(shape) and all(b in (-1, a) for a, b in zip(array.shape, shape, strict=True))
        if not fits or count < 1:
            raise InputError(
                f"{path}: {name} has shape {array.shape}; needed are (n, P, 3), (n, Q, 3), (n, 3, 3), (n, 3)"
            )
        if not np.isfinite(array).all():
            raise InputError(f"{path}: {name} holds NaN or infinite numbers")
    if min(source.shape[1], target.shape[1]) < 3:
        raise InputError(f"{path}: a pair needs 3 points of each cloud or more; give larger clouds")
    if np.abs(rotation @ rotation.swapaxes(1, 2) - np.eye(3)).max() > 1e-3 or np.linalg.det(rotation).min() < 0:
        raise InputError(f"{path}: R holds matrices that are no rotations; needed are orthogonal ones, determinant 1")
    return Pairs(*(torch.from_numpy(array) for array in (source, target, rotation, translation)))


def run(name: str, method: Method, pairs: Pairs, model: str | None, advance: Callable[[], None]) -> Row:
    """Register every pair on its own, as a user would, and measure.

    Args:
        name: of the method, for the row.
        method: what registers.
        pairs: on the CPU.
        model: the weights' name, for the row.
        advance: called after each pair.
    """
    estimates, seconds = [], []
    for source, target in zip(pairs.source.numpy(), pairs.target.numpy(), strict=True):
        started = time.perf_counter()
        estimates.append(method(source, target))
        seconds.append(time.perf_counter() - started)
        advance()
    transformation = torch.from_numpy(np.stack(estimates))
    metrics = measure(transformation[:, :3, :3], transformation[:, :3, 3], pairs.rotation, pairs.translation)
    return Row(name, model, metrics, float(np.median(seconds)), len(pairs))
