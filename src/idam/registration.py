"""``register``: from two clouds of any size to one transform."""

from __future__ import annotations

import logging
import math
import os
import time
from functools import lru_cache
from numbers import Integral, Real
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from idam.align import METHODS, TOUCHING, align, reaches
from idam.clouds.frame import Frame, check_points, common_frame, without_strays
from idam.clouds.pyramid import build_pyramid
from idam.errors import InputError
from idam.io import as_point_cloud, rigid_fault
from idam.network.model import IDAM
from idam.network.pretrained import find, load_model
from idam.network.propose import nearest_rotation
from idam.result import Hypothesis, Matches, RegistrationResult
from idam.search.confidence import CONVERGED, confidence, doubt
from idam.search.overlap import inliers
from idam.search.stages import inverse, search

__all__ = ["register"]

log = logging.getLogger(__name__)

Points = NDArray[np.float64]

FEW_POINTS = 1024
"""Points of the larger cloud up to which both count as sparse, and are aligned symmetrically."""


def register(
    source: Any,
    target: Any,
    *,
    model: str = "default",
    init: ArrayLike | None = None,
    max_angle: float = 180.0,
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
        model: name of the network's weights (:func:`idam.list_models`), or the path of a file of them.
        init: (4, 4), a guess of the transform: an answer to consider, and where the network's starts turn around.
        max_angle: degrees by which the answer turns at most, from the guess where there is one: of a symmetric thing's
            poses it can rule out all but one. The last refinement may go a little past it. At 90 and less, a model of
            the paper's kind, whose name begins with ``gnn`` or ``fpfh``, has the choice among poses alike.
        voxel_size: of the clouds that matches are sought in, in the input's units; None takes it from the data.
        max_correspondence_distance: for fitness, RMSE and correspondences, in the input's units; None for one and a
            half spacings of the points of the last refinement.
        refine: fine alignment, ``gicp`` (``symmetric`` for clouds of up to 1024 points), ``plane``, ``point`` or
            ``symmetric``; None or ``none`` for the network's answer alone.
        seed: of the starting rotations.
        device: where the network runs; None for the CPU.

    Returns:
        The transform in float64, how well it fits, and how sure it is.

    Raises:
        InputError: a ValueError, in one line: a file that cannot be read, a wrong shape, too few points, NaN or
            infinity, points all equal or on one line, or an unknown model or option.
    """
    started = time.perf_counter()
    check_options(max_angle, voxel_size, max_correspondence_distance, refine, seed)
    source_points, target_points = (as_points(data, name) for data, name in ((source, "source"), (target, "target")))
    network = cached_model(os.fspath(model), device)
    frame = common_frame(source_points, target_points)
    working = without_strays(frame.source(source_points)), without_strays(frame.target(target_points))
    clouds = build_pyramid(*working, voxel_size and voxel_size / frame.scale)
    log.info("points to match: %d + %d", len(clouds.small.source), len(clouds.small.target))
    guess = np.eye(4) if init is None else frame.enter(as_rigid(init))
    method = "symmetric" if refine == "gicp" and clouds.fine.size <= FEW_POINTS else refine or "none"
    # always searched in the same direction, so that swapping the clouds inverts the answer
    if smaller_first(*working):
        found = search(clouds, network, guess, int(seed), method, max_angle)
    else:
        found = search(clouds.swapped(), network, inverse(guess), int(seed), method, max_angle).inverted()
    transformation, information = found.answers[0].transformation, np.zeros((6, 6))
    if method != "none":  # nor are normals of the fine clouds needed
        transformation, information = align(clouds.fine.surfaces, transformation, reaches(method)[1], method)
    full = frame.undo(transformation)
    distance = float(max_correspondence_distance or TOUCHING * clouds.fine.spacing * frame.scale)
    moved = source_points @ full[:3, :3].T + full[:3, 3]
    correspondence_set, rmse = inliers(moved, target_points, distance)
    sure = confidence(found.evidence)
    log.info("last refinement and inliers of all points: done after %.2f s", time.perf_counter() - started)
    return RegistrationResult(
        transformation=full,
        fitness=len(correspondence_set) / len(source_points),
        inlier_rmse=rmse,
        correspondence_set=correspondence_set,
        confidence=sure,
        converged=sure >= CONVERGED,
        reason=doubt(found.evidence) if sure < CONVERGED else "",
        evidence=found.evidence,
        hypotheses=[Hypothesis(frame.undo(other.transformation), other.score) for other in found.answers[1:]],
        max_correspondence_distance=distance,
        information=information,
        matches=in_input_units(found.matches, frame),
        model=model if model == "default" else find(model).stem,
        seconds=time.perf_counter() - started,
    )


def check_options(
    max_angle: float, voxel_size: float | None, distance: float | None, refine: str | None, seed: int
) -> None:
    """Raise InputError for options out of range."""
    if not (isinstance(max_angle, Real) and 0 < max_angle <= 180):
        raise InputError(f"max_angle must be of more than 0 and at most 180 degrees, not {max_angle}")
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


def smaller_first(source: Points, target: Points) -> bool:
    """Whether the source counts as the smaller cloud: the same whatever the poses, the other when they are swapped."""
    sizes = [(len(points), float(np.linalg.norm(points - points.mean(0)))) for points in (source, target)]
    return sizes[0] <= sizes[1]


def in_input_units(matches: Matches, frame: Frame) -> Matches:
    """Working matches in the input's coordinates."""
    return Matches(
        matches.source * frame.scale + frame.source_centre,
        matches.target * frame.scale + frame.target_centre,
        matches.weight,
    )
