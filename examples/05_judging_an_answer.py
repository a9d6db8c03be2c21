"""Judging an answer.

Decide by `converged` and `confidence`, not by fitness. [What each number means](numbers.md) has every figure, what is
good and what to do where it is bad.

`hypotheses` are the runners-up: where a shape repeats itself, one of them may be the answer. `strength` says which
motions the data leave free, `covariance` how precise the answer is. Points on a sphere fit in every pose, and all of
these say so.
"""

import numpy as np

import idam
from idam import rigid
from idam.demo import scans
from idam.result import chance


def verdict(result: idam.RegistrationResult) -> str:
    """What to do with an answer, in words."""
    if result.converged:
        return f"use it ({chance(result.confidence)})"
    turns = [np.degrees(rigid.angle(result.rotation.T @ other.transformation[:3, :3])) for other in result.hypotheses]
    others = ", ".join(f"{turn:.0f} degrees away" for turn in turns)
    return f"look at it: {result.reason}; other answers {others}"


result = idam.register(*scans())
print("machine part:", verdict(result))
assert result.converged

deviations = np.sqrt(np.diag(result.covariance))  # rotation in radians, then translation in metres
print("standard deviations:", np.degrees(deviations[:3]).round(4), "degrees,", deviations[3:].round(6), "m")
print("least held motion:", f"{result.strength.fixed[0]:.2f}", "(near 0 would be free)")

directions = np.random.default_rng(0).normal(size=(2, 3000, 3))
ball, other_ball = directions / np.linalg.norm(directions, axis=2, keepdims=True)
lost = idam.register(ball, other_ball)
print("two balls:", verdict(lost))
assert not lost.converged
assert lost.strength.fixed[0] < result.strength.fixed[0]
