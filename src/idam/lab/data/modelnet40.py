"""ModelNet40 in its public HDF5 layout (``modelnet40_ply_hdf5_2048``)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from idam.errors import InputError, MissingDependencyError

__all__ = ["Shapes", "experiment_shapes", "import_h5py", "load"]

POINTS = 1024
"""Points used of each shape (section 4)."""


@dataclass(frozen=True)
class Shapes:
    """Points (S, 1024, 3), float32 in the unit sphere, and labels (S,), 0 to 39 in alphabetical order of the names."""

    points: Tensor
    labels: Tensor

    def __len__(self) -> int:
        return len(self.points)

    def select(self, mask: Tensor) -> Shapes:
        """The shapes where the mask (S,) is true."""
        return Shapes(self.points[mask], self.labels[mask])


def import_h5py() -> Any:
    """The module that reads the files; raise MissingDependencyError where it is not installed."""
    try:
        import h5py
    except ImportError as error:
        raise MissingDependencyError("reading ModelNet40 needs h5py: pip install 'idam[train]'") from error
    return h5py


def load(folder: str | Path, split: str) -> Shapes:
    """Read the ``train`` or ``test`` split.

    Args:
        folder: holds ``train_files.txt`` and the ``.h5`` files they name, or a folder ``modelnet40_ply_hdf5_2048`` that
            does.
        split: ``train`` or ``test``.

    Raises:
        InputError: the folder or one of its files is missing or not in that layout.
        MissingDependencyError: h5py is not installed.
    """
    h5py = import_h5py()
    folder = Path(folder)
    if (folder / "modelnet40_ply_hdf5_2048").is_dir():
        folder = folder / "modelnet40_ply_hdf5_2048"
    index = folder / f"{split}_files.txt"
    if not index.is_file():
        raise InputError(f"{folder}: no {index.name} here; expected the unpacked modelnet40_ply_hdf5_2048 archive")
    points, labels = [], []
    for line in index.read_text().split():
        path = folder / Path(line).name
        try:
            with h5py.File(path) as file:
                points.append(np.asarray(file["data"][:, :POINTS], np.float32))
                labels.append(np.asarray(file["label"], np.int64).reshape(-1))
            if points[-1].shape != (len(labels[-1]), POINTS, 3):
                raise ValueError(f"points of shape {points[-1].shape}, {len(labels[-1])} labels")
        except (OSError, KeyError, TypeError, ValueError) as error:
            raise InputError(f"{path}: cannot be read as ModelNet40 HDF5 ({error}); unpack the archive again") from None
    if not points:
        raise InputError(f"{index}: names no files; unpack the archive again")
    return Shapes(torch.from_numpy(np.concatenate(points)), torch.from_numpy(np.concatenate(labels)))


def experiment_shapes(experiment: str, folder: str | Path, split: str) -> Shapes:
    """The shapes of an experiment's split: all 40 categories, or the first 20 to train and the last 20 to test.

    Raises:
        InputError: the folder does not hold ModelNet40.
    """
    shapes = load(folder, split)
    if experiment != "unseen-categories":
        return shapes
    return shapes.select(shapes.labels < 20 if split == "train" else shapes.labels >= 20)
