"""A robust pose graph: which links between scans to believe, and the poses that agree with them best.

Truncated least squares over SE(3), solved by graduated non-convexity (Yang, Antonante, Tzoumas, Carlone, "Graduated
non-convexity for robust spatial perception", RA-L 2020), with the confidence of each link as its prior.

A link from source s to target t measures ``Z = T_t_s``. With poses X that take each scan to the frame they share, its
residual is the twist ``e = log(Z^-1 X_t^-1 X_s)``, and ``e^T Omega e`` its square in standard deviations.

**The prior.** Let a link be right with probability c. If it is, e is normal with information Omega; if it is not, Z is
anything in a volume V of poses. The likelier of the two is "right" as long as ::

    log c + log sqrt(det(Omega / 2 pi)) - e^T Omega e / 2  >  log(1 - c) - log V
    e^T Omega e  <  2 log(c / (1 - c)) + k,    k = 2 log(V sqrt(det(Omega / 2 pi)))

so that a link costs ``min(e^T Omega e, barrier)`` with a barrier that its log odds shift. Taken at its word, k grows
with the precision of a link and would let a precise one be many standard deviations off, since V is huge; wrong answers
of real scans lie near right ones more often than that. So k is set where a link of even odds is rejected past the 99 %
quantile of a right one, :data:`EVEN_ODDS`. And wrong links are not independent: those of look-alike places agree, and
many of them, each unsure, would outvote one that is sure. So the odds count for more, :data:`PRIOR`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from idam import rigid
from idam.many.elimination import Elimination
from idam.rigid import Array, Rows

__all__ = ["Links", "barriers", "doubted", "jacobians", "optimise", "residuals", "solve", "spanning_forest"]

EVEN_ODDS = 16.81
"""The 99 % quantile of chi-square with six degrees of freedom: the barrier of a link of even odds."""
PRIOR = 2.0
"""The power that the odds are raised to. Of 88 right links among 308 of a building, 21 were rejected with 1, 3 with 2
and 4 with 4."""
DOUBT = 2.0
"""How many times as often as its confidence says a link may be wrong. The judge was fitted to pairs that overlap; most
pairs that are tried here do not, and look-alike places are among them: in a building of 60 scans, 4 of the 85 links of
0.9 and more were wrong, where their confidence says 3, and all of them had less than 0.97."""
SOONER = 1.4
"""By what factor the cost moves on from convex to truncated each time: the paper's."""
SETTLED = 1e-3
"""A weight this near 0 or 1 is decided."""
SETTLING = 10
"""Times that links are weighed anew at most."""
STILL = 1e-6
"""Longest step, in working units and radians, of poses that move no more."""
DAMPING = 1e-7
"""Share of a scan's own information added to it: it holds what no link holds, and a chain of 1000 scans still moves."""


@dataclass(frozen=True)
class Links:
    """L links between scans.

    Attributes:
        source: (L,) rows of scans.
        target: (L,) rows of scans.
        measured: (L, 4, 4), T_target_source.
        information: (L, 6, 6) of T_target_source, rotation before translation, right perturbation.
        confidence: (L,) in [0, 1].
    """

    source: Rows
    target: Rows
    measured: Array
    information: Array
    confidence: Array

    def __len__(self) -> int:
        return len(self.source)

    def __getitem__(self, rows: Any) -> Links:
        return Links(
            self.source[rows], self.target[rows], self.measured[rows], self.information[rows], self.confidence[rows]
        )


def barriers(confidence: Array) -> Array:
    """The squares of the residuals (L,), in standard deviations, past which links are likelier wrong than right.

    Zero and less for a link so unsure that it is not believed however well it agrees.
    """
    c = np.clip(confidence, 1e-9, 1 - 1e-9)
    return np.asarray(EVEN_ODDS + 2 * PRIOR * np.log(c / (1 - c)))


def doubted(confidence: Array) -> Array:
    """Confidences (L,) less the doubt in them."""
    return np.asarray(np.maximum(1 - DOUBT * (1 - confidence), confidence / DOUBT))


def residuals(poses: Array, links: Links) -> Array:
    """The twists (L, 6) by which poses (N, 4, 4) differ from what the links measured."""
    relative = rigid.inverse(poses[links.target]) @ poses[links.source]
    return rigid.log(rigid.inverse(links.measured) @ relative)


def jacobians(poses: Array, links: Links, residual: Array) -> tuple[Array, Array]:
    """How the residuals (L, 6) change when the sources and the targets are perturbed from the right, (L, 6, 6) each.

    With E = Z^-1 X_t^-1 X_s: the source turns E into E exp(x), whose logarithm is e + J_r^-1(e) x; and the target turns
    it into ``E (X_s^-1 X_t) exp(-x) (X_t^-1 X_s) = E exp(-Ad(X_s^-1 X_t) x)``.
    """
    along_source = right_jacobian_inverse(residual)
    back = rigid.inverse(poses[links.source]) @ poses[links.target]
    return along_source, -along_source @ rigid.adjoint(back)


