"""What methods are measured on: the paper's experiments (section 4), one closer to practice, or anyone's own pairs."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from idam.errors import InputError
from idam.lab.data.modelnet40 import experiment_shapes
from idam.lab.data.own_pairs import LocatedPairs, read_own_pairs
from idam.lab.data.pairs import EXPERIMENTS, Pairs, experiment_noise, fixed_pairs
from idam.lab.data.practice import fixed_practice_pairs
from idam.lab.evaluation.metrics import WITHIN

__all__ = ["AXISYMMETRIC", "TABLES", "TEST_SEED", "TestSet", "read_pairs", "test_set"]

TEST_SEED = 1
"""Of the test pairs: with the index, all that they depend on."""

TABLES = (*EXPERIMENTS, "ablation", "practice", "practice-any-rotation")
"""The paper's experiments, ablation, and disjoint halves (:mod:`idam.lab.data.practice`) of any rotation or less."""

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
        within: degrees and distance up to which an answer counts as right.
    """

    __test__ = False  # not a test of pytest's

    name: str
    pairs: Pairs | LocatedPairs
    checksum: str
    labels: Tensor | None = None
    whole: Tensor | None = None
    within: tuple[float, float] = WITHIN

    def __len__(self) -> int:
        return len(self.pairs)

    def first(self, count: int) -> TestSet:
        """The first pairs alone."""
        labels, whole = (None if part is None else part[:count] for part in (self.labels, self.whole))
        return TestSet(self.name, self.pairs[:count], self.checksum, labels, whole, self.within)

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


def read_pairs(path: str | Path, within: tuple[float, float] | None = None) -> TestSet:
    """Pairs of one's own (:func:`idam.lab.data.own_pairs.read_own_pairs`).

    Args:
        path: the file.
        within: degrees and distance up to which an answer counts as right; None for the file's, or 5 and 0.05.

    Raises:
        InputError: the file is missing or not of its form, or the bounds are not positive numbers.
    """
    if within is not None and not (within[0] > 0 and within[1] > 0):
        raise InputError(f"cannot count answers within {within[0]:g} degrees and {within[1]:g}: both must be positive")
    own = read_own_pairs(path)
    pairs = own.located()
    checksum = _checksum(*pairs.source, *pairs.target, pairs.rotation, pairs.translation)
    return TestSet(str(path), pairs, checksum, within=within or own.within or WITHIN)
