"""What methods are measured on: the paper's experiments (section 4), one closer to practice, or anyone's own pairs."""

from __future__ import annotations

import hashlib
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from idam.errors import InputError
from idam.lab.data.modelnet40 import experiment_shapes
from idam.lab.data.pairs import EXPERIMENTS, Pairs, experiment_noise, fixed_pairs
from idam.lab.data.practice import fixed_practice_pairs

__all__ = ["AXISYMMETRIC", "TABLES", "TEST_SEED", "TestSet", "read_pairs", "test_set"]

TEST_SEED = 1
"""Of the test pairs: with the index, all that they depend on."""

TABLES = (*EXPERIMENTS, "ablation", "practice", "practice-any-rotation")
"""The paper's experiments, its ablation, and disjoint halves (:mod:`idam.lab.data.practice`), small or any rotation."""

AXISYMMETRIC = (5, 6, 9, 10, 15, 19, 34, 37)
"""Labels of bottle, bowl, cone, cup, flower_pot, lamp, tent and vase, whose turn about their axis no one can see."""


@dataclass(frozen=True)
class TestSet:
    """Pairs to measure on.

    Attributes:
        name: of the experiment, or of the file.
        pairs: n of them.
        checksum: of what they were drawn from, the same on every machine.
        labels: of the shapes (n,), where they are ModelNet40's.
        whole: the shapes without noise and cropping, in the source's frame (n, 1024, 3), where they are known.
    """

    __test__ = False  # not a test of pytest's

    name: str
    pairs: Pairs
    checksum: str
    labels: Tensor | None = None
    whole: Tensor | None = None

    def __len__(self) -> int:
        return len(self.pairs)

    def first(self, count: int) -> TestSet:
        """The first pairs alone."""
        labels, whole = (None if part is None else part[:count] for part in (self.labels, self.whole))
        return TestSet(self.name, self.pairs[:count], self.checksum, labels, whole)

    @property
    def observable(self) -> Tensor | None:
        """Which pairs' rotation can be seen (n,): all but those of the axisymmetric categories."""
        return None if self.labels is None else ~torch.isin(self.labels, torch.tensor(AXISYMMETRIC))


def test_set(experiment: str, folder: str | Path) -> TestSet:
    """The test pairs of an experiment, the same on every machine.

    Raises:
        InputError: there is no such experiment, or the folder does not hold ModelNet40.
    """
    if experiment not in TABLES:
        raise InputError(f"unknown experiment {experiment!r}: choose {', '.join(TABLES)}")
    # the ablation is on unseen categories (section 4.6)
    drawn = "unseen-categories" if experiment == "ablation" else experiment
    shapes = experiment_shapes(drawn, folder, "test")
    if drawn in EXPERIMENTS:
        pairs = fixed_pairs(shapes.points, TEST_SEED, experiment_noise(drawn))
    else:
        any_rotation = experiment == "practice-any-rotation"
        pairs = fixed_practice_pairs(shapes.points, TEST_SEED, any_rotation=any_rotation)
    # of the shapes and the drawn translations: what a matrix product has made may differ in its last bit by machine
    return TestSet(experiment, pairs, _checksum(shapes.points, pairs.translation), shapes.labels, shapes.points)


def _checksum(*tensors: Tensor) -> str:
    digest = hashlib.sha256()
    for tensor in tensors:
        digest.update(np.ascontiguousarray(tensor.numpy()).tobytes())
    return digest.hexdigest()[:16]


def read_pairs(path: str | Path) -> TestSet:
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
    source, target, rotation, _ = arrays
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
    tensors = [torch.from_numpy(array) for array in arrays]
    return TestSet(str(path), Pairs(*tensors), _checksum(*tensors))
