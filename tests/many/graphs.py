"""Made-up graphs of scans, whose poses and wrong links are known."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from idam import rigid
from idam.many.graph import Links
from idam.rigid import Array

SPREAD = 0.01
"""Standard deviation of a right link, in radians and in radii of a scan."""


class Made(NamedTuple):
    poses: Array
    links: Links
    wrong: NDArray[np.bool_]


def made(
    count: int,
    *,
    partners: int = 8,
    wrong: float = 0.3,
    seed: int = 0,
    lost: tuple[int, ...] = (),
) -> Made:
    """Scans in a flat box, each linked to its nearest; a share of the links wrong, and all links of the lost scans.

    Confidences are what a calibrated judge gives: mostly high for right links and low for wrong ones, some the reverse.
    """
    random = np.random.default_rng(seed)
    poses = rigid.exp(np.concatenate([random.normal(scale=1.5, size=(count, 3)), np.zeros((count, 3))], 1))
    poses[:, :3, 3] = random.uniform(-5, 5, (count, 3)) * [1, 1, 0.2]
    apart = np.linalg.norm(poses[:, None, :3, 3] - poses[:, :3, 3], axis=-1)
    near = np.argsort(apart, axis=1)[:, 1 : partners + 1]
    pairs = sorted({(min(i, j), max(i, j)) for i in range(count) for j in near[i].tolist()})
    source, target = np.array(pairs).T
    is_wrong = (random.random(len(pairs)) < wrong) | np.isin(source, lost) | np.isin(target, lost)
    right = rigid.inverse(poses[target]) @ poses[source] @ rigid.exp(random.normal(scale=SPREAD, size=(len(pairs), 6)))
    anything = rigid.exp(np.concatenate([random.normal(scale=2, size=(len(pairs), 3)), np.zeros((len(pairs), 3))], 1))
    anything[:, :3, 3] = random.normal(scale=2, size=(len(pairs), 3))
    confidence = np.where(is_wrong, random.beta(1, 3, len(pairs)), random.beta(5, 1, len(pairs)))
    measured = np.where(is_wrong[:, None, None], anything, right)
    return Made(poses, Links(source, target, measured, information(len(pairs)), confidence), is_wrong)


def information(count: int) -> Array:
    return np.tile(np.eye(6) / SPREAD**2, (count, 1, 1))


def links_of(entries: list[tuple[int, int, Array, float]]) -> Links:
    """Links from (source, target, measured, confidence)."""
    source, target = np.array([entry[:2] for entry in entries], np.int64).T
    measured = np.stack([entry[2] for entry in entries])
    return Links(source, target, measured, information(len(entries)), np.array([entry[3] for entry in entries]))


def errors(truth: Array, poses: Array) -> Array:
    """How far the poses of N scans are off, (N,), once one of the scans is aligned: the one that suits most."""
    off = [
        np.linalg.norm(rigid.log(rigid.inverse(truth) @ (true @ rigid.inverse(pose)) @ poses), axis=-1)
        for true, pose in zip(truth, poses, strict=True)
    ]
    return min(off, key=lambda values: float(np.median(values)))