def right_jacobian_inverse(twist: Array) -> Array:
    """J_r^-1 (..., 6, 6) with log(exp(e) exp(x)) = e + J_r^-1(e) x to first order, of twists e (..., 6) below 2 pi.

    ``I + ad / 2 + a ad^2 + b ad^4`` with the adjoint ad of e, exact since ad has a minimal polynomial of degree five
    (Selig, "Geometric fundamentals of robotics", 2005, section 7.5; there for the left one, whose second sign differs).
    """
    rotation, translation = rigid.skew(twist[..., :3]), rigid.skew(twist[..., 3:])
    ad = np.zeros((*twist.shape[:-1], 6, 6))
    ad[..., :3, :3] = ad[..., 3:, 3:] = rotation
    ad[..., 3:, :3] = translation
    x = np.linalg.norm(twist[..., :3], axis=-1)[..., None, None]
    near = x < 0.05  # where the quotients cancel, their series: the next terms are below 1e-10
    safe = np.where(near, 1.0, x)
    sine, cosine = np.sin(safe), 1 - np.cos(safe)
    a = np.where(near, 1 / 12 - x**4 / 30240, 2 / safe**2 - (safe + 3 * sine) / (4 * safe * cosine))
    b = np.where(near, -1 / 720 - x**2 / 15120, 1 / safe**4 - (safe + sine) / (4 * safe**3 * cosine))
    square = ad @ ad
    return np.asarray(np.eye(6) + ad / 2 + a * square + b * square @ square)


def misfit(poses: Array, links: Links) -> Array:
    """The squares of the residuals, in standard deviations, (L,)."""
    return squares(residuals(poses, links), links)


def squares(residual: Array, links: Links) -> Array:
    """e^T Omega e (L,) of residuals (L, 6)."""
    return np.asarray(np.einsum("li,lij,lj->l", residual, links.information, residual))


def spanning_forest(count: int, links: Links, strength: Array) -> list[int]:
    """The links (rows) of a forest of the strongest ones that joins all scans that links join (Kruskal)."""
    root = list(range(count))

    def find(scan: int) -> int:
        while root[scan] != scan:
            root[scan] = root[root[scan]]
            scan = root[scan]
        return scan

    forest = []
    for row in np.argsort(-strength, kind="stable").tolist():
        one, other = find(int(links.source[row])), find(int(links.target[row]))
        if one != other:
            root[one] = other
            forest.append(row)
    return forest


def along(count: int, links: Links, forest: list[int]) -> Array:
    """The poses (N, 4, 4) that follow from the links of a forest, the first scan of each tree at the identity."""
    ways: list[list[tuple[int, Array]]] = [[] for _ in range(count)]
    for row in forest:
        source, target, measured = int(links.source[row]), int(links.target[row]), links.measured[row]
        ways[target].append((source, measured))
        ways[source].append((target, rigid.inverse(measured)))
    poses = np.tile(np.eye(4), (count, 1, 1))
    placed = np.zeros(count, bool)
    for root in range(count):
        waiting = [] if placed[root] else [root]
        placed[root] = True
        while waiting:
            scan = waiting.pop()
            for other, step in ways[scan]:
                if not placed[other]:
                    placed[other] = True
                    poses[other] = poses[scan] @ step
                    waiting.append(other)
    return poses


def solve(
    poses: Array, links: Links, weights: Array, iterations: int = 30, elimination: Elimination | None = None
) -> Array:
    """Poses (N, 4, 4) of the least weighted sum of squares near those given (Levenberg and Marquardt).

    What no link holds stays where it is.
    """
    elimination = elimination or Elimination(len(poses), links.source, links.target)
    residual = residuals(poses, links)
    cost, damping = float(weights @ squares(residual, links)), DAMPING
    for _ in range(iterations):
        step = elimination.solve(*normal_equations(poses, links, weights, residual), damping)
        moved = poses @ rigid.exp(step)
        residual_there = residuals(moved, links)
        cost_there = float(weights @ squares(residual_there, links))
        if not cost_there <= cost:
            damping *= 100
            if damping > 1:
                break
            continue
        done = np.abs(step).max(initial=0) < STILL or cost - cost_there <= 1e-12 * cost
        poses, residual, cost, damping = moved, residual_there, cost_there, max(DAMPING, damping / 100)
        if done:
            break
    return straight(poses)


def normal_equations(poses: Array, links: Links, weights: Array, residual: Array) -> tuple[Array, Array, Array]:
    """The blocks of the normal equations: (N, 6, 6) on the diagonal, (L, 6, 6) source by target, and the right side."""
    source, target = jacobians(poses, links, residual)
    information = weights[:, None, None] * links.information
    held = source.swapaxes(-1, -2) @ information, target.swapaxes(-1, -2) @ information
    diagonal, right = np.zeros((len(poses), 6, 6)), np.zeros((len(poses), 6))
    np.add.at(diagonal, links.source, held[0] @ source)
    np.add.at(diagonal, links.target, held[1] @ target)
    np.add.at(right, links.source, -(held[0] @ residual[..., None])[..., 0])
    np.add.at(right, links.target, -(held[1] @ residual[..., None])[..., 0])
    return diagonal, held[0] @ target, right


