"""The rows of the tables: methods that register one pair, by name, imported when first asked for."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib import import_module

import numpy as np
from numpy.typing import NDArray

from idam.errors import InputError

__all__ = ["ABLATION", "METHODS", "Method", "build_method", "has_weights", "rows_of"]

Method = Callable[[NDArray[np.float32], NDArray[np.float32]], NDArray[np.float64]]
"""Source (P, 3) and target (Q, 3) to the transform (4, 4) that moves the source onto the target."""

PAPER = ("iterations=3", f"keep={1 / 6}", "keep_again=", "keep_matches=0.5", "soft_matches=false")
"""The paper's inference, whatever a model's own."""

ABLATION = ("ablation-bs", "ablation-sm", "ablation-ha-sm", "ablation-full")
"""Rows of the ablation (section 4.6): the baseline, and one part more with each. The package has no weights for them:
``benchmarks/ablation.py`` makes them."""

WITHOUT_WEIGHTS = ("classical", "go_icp", "kiss")
"""Modules of methods that nothing is learnt for."""

METHODS: dict[str, tuple[str, tuple[str, ...]]] = {
    "icp": ("classical:icp", ()),
    "go-icp": ("go_icp:build", ()),
    "fgr": ("classical:fgr", ()),
    "fgr-tuned": ("classical:fgr", ("normal_radius=0.2", "feature_radius=0.35")),
    "fpfh-ransac": ("classical:ransac", ()),
    "fpfh-ransac-tuned": ("classical:ransac", ("ransac_distance=0.02",)),
    "fpfh-ransac-icp-tuned": ("classical:ransac", ("icp_after=0.05",)),
    "kiss-matcher": ("kiss:build", ()),
    "kiss-matcher-tuned": ("kiss:build", ("voxel_size=0.03",)),
    "fpfh-idam-paper": ("network:fpfh", PAPER),
    "gnn-idam-paper": ("network:gnn", PAPER),
    "fpfh-idam": ("network:fpfh", ()),
    "gnn-idam": ("network:gnn", ()),
    "gnn-idam-icp": ("network:gnn_then_icp", ()),
    "register": ("pipeline:build", ()),
    "register-90": ("pipeline:build", ("max_angle=90",)),
    **dict.fromkeys(ABLATION, ("network:ablation", PAPER)),
}
"""The function that makes each method, in a module beside this one, and the settings of its row."""


def rows_of(table: str) -> list[str]:
    """Names of the methods that make up a table."""
    return [name for name in METHODS if (name in ABLATION) == (table == "ablation")]


def has_weights(name: str) -> bool:
    """Whether a method takes weights; of one's own, it says so itself when it is built."""
    return ":" in name or (name in METHODS and METHODS[name][0].split(":")[0] not in WITHOUT_WEIGHTS)


def build_method(name: str, model: str | None = None, settings: Sequence[str] = ()) -> Method:
    """The method of that name, with the named weights where it has any.

    Args:
        name: one of :data:`METHODS`, or ``package.module:function`` (:func:`idam.lab.evaluation.methods.own.build`).
        model: name or file of weights; None for the method's own choice.
        settings: of the method, each ``NAME=VALUE``, after those of its row.

    Raises:
        InputError: no method, model or setting has that name.
        MissingDependencyError: what the method stands on is not installed, or its weights are not there.
    """
    if ":" in name:
        own_method: Method = import_module(f"{__name__}.own").build(name, model, settings)
        return own_method
    if name not in METHODS:
        raise InputError(
            f"unknown method {name!r}: choose {', '.join(METHODS)}, or give your own package.module:function"
        )
    place, own = METHODS[name]
    module, function = place.split(":")
    build = getattr(import_module(f"{__name__}.{module}"), function)
    method: Method = build(model, (*own, *settings))
    return method
