"""Which test shapes to show: one each of categories spread over the alphabet, so that nobody picked them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from idam.lab.data.modelnet40 import Shapes

__all__ = ["category_names", "one_of_each", "spread", "up_axis"]

BOTTLE = 5
"""The label of ModelNet40's bottles, all of which stand."""


def spread(count: int, wanted: int) -> list[int]:
    """``wanted`` of the indices 0 to ``count`` - 1, evenly spread from first to last; all where there are fewer."""
    return [int(n) for n in np.linspace(0, count - 1, min(count, wanted)).round()]


def one_of_each(labels: Tensor, wanted: int) -> list[int]:
    """The first shape of each of ``wanted`` categories, which are spread evenly over those of ``labels`` (S,)."""
    categories = torch.unique(labels)
    return [int((labels == categories[n]).nonzero()[0]) for n in spread(len(categories), wanted)]


def up_axis(shapes: Shapes) -> int:
    """The axis that points up, which is not the same in all copies of the data: that along which bottles are longest.

    Without bottles it is y, as in the public archive.
    """
    bottles = shapes.points[shapes.labels == BOTTLE]
    return int(bottles.flatten(0, 1).std(0).argmax()) if len(bottles) else 1


def category_names(folder: Path) -> dict[int, str]:
    """Names by label from ModelNet40's ``shape_names.txt``; empty where the folder has none."""
    for path in (folder / "modelnet40_ply_hdf5_2048" / "shape_names.txt", folder / "shape_names.txt"):
        if path.is_file():
            return {
                label: name.replace("_", " ") for label, name in enumerate(path.read_text(errors="replace").split())
            }
    return {}