def straight(poses: Array) -> Array:
    """Poses whose rotations many products have not worn."""
    return rigid.transform(rigid.nearest_rotation(poses[:, :3, :3]), poses[:, :3, 3])


def optimise(count: int, links: Links, support: Rows) -> tuple[Array, NDArray[np.bool_]]:
    """The poses (N, 4, 4), and which links (L,) they agree with.

    From two starts, the forest of the surest links and that of the links that most loops support: the answer of the
    least :func:`regret`. Each set of scans that links join has a frame of its own.

    Args:
        count: number of scans, N.
        links: between them.
        support: (L,) how many loops of each link close (:class:`idam.many.loops.Loops`).
    """
    barrier = barriers(links.confidence)
    usable = np.flatnonzero(barrier > 0)
    some, barrier = links[usable], barrier[usable]
    elimination = Elimination(count, some.source, some.target)
    orders = some.confidence, some.confidence + support[usable]
    forests = {tuple(spanning_forest(count, some, order)): None for order in orders}
    starts = [along(count, some, list(forest)) for forest in forests]
    ways = graduated, settled
    answers = [
        rejoined(way(poses, some, barrier, elimination), some, barrier, elimination) for poses in starts for way in ways
    ]
    poses = min(answers, key=lambda answer: (regret(answer, some, barrier), truncated(answer, some, barrier)))
    agrees = np.zeros(len(links), bool)
    agrees[usable] = misfit(poses, some) < barrier
    return poses, agrees


def regret(poses: Array, links: Links, barrier: Array) -> float:
    """The log odds of the links that poses reject, as far as these are likely to be right for all doubt.

    What chooses among answers: many unsure links that agree, as those of a building folded onto itself do, sway it less
    than the cost that each answer has minimised. Of 60 scans of a building, with 32 of 363 wrong links above 0.5, the
    largest component has 36 by this and 22 by the cost; all are right in both.
    """
    sure = np.clip(doubted(links.confidence), 0.5, 1 - 1e-9)
    return float(np.log(sure / (1 - sure))[misfit(poses, links) >= barrier].sum())


def truncated(poses: Array, links: Links, barrier: Array) -> float:
    """What truncated least squares minimises."""
    return float(np.minimum(misfit(poses, links), barrier).sum())


def graduated(poses: Array, links: Links, barrier: Array, elimination: Elimination) -> Array:
    """Poses by graduated non-convexity: at first all links pull, at last only those within their barrier."""
    poses = solve(poses, links, np.ones(len(links)), 10, elimination)
    excess = misfit(poses, links) / barrier
    sharpness = 1 / max(2 * float(excess.max(initial=0)) - 1, 1e-3)
    while True:
        weights = tempered(excess, sharpness)
        poses = solve(poses, links, weights, 1, elimination)
        excess = misfit(poses, links) / barrier
        sharpness *= SOONER
        if sharpness > 1 and (np.minimum(weights, 1 - weights) < SETTLED).all():
            return solve(poses, links, (excess < 1).astype(float), 30, elimination)


def settled(poses: Array, links: Links, barrier: Array, elimination: Elimination) -> Array:
    """Poses near those given: at once only links within their barrier pull, until they remain the same ones.

    Where most links are wrong, they may pull graduated non-convexity off a start that was right.
    """
    agrees = misfit(poses, links) < barrier
    for _ in range(SETTLING):
        poses = solve(poses, links, agrees.astype(np.float64), 30, elimination)
        before, agrees = agrees, misfit(poses, links) < barrier
        if (agrees == before).all():
            break
    return poses


def rejoined(poses: Array, links: Links, barrier: Array, elimination: Elimination) -> Array:
    """Poses with all scans joined that links join: a link that was rejected, though nothing else joins its ends, costs.

    Graduated non-convexity can let go of all links of a weakly held part at once.
    """
    while True:
        agrees = misfit(poses, links) < barrier
        forest = spanning_forest(len(poses), links, agrees + links.confidence)
        if agrees[forest].all():
            return poses
        weights = agrees.astype(np.float64)
        weights[forest] = 1.0
        joined = solve(along(len(poses), links, forest), links, weights, 30, elimination)
        joined = solve(joined, links, (misfit(joined, links) < barrier).astype(np.float64), 30, elimination)
        if not truncated(joined, links, barrier) < truncated(poses, links, barrier):
            return poses
        poses = joined


def tempered(excess: Array, sharpness: float) -> Array:
    """The weights (L,) of links whose squared residuals exceed their barriers by factors (L,) (the paper's (14))."""
    low, high = sharpness / (sharpness + 1), (sharpness + 1) / sharpness
    between = np.sqrt(sharpness * (sharpness + 1) / np.clip(excess, low, high)) - sharpness
    return np.where(excess <= low, 1.0, np.where(excess >= high, 0.0, between))
