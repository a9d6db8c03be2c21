"""What makes one IDAM different from another."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from typing import Any

from idam.errors import InputError

__all__ = ["Config", "with_settings"]


@dataclass(frozen=True)
class Config:
    """What makes one IDAM different from another; the defaults are the paper's.

    Attributes:
        features: ``gnn`` (appendix A) or ``fpfh``.
        neighbours: K of the GNN's graph.
        normal_radius: radius of FPFH's normals, in the cloud's units.
        feature_radius: radius of FPFH's histograms, in the cloud's units.
        channels: channels of the similarity convolution.
        blocks: iterations that have weights of their own.
        iterations: iterations run; those past ``blocks`` use the last block's weights again.
        keep: share of each cloud's points that hard elimination keeps.
        keep_again: shares to try next, in turn, where the validity says that the matches are not to be trusted; the
            iterations run twice as often then. Empty is the paper's inference. Beyond it, since of two clouds' most
            significant points too few may be the same: the validity notices, and more points mend it.
        trusted: mean validity of the last iteration's matches from which no other try is made.
        keep_matches: share of matches that hybrid elimination keeps.
        soft_matches: match a point to its row's expectation (the mean of the target, weighted by similarity) rather
            than to the row's best target point.
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


def with_settings(config: Config, settings: Iterable[str]) -> Config:
    """The configuration with some fields set from text, each ``NAME=VALUE``; shares in ``keep_again`` by commas.

    Raises:
        InputError: no field has that name, or the value does not fit it.
    """
    defaults = {f.name: f.default for f in fields(Config)}
    values: dict[str, Any] = {}
    for setting in settings:
        name, separator, text = setting.partition("=")
        if name not in defaults or not separator:
            raise InputError(f"unknown setting {setting!r}: give NAME=VALUE with one of {', '.join(defaults)}")
        try:
            values[name] = _parse(text, defaults[name])
        except (ValueError, KeyError):
            raise InputError(f"setting {setting!r}: {text!r} does not fit; the default is {defaults[name]!r}") from None
    return replace(config, **values)


def _parse(text: str, default: Any) -> Any:
    if isinstance(default, bool):
        return {"true": True, "false": False}[text.lower()]
    if isinstance(default, tuple):
        return tuple(float(share) for share in text.split(",") if share)
    return type(default)(text)
