"""What makes one IDAM different from another."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["Config"]


@dataclass(frozen=True)
class Config:
    """What makes one IDAM different from another; the defaults are the paper's.

    Attributes:
        features: ``gnn`` (appendix A), ``fpfh`` or ``invariant``.
        neighbours: K of the GNN's graph.
        normal_radius: radius of FPFH's normals, in the cloud's units.
        feature_radius: radius of FPFH's histograms, in the cloud's units.
        channels: channels of the similarity convolution.
        blocks: iterations that have weights of their own.
        iterations: iterations run; those past ``blocks`` use the last block's weights again.
        keep: share of each cloud's points that hard elimination keeps.
        keep_again: shares to try next, in turn, where the validity says that the matches are not to be trusted: each
            from where the best try so far led, with twice the iterations; and with features that do not change with the
            pose, from the start before that. Empty is the paper's inference. Beyond it, since of two clouds' most
            significant points too few may be the same: the validity notices, and more points, or features that have
            become more alike, mend it.
        trusted: mean validity of the last iteration's matches from which no other try is made.
        keep_matches: share of matches that hybrid elimination keeps.
        soft_matches: match a point to its row's expectation (the mean of the target, weighted by similarity) rather
            than to the row's best target point.
        convolution: score pairs by the similarity matrix convolution; without it, by features' inner products.
        hard_elimination: keep the most significant points; without it, random ones.
        hybrid_elimination: weigh matches by their validity; without it, all alike.
    """

    features: str = "gnn"
    neighbours: int = 12
    normal_radius: float = 0.1
    feature_radius: float = 0.2
    channels: int = 32
    blocks: int = 3
    iterations: int = 3
    keep: float = 1 / 6
    keep_again: tuple[float, ...] = ()
    trusted: float = 0.9
    keep_matches: float = 0.5
    soft_matches: bool = False
    convolution: bool = True
    hard_elimination: bool = True
    hybrid_elimination: bool = True
