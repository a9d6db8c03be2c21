"""``register``: from two clouds of any size to one transform."""

from __future__ import annotations

import math
import os
import time
from dataclasses import dataclass
from functools import lru_cache
from numbers import Integral, Real
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from idam.confidence import Evidence, confidence
from idam.errors import InputError
from idam.hypotheses import nearest_rotation, propose, starting_rotations
from idam.io import as_point_cloud, rigid_fault
from idam.network.model import IDAM
from idam.network.pretrained import DEFAULT, find, load_model
from idam.preprocess import (
    MIN_POINTS,
    Frame,
    check_points,
    choose_voxel_size,
    common_frame,
    downsample,
    without_strays,
)
from idam.ranking import Answer, Surfaces, distinct, improve
from idam.refine import METHODS, Refinable
from idam.refine import refine as refine_once
from idam.result import Matches, RegistrationResult
from idam.scoring import inliers

__all__ = ["register"]

Points = NDArray[np.float64]

NETWORK_POINTS = 1024
"""Points of the larger cloud that the network sees: what it was trained on."""
DENSE_POINTS = 4096
"""Points of the larger cloud that hypotheses are refined and scored on."""
FINE_POINTS = 30_000
"""Points of the larger cloud that the last refinement uses."""
STARTS = 24
"""Rotations of the source that the network starts from."""
PROPOSERS = (DEFAULT, "fpfh-unseen-shapes")
"""The default's networks: learned features see more of a scan, FPFH does not mind how it is turned."""
FINEST = 1e-4
"""Smallest voxel size, in working units: far below the spacing of the fine clouds, and small_gicp's grid has room."""
CONTENDERS = 4
"""Answers that stay in the race on the dense clouds."""


def register(
    source: Any,
    target: Any,
    *,
    model: str = "default",
    init: ArrayLike | None = None,
    voxel_size: float | None = None,
    max_correspondence_distance: float | None = None,
    refine: str | None = "gicp",
    seed: int = 0,
    device: str | None = None,
) -> RegistrationResult:
    """Find the rigid transform that lays the source on the target.

    Args:
        source: a path, an (N, 3) array or tensor, or an Open3D or trimesh cloud; in any unit, of any size.
        target: likewise, in the same unit.
        model: name of the network's weights (:func:`idam.list_models`), or the path of a file of them; ``default``
            takes the proposals of two networks, on GNN and on FPFH features.
        init: (4, 4), a guess of the transform: an answer to consider, and where the network's starts turn around.
        voxel_size: of the clouds the network sees, in the input's units; None takes it from the data.
        max_correspondence_distance: for fitness, RMSE and correspondences, in the input's units; None for the spacing
            of the points the clouds were scored on.
        refine: fine alignment on the dense clouds, ``gicp``, ``plane`` or ``point``; None or ``none`` for the
            network's answer alone.
        seed: of the starting rotations.
        device: where the network runs; None for the CPU.

    Returns:
        The transform in float64, how well it fits, and how sure it is.

    Raises:
        InputError: a ValueError, in one line: a file that cannot be read, a wrong shape, too few points, NaN or
            infinity, points all equal or on one line, or an unknown model or option.
    """
    started = time.perf_counter()
    check_options(voxel_size, max_correspondence_distance, refine, seed)
    source_points, target_points = (as_points(data, name) for data, name in ((source, "source"), (target, "target")))
    networks = [cached_model(name, device) for name in (PROPOSERS if model == "default" else (os.fspath(model),))]
    frame = common_frame(source_points, target_points)
    small, dense, fine = pyramid(
        without_strays(frame.source(source_points)),
        without_strays(frame.target(target_points)),
        voxel_size and voxel_size / frame.scale,
    )
    guess = np.eye(4) if init is None else frame.enter(as_rigid(init))
    starts = starting_rotations(STARTS, int(seed)) @ torch.as_tensor(guess[:3, :3], dtype=torch.float32)
    hypotheses = [h for network in networks for h in propose(network, small.source, small.target, starts)]
    method = refine or "none"
    answers = [Answer(hypothesis.transformation, hypothesis) for hypothesis in hypotheses]
    if init is not None:
        answers.append(Answer(guess, hypotheses[0]))
    answers = distinct(improve(answers, small.surfaces(), 4.0, method))[:CONTENDERS]
    answers = distinct(improve(answers, dense.surfaces(), 2.0, method))
    transformation, information = finish(answers[0], fine, method)
    full = frame.undo(transformation)
    evidence = gather_evidence(answers, small.spacing)
    distance = float(max_correspondence_distance or dense.spacing * frame.scale)
    moved = source_points @ full[:3, :3].T + full[:3, 3]
    correspondence_set, rmse = inliers(moved, target_points, distance)
    return RegistrationResult(
        transformation=full,
        fitness=len(correspondence_set) / len(source_points),
        inlier_rmse=rmse,
        correspondence_set=correspondence_set,
        confidence=confidence(evidence),
        evidence=evidence,
        max_correspondence_distance=distance,
        information=information,
        matches=in_input_units(answers[0].hypothesis.matches, frame),
        model=model if model == "default" else find(model).stem,
        seconds=time.perf_counter() - started,
    )


