"""KISS-Matcher (Lim et al., ICRA 2025), through its own package."""

from __future__ import annotations

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
        voxel_size: its one parameter, from which it takes all radii and noise bounds; it has no default of use on
            shapes of unit size, and this one is about the spacing of 1024 points there.
    """

    voxel_size: float = 0.05


def build(model: str | None, settings: Sequence[str]) -> Method:
    """KISS-Matcher with its defaults, but for the voxel size."""
    chosen = with_settings(Settings(), settings)
    try:
        kiss: Any = import_module("kiss_matcher")
    except ImportError:
        raise MissingDependencyError("this method needs KISS-Matcher: pip install 'idam[benchmark]'") from None

    def run(source: NDArray[np.float32], target: NDArray[np.float32]) -> NDArray[np.float64]:
        solution = kiss.KISSMatcher(kiss.KISSMatcherConfig(chosen.voxel_size)).estimate(list(source), list(target))
        transformation = np.eye(4)
        transformation[:3, :3] = solution.rotation
        transformation[:3, 3] = solution.translation
        return transformation

    return run
