"""What a registration returns."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from idam.search.confidence import Evidence

__all__ = ["Hypothesis", "Matches", "RegistrationResult"]


@dataclass(frozen=True)
class Matches:
    """Matches of points by their features, in the input's coordinates and units.

    Attributes:
        source: points of the source, (M, 3), where the source was given (not moved).
        target: the match of each in the target, (M, 3).
        weight: how well the answer brings each together, (M,), 0 for those it does not, sum 1 (or 0 for all).
    """

    source: NDArray[np.float64]
    target: NDArray[np.float64]
    weight: NDArray[np.float64]


@dataclass(frozen=True)
class Hypothesis:
    """Another transform that explains the clouds, though less well.

    Attributes:
        transformation: (4, 4), source to target coordinates, not refined on all points.
        score: what it was ranked by (:attr:`idam.search.ranking.Answer.score`); the answer's is higher, or nearly as high and
            the answer is turned less.
    """

    transformation: NDArray[np.float64]
    score: float


@dataclass(frozen=True)
class RegistrationResult:
    """The rigid transform that lays the source on the target, and how good it is.

    Attributes:
        transformation: (4, 4), maps source coordinates to target coordinates (``T_target_source``).
        fitness: share of the source's points with a target point within ``max_correspondence_distance``, in [0, 1].
        inlier_rmse: root mean square distance of those pairs, in the input's units.
        correspondence_set: (C, 2) rows of source and target of those pairs.
        confidence: probability in [0, 1] that the transform is right.
        converged: whether that is enough to count on: 0.5 or more.
        reason: where it is not, why, in words; else empty.
        evidence: what the confidence was computed from.
        hypotheses: runners-up, the best first: distinct transforms that the search refined and scored as well.
        max_correspondence_distance: the distance the above were measured at, in the input's units.
        information: (6, 6) information matrix of the fine alignment, rotation before translation, in the centred and
            scaled coordinates the alignment ran in; zero if it was off.
        matches: the feature matches, and how well the answer agrees with each.
        model: name of the network's weights.
        seconds: wall-clock time it took.
    """

    transformation: NDArray[np.float64]
    fitness: float
    inlier_rmse: float
    correspondence_set: NDArray[np.int64]
    confidence: float
    converged: bool
    reason: str
    evidence: Evidence = field(repr=False)
    hypotheses: list[Hypothesis] = field(repr=False)
    max_correspondence_distance: float
    information: NDArray[np.float64] = field(repr=False)
    matches: Matches = field(repr=False)
    model: str
    seconds: float

    def apply(self, points: ArrayLike) -> NDArray[np.float64]:
        """Points (..., 3) of the source's frame, in the target's frame."""
        moved: NDArray[np.float64] = np.asarray(points, np.float64) @ self.transformation[:3, :3].T
        return moved + self.transformation[:3, 3]

    def save(self, path: str | PathLike[str]) -> None:
        """Write the result as JSON (every field of :meth:`to_dict`), atomically; ``.txt`` writes the 4x4 alone.

        Raises:
            InputError: the file cannot be written.
        """
        from idam.io import write_json, write_transform

        if str(path).lower().endswith(".txt"):
            write_transform(path, self.transformation)
        else:
            write_json(path, self.to_dict())

    def to_dict(self) -> dict[str, Any]:
        """The result as plain numbers and lists, ready for JSON; without correspondences, which are large."""
        return {
            "transformation": self.transformation.tolist(),
            "fitness": self.fitness,
            "inlier_rmse": self.inlier_rmse,
            "correspondences": len(self.correspondence_set),
            "max_correspondence_distance": self.max_correspondence_distance,
            "confidence": self.confidence,
            "converged": self.converged,
            "reason": self.reason,
            "evidence": asdict(self.evidence),
            "hypotheses": [
                {"transformation": other.transformation.tolist(), "score": other.score} for other in self.hypotheses
            ],
            "information": self.information.tolist(),
            "model": self.model,
            "seconds": self.seconds,
        }
