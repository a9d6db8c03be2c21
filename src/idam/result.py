"""What a registration returns."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from functools import cached_property
from html import escape
from os import PathLike
from pathlib import PurePath
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from idam import rigid
from idam.clouds.surfaces import nearest_within
from idam.errors import InputError
from idam.rigid import Array, Rows
from idam.search.judge import Evidence
from idam.search.strength import Strength

__all__ = ["Hypothesis", "Matches", "RegistrationResult", "chance"]


@dataclass(frozen=True, eq=False)
class Matches:
    """Matches of points by their features, in the input's coordinates and units.

    Attributes:
        source: points of the source, (M, 3), where the source was given (not moved).
        target: the match of each in the target, (M, 3).
        weight: how well the answer brings each together, (M,), 0 for those it does not, sum 1 (or 0 for all).
    """

    source: Array
    target: Array
    weight: Array


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """Another transform that explains the clouds, though less well.

    Attributes:
        transformation: (4, 4), source to target coordinates, not refined on all points.
        score: of the clouds that were matched (:attr:`idam.search.ranking.Answer.score`); the order is by what the fine
            clouds say, too.
    """

    transformation: Array
    score: float


@dataclass(frozen=True, eq=False)
class RegistrationResult:
    """The rigid transform that takes the source to the target, and how good it is.

    Attributes:
        transformation: (4, 4), maps source coordinates to target coordinates (``T_target_source``).
        fitness: share of the source's points with a target point within ``max_correspondence_distance``, in [0, 1]; of
            the clouds that the last refinement used, or of all points where the caller gave the distance.
        inlier_rmse: root mean square distance of those pairs, in the input's units.
        confidence: probability in [0, 1] that the transform is right.
        converged: whether that is enough to count on: 0.5 or more.
        reason: where it is not, why, in words; else empty.
        evidence: what the confidence was computed from.
        hypotheses: runners-up, the best first: distinct transforms that the search refined and scored as well.
        max_correspondence_distance: the distance the above were measured at, in the input's units.
        information: (6, 6), the inverse of the covariance of x where T exp(x) is the true transform: rotation in
            radians before translation in input units, perturbed from the right in the source's frame, as GTSAM's
            ``Pose3``. Zero where too little overlaps to tell.
        strength: what the data fix of the transform and what they leave free.
        scale: how many times as large as the source the target looks; 1 where the difference is not significant. The
            transform does not scale.
        matches: the feature matches, and how well the answer agrees with each.
        model: names of the weights that answered.
        seconds: wall-clock time it took.
        clouds: the points that were given, (N, 3) and (P, 3).
    """

    transformation: Array
    fitness: float
    inlier_rmse: float
    confidence: float
    converged: bool
    reason: str
    evidence: Evidence
    hypotheses: list[Hypothesis]
    max_correspondence_distance: float
    information: Array
    strength: Strength
    scale: float
    matches: Matches
    model: str
    seconds: float
    clouds: tuple[Array, Array]

    @property
    def rotation(self) -> Array:
        """(3, 3), of the transformation."""
        return self.transformation[:3, :3]

    @property
    def translation(self) -> Array:
        """(3,), of the transformation, in input units."""
        return self.transformation[:3, 3]

    @property
    def remark(self) -> str:
        """What speaks against the input rather than the answer, in words: a difference in scale; else empty."""
        if self.scale == 1.0:
            return ""
        ratio = 1 / self.scale
        kind = "larger" if ratio > 1 else "smaller"
        return f"the source looks {100 * abs(ratio - 1):.0f} % {kind} than the target; the transform does not scale it"

    @property
    def covariance(self) -> Array:
        """(6, 6), the inverse of the information; infinite on the diagonal where there is none."""
        if not self.information.any():
            return np.diag(np.full(6, np.inf))
        return np.asarray(np.linalg.pinv(self.information, hermitian=True))

    @cached_property
    def correspondence_set(self) -> Rows:
        """Rows (C, 2) of source and target points within ``max_correspondence_distance``, worked out when asked for."""
        return self._inliers[0]

    @cached_property
    def _inliers(self) -> tuple[Rows, Array]:
        source, target = self.clouds
        return nearest_within(rigid.apply(self.transformation, source), target, self.max_correspondence_distance)

    def measured(self, distance: float) -> RegistrationResult:
        """The same with fitness and RMSE of all points, within another distance in input units."""
        result = replace(self, max_correspondence_distance=distance)
        pairs, misses = result._inliers
        rmse = float(np.sqrt(np.mean(misses**2))) if len(misses) else 0.0
        final = replace(result, fitness=len(pairs) / len(self.clouds[0]), inlier_rmse=rmse)
        final.__dict__["_inliers"] = pairs, misses  # once is enough
        return final

    def apply(self, points: ArrayLike) -> Array:
        """Points (..., 3) of the source's frame, in the target's frame."""
        moved: Array = np.asarray(points, np.float64) @ self.rotation.T
        return moved + self.translation

    def save(self, path: str | PathLike[str]) -> None:
        """Write the result, atomically: ``.json`` every field of :meth:`to_dict`, ``.txt`` the 4x4 alone.

        Raises:
            InputError: the file has another ending or cannot be written.
        """
        from idam.io import write_json, write_transform

        ending = PurePath(path).suffix.lower()
        if ending == ".txt":
            write_transform(path, self.transformation)
        elif ending == ".json":
            write_json(path, self.to_dict())
        else:
            raise InputError(f"{path}: unknown ending '{ending}': give .json for the whole result, .txt for the 4x4")

    def to_dict(self) -> dict[str, Any]:
        """The result as plain numbers and lists, ready for JSON; without matches and correspondences."""
        return {
            "transformation": self.transformation.tolist(),
            "fitness": self.fitness,
            "inlier_rmse": self.inlier_rmse,
            "max_correspondence_distance": self.max_correspondence_distance,
            "confidence": self.confidence,
            "converged": self.converged,
            "reason": self.reason,
            "remark": self.remark,
            "scale": self.scale,
            "evidence": asdict(self.evidence),
            "hypotheses": [
                {"transformation": other.transformation.tolist(), "score": other.score} for other in self.hypotheses
            ],
            "information": self.information.tolist(),
            "strength": {"motions": self.strength.motions.tolist(), "fixed": self.strength.fixed.tolist()},
            "model": self.model,
            "seconds": self.seconds,
        }

    def __repr__(self) -> str:
        """The essential in a few lines."""
        centroid = self.clouds[0].mean(0)
        shift = float(np.linalg.norm(self.apply(centroid) - centroid))
        lines = [
            f"RegistrationResult: rotation {np.degrees(rigid.angle(self.rotation)):.2f} degrees, "
            f"the source's centroid moves {shift:.4g}",
            f"  confidence {chance(self.confidence)}" + (f": {self.reason}" if self.reason else ""),
            f"  fitness {self.fitness:.3f}, inlier RMSE {self.inlier_rmse:.4g} "
            f"(within {self.max_correspondence_distance:.4g})",
        ]
        if self.remark:
            lines.append(f"  {self.remark}")
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        """The same for a notebook."""
        return f"<pre>{escape(repr(self))}</pre>"


def chance(probability: float) -> str:
    """Write a probability in whole per cent, rounded down, and never as certainty: ``> 99 %``, ``< 1 %``."""
    if probability > 0.99:
        return "> 99 %"
    return "< 1 %" if probability < 0.01 else f"{int(100 * probability + 1e-9)} %"
