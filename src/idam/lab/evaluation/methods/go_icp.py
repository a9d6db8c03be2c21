"""Go-ICP (Yang et al., PAMI 2016): the authors' program, compiled with g++ on its first use."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from idam.errors import MissingDependencyError
from idam.lab.evaluation.methods import Method
from idam.lab.settings import with_settings

__all__ = ["Settings", "build"]


@dataclass(frozen=True)
class Settings:
    """What the method takes.

    Attributes:
        points: of the source, drawn at random, that the branch and bound works on: its time grows with them.
        trim: share of the source's points without a counterpart in the target.
    """

    points: int = 200
    trim: float = 0.2


def build(model: str | None, settings: Sequence[str]) -> Method:
    """Go-ICP on a random part of the source's points, over all rotations."""
    chosen = with_settings(Settings(), settings)
    try:
        match: Any = import_module("py_simple_go_icp_interface.main").go_icp_match_raw
    except ImportError:
        raise MissingDependencyError(
            "this method needs Go-ICP, and g++ to compile it: pip install 'idam[benchmark]'"
        ) from None

    def run(source: NDArray[np.float32], target: NDArray[np.float32]) -> NDArray[np.float64]:
        transformation = np.eye(4)
        with contextlib.redirect_stdout(io.StringIO()):
            transformation[:3, :3], transformation[:3, 3] = match(
                target, source, random_seed=0, random_downsample=chosen.points, trimFraction=chosen.trim
            )
        return transformation

    return run
