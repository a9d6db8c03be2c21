"""``register`` and ``prepare``: from two clouds of any size to one transform."""

from __future__ import annotations

import logging
import math
import os
import time
from numbers import Integral, Real
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from idam import rigid
from idam.align import METHODS
from idam.clouds.prepared import FINE, SMALL, Prepared
from idam.clouds.pyramid import Pyramid
from idam.errors import InputError
from idam.io import as_point_cloud, rigid_fault
from idam.models import resolve
from idam.result import RegistrationResult
from idam.rigid import Array
from idam.search.doubt import doubt
from idam.search.judge import CONVERGED, confidence
from idam.solution import solve

__all__ = ["prepare", "register"]

log = logging.getLogger(__name__)

Refinement = Literal["gicp", "plane", "point", "symmetric", "none"]


def register(
    source: Any,
    target: Any,
    *,
    model: str | os.PathLike[str] = "default",
    init: ArrayLike | None = None,
    max_angle: float = 180.0,
    voxel_size: float | None = None,
    max_correspondence_distance: float | None = None,
    refine: Refinement | None = "gicp",
    seed: int = 0,
    device: str | None = None,
) -> RegistrationResult:
    """Find the rigid transform that takes the source to the target.

    Args:
        source: a path, an (N, 3) array or tensor, an Open3D or trimesh cloud, or what :func:`prepare` returned; in any
            unit, of any size.
        target: likewise, in the same unit.
        model: name of a descriptor's weights (:func:`idam.list_models`), or the path of a file of them. A network of
            the paper, whose name begins with ``gnn`` or ``fpfh``, is asked besides and needs PyTorch: give its name
            alone, or after a descriptor's as in ``practice-any-rotation+gnn-practice``.
        init: (4, 4), a guess of the transform: an answer to consider, and what ``max_angle`` is measured from.
        max_angle: largest rotation of the answer in degrees, from the guess where there is one: of a symmetric object's
            poses it can rule out all but one. The last refinement may go a little past it. At 90 and less, a network of
            the paper, where one is named, chooses among poses that look alike.
        voxel_size: of the clouds that matches are sought in, in the input's units; None takes it from the data.
        max_correspondence_distance: for fitness, RMSE and correspondences, in the input's units; None for one and a
            half spacings of the points of the last refinement.
        refine: fine alignment, ``gicp`` (``symmetric`` for clouds of up to 1024 points), ``plane``, ``point`` or
            ``symmetric``; None or ``none`` for the search's answer alone.
        seed: has no effect: nothing is drawn at random.
        device: where a network of the paper runs; None for the CPU.

    Returns:
        The transform in float64, how well it fits, and how sure it is.

    Raises:
        InputError: a ValueError, in one line: a file that cannot be read, a wrong shape, too few points, NaN or
            infinity, points all equal or on one line, or an unknown model or option.
        MissingDependencyError: a network of the paper is named, and PyTorch is not installed.
    """
    started = time.perf_counter()
    check_options(max_angle, voxel_size, max_correspondence_distance, refine, seed)
    models = resolve(model, device)
    clouds = prepared(source, "source"), prepared(target, "target")
    guess = None if init is None else as_rigid(init)
    # always in one direction, so that swapping the clouds inverts the answer exactly
    exchanged = order(clouds[1]) < order(clouds[0])
    if exchanged:
        guess = None if guess is None else rigid.inverse(guess)
        solution = solve(Pyramid(*clouds[::-1], voxel_size), models.reversed(), guess, max_angle, refine).inverted()
    else:
        solution = solve(Pyramid(*clouds, voxel_size), models, guess, max_angle, refine)
    sure = confidence(solution.evidence)
    best, *others = solution.answers
    rival = None if solution.rival is None else solution.answers[solution.rival].transformation
    result = RegistrationResult(
        transformation=best.transformation,
        fitness=solution.fitness,
        inlier_rmse=solution.inlier_rmse,
        confidence=sure,
        converged=sure >= CONVERGED,
        reason="" if sure >= CONVERGED else doubt(solution.evidence, best.transformation, rival, clouds[0].centre),
        evidence=solution.evidence,
        hypotheses=others,
        max_correspondence_distance=solution.distance,
        information=solution.information,
        strength=solution.strength,
        scale=solution.scale,
        matches=solution.matches,
        model=models.name,
        seconds=time.perf_counter() - started,
        clouds=(clouds[0].points, clouds[1].points),
    )
    if max_correspondence_distance is not None:
        result = result.measured(float(max_correspondence_distance))
    log.info("registered after %.2f s", time.perf_counter() - started)
    return result