def check_options(voxel_size: float | None, distance: float | None, refine: str | None, seed: int) -> None:
    """Raise InputError for options out of range."""
    for name, value in (("voxel_size", voxel_size), ("max_correspondence_distance", distance)):
        if value is not None and not (isinstance(value, Real) and math.isfinite(value) and value > 0):
            raise InputError(f"{name} must be a positive number, not {value}; leave it out to take it from the data")
    if refine not in (None, "none", *METHODS):
        raise InputError(f"unknown refinement {refine!r}: choose {', '.join(METHODS)} or none")
    if not (isinstance(seed, Integral) and abs(int(seed)) < 2**63):
        raise InputError(f"seed must be a whole number below 2^63, not {seed!r}")


def as_points(data: Any, name: str) -> Points:
    """Points (N, 3) of anything that :func:`register` takes, checked; raise InputError where they cannot be used."""
    if isinstance(data, (str, os.PathLike)):
        points, name = as_point_cloud(data).points, os.fspath(data)
    else:
        try:
            points = as_point_cloud(data).points
        except InputError as error:
            raise InputError(f"{name}: {error}") from error
    check_points(points, name)
    return points


def as_rigid(init: ArrayLike) -> Points:
    """A given transform as (4, 4) float64; raise InputError where it is not rigid."""
    try:
        matrix = np.asarray(init, np.float64)
    except (TypeError, ValueError):
        raise InputError("init must be a 4x4 matrix of numbers") from None
    fault = rigid_fault(matrix)
    if fault:
        raise InputError(f"init is not a rigid transform: {fault}")
    return np.block([[nearest_rotation(matrix[:3, :3]), matrix[:3, 3:]], [0.0, 0.0, 0.0, 1.0]])


@lru_cache(4)
def cached_model(name: str, device: str | None) -> IDAM:
    """A model, read from its file the first time only."""
    return load_model(name, device)


@dataclass(frozen=True)
class Level:
    """Both clouds at one resolution, in working coordinates, and the spacing of their points."""

    source: Points
    target: Points
    spacing: float

    def surfaces(self) -> Surfaces:
        """The clouds with normals, ready for refinement."""
        return Surfaces(Refinable.build(self.source), Refinable.build(self.target), self.spacing)


def pyramid(source: Points, target: Points, voxel_size: float | None) -> tuple[Level, Level, Level]:
    """The clouds at three resolutions: for the network, for ranking hypotheses, and for the last refinement."""
    fine = level(source, target, FINE_POINTS)
    dense = level(fine.source, fine.target, DENSE_POINTS)
    if voxel_size is None:
        small = level(dense.source, dense.target, NETWORK_POINTS)
    else:
        voxel_size = max(voxel_size, FINEST)
        few = downsample(fine.source, voxel_size), downsample(fine.target, voxel_size)
        small = Level(few[0], few[1], max(map(spacing, few)))
    for name, points in (("source", small.source), ("target", small.target)):
        if len(points) < MIN_POINTS:
            raise InputError(
                f"{name}: {len(points)} points are left at the network's resolution, at least {MIN_POINTS} are needed; "
                "crop the other cloud to its size, or give a smaller voxel_size"
            )
        if len(points) > DENSE_POINTS:
            raise InputError(
                f"{name}: {len(points)} points are left at this voxel_size, at most {DENSE_POINTS} fit the network; "
                "give a larger voxel_size"
            )
    return small, dense, fine


def level(source: Points, target: Points, count: int) -> Level:
    """Both clouds on one voxel grid that leaves about ``count`` points of the larger."""
    voxel_size = choose_voxel_size([source, target], count)
    if voxel_size > 0:
        source, target = downsample(source, voxel_size), downsample(target, voxel_size)
    else:  # a voxel grid merges copies of a point, too
        source, target = np.unique(source, axis=0), np.unique(target, axis=0)
    return Level(source, target, max(spacing(source), spacing(target)))


def spacing(points: Points) -> float:
    """The median distance of a point to its nearest neighbour that is not at the same place."""
    distance = cKDTree(points).query(points, k=2)[0][:, 1]
    return float(np.median(distance[distance > 0]))


def finish(answer: Answer, fine: Level, method: str) -> tuple[Points, NDArray[np.float64]]:
    """The last refinement, on the fine clouds: a working transform (4, 4) and its information matrix (6, 6)."""
    if method == "none":
        return answer.transformation, np.zeros((6, 6))
    surfaces = fine.surfaces()
    return refine_once(surfaces.source, surfaces.target, answer.transformation, 2.0 * fine.spacing, method)


def gather_evidence(answers: list[Answer], spacing: float) -> Evidence:
    """What speaks for the best answer."""
    best = answers[0]
    matches = best.hypothesis.matches
    moved = matches.source @ best.transformation[:3, :3].T + best.transformation[:3, 3]
    together = np.linalg.norm(moved - matches.target, axis=1) < 2.0 * spacing
    return Evidence(
        overlap=best.overlap,
        margin=best.overlap - (answers[1].overlap if len(answers) > 1 else 0.0),
        support=float(matches.weight[together].sum()),
        votes=best.votes / sum(answer.votes for answer in answers),
    )


def in_input_units(matches: Matches, frame: Frame) -> Matches:
    """Working matches in the input's coordinates."""
    return Matches(
        matches.source * frame.scale + frame.source_centre,
        matches.target * frame.scale + frame.target_centre,
        matches.weight,
    )
