"""The row of a pair: what ``batch`` keeps of its registration."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from idam.batch.pairs import Pair

if TYPE_CHECKING:
    from idam.result import RegistrationResult

__all__ = ["COLUMNS", "Row", "failed_row", "ok_row"]

Row = dict[str, Any]
"""What JSON holds: text, numbers, lists, None; the keys are :data:`COLUMNS`."""

COLUMNS = (
    "id",
    "source",
    "target",
    "status",
    "error",
    "transformation",
    "confidence",
    "converged",
    "reason",
    "fitness",
    "inlier_rmse",
    "information",
    "seconds",
)


def ok_row(pair: Pair, result: RegistrationResult, seconds: float) -> Row:
    """The row of a pair that was registered, surely or not."""
    return _row(
        pair,
        seconds,
        status="ok",
        transformation=result.transformation.tolist(),
        confidence=float(result.confidence),
        converged=bool(result.converged),
        reason=result.reason,
        fitness=float(result.fitness),
        inlier_rmse=float(result.inlier_rmse),
        information=result.information.tolist(),
    )


def failed_row(pair: Pair, error: str, seconds: float) -> Row:
    """The row of a pair that could not be registered, and why, in one line."""
    return _row(pair, seconds, status="failed", error=" ".join(error.split()))


def _row(pair: Pair, seconds: float, **known: Any) -> Row:
    given = pair.given()
    known |= {"id": pair.id, "source": given["source"], "target": given["target"], "seconds": round(seconds, 6)}
    return {name: _finite(known.get(name)) for name in COLUMNS}


def _finite(value: Any) -> Any:
    """A value without NaN and infinities, which JSON lacks."""
    if isinstance(value, list):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