def prepare(cloud: Any, *, model: str | os.PathLike[str] = "default") -> Prepared:
    """Do all that depends on one cloud alone, for clouds that are registered more than once.

    Args:
        cloud: whatever :func:`register` takes.
        model: name or file of the descriptor that is to describe it.

    Returns:
        The cloud for :func:`register`, which gives the same answer to the last bit; to save with
        :meth:`~idam.clouds.prepared.Prepared.save`.

    Raises:
        InputError: as of :func:`register`.
    """
    descriptor, ready = resolve(model).descriptor, prepared(cloud, "cloud")
    small = ready.level(ready.voxel_size(SMALL))
    small.described(descriptor, small.spacing_rung)
    fine = ready.level(ready.voxel_size(FINE))
    for level in (small, fine):
        level.surface(ready.unit)
    return ready


def check_options(
    max_angle: float, voxel_size: float | None, distance: float | None, refine: str | None, seed: int
) -> None:
    """Raise InputError for options out of range."""
    if not (_is_number(max_angle) and 0 < max_angle <= 180):
        raise InputError(f"max_angle must be a number of degrees above 0 and at most 180, not {_shown(max_angle)}")
    for name, value in (("voxel_size", voxel_size), ("max_correspondence_distance", distance)):
        if value is not None and not (_is_number(value) and math.isfinite(value) and value > 0):
            raise InputError(
                f"{name} must be a positive number, not {_shown(value)}; leave it out to take it from the data"
            )
    if refine is not None and not (isinstance(refine, str) and refine in ("none", *METHODS)):
        raise InputError(f"unknown refinement {_shown(refine)}: choose {', '.join(METHODS)} or none")
    if not (isinstance(seed, Integral) and _is_number(seed) and abs(int(seed)) < 2**63):
        raise InputError(f"seed must be a whole number below 2^63, not {_shown(seed)}")


def _shown(value: Any) -> str:
    """Any value on one line of bearable length."""
    return " ".join(repr(value).split())[:60]


def _is_number(value: Any) -> bool:
    """Whether it is a real number, which to Python True is, too."""
    return isinstance(value, Real) and not isinstance(value, bool)


def prepared(data: Any, name: str) -> Prepared:
    """Anything that :func:`register` takes, checked and ready; raise InputError where it cannot be used."""
    if isinstance(data, Prepared):
        return data
    if isinstance(data, (str, os.PathLike)) and os.fspath(data).endswith(".idam"):
        return Prepared.load(data)
    if isinstance(data, (str, os.PathLike)):
        points, name = as_point_cloud(data).points, os.fspath(data)
    else:
        try:
            points = as_point_cloud(data).points
        except InputError as error:
            raise InputError(f"{name}: {error}") from error
    return Prepared.of(points, name)


def as_rigid(init: ArrayLike) -> Array:
    """A given transform as (4, 4) float64; raise InputError where it is not rigid."""
    try:
        matrix = np.asarray(init, np.float64)
    except (TypeError, ValueError):
        raise InputError("init must be a 4x4 matrix of numbers") from None
    fault = rigid_fault(matrix)
    if fault:
        raise InputError(f"init is not a rigid transform: {fault}")
    return rigid.transform(rigid.nearest_rotation(matrix[:3, :3]), matrix[:3, 3])


def order(cloud: Prepared) -> tuple[int, float, list[float]]:
    """What sorts two clouds, the smaller first: by what no pose changes, and only where that is equal by the pose."""
    return len(cloud.points), cloud.radius, [*cloud.centre.tolist(), *cloud.points[0].tolist()]
