"""Rigid transforms in and out of files."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from idam.errors import InputError
from idam.io.arrays import parse_npy
from idam.io.files import StrPath, one_line, read_bytes, write_bytes, write_json, write_text
from idam.io.notations import FORMS, parse_json, parse_text

__all__ = ["format_transform", "read_transform", "rigid_fault", "write_transform"]

_LARGEST = 2**20  # bytes: a result of register() takes a few thousand


def read_transform(path: StrPath) -> NDArray[np.float64]:
    """Read a rigid transform (4, 4): text in the notations of :mod:`idam.io.notations`, JSON or NPY.

    JSON is the matrix, or an object with it under "transformation". ``-`` is text from the standard input.

    Raises:
        InputError: the file cannot be read, or holds something else than one rotation and translation.
    """
    data = read_bytes(path)
    if len(data) > _LARGEST:
        raise InputError(f"{path}: {len(data):,} bytes are no 4 x 4 transform: check what it is")
    try:
        with np.errstate(all="ignore"):
            matrix = _DECODERS.get(Path(path).suffix.lower(), _decode_text)(data)
    except InputError as error:
        raise InputError(f"{path}: holds no 4 x 4 transform: {error}") from error
    except Exception as error:  # there is no telling what parsers throw at a damaged file
        raise InputError(f"{path}: holds no 4 x 4 transform ({one_line(error)}): save 4 lines of 4 numbers") from error
    fault = rigid_fault(matrix)
    if fault:
        raise InputError(f"{path}: is not a rigid transform: {fault}")
    return matrix


def format_transform(T: ArrayLike, form: str = "matrix") -> str:
    """Write a transform as 4 lines of 4 numbers, ready to paste into CloudCompare's "Apply transformation".

    It does not fit a cloud that CloudCompare shifted when it opened it (its "global shift"): move the file instead.
    Every number is in the shortest form that reads back the same. ``form`` may be one of
    :data:`idam.io.notations.FORMS` instead.
    """
    return FORMS[form](np.asarray(T, np.float64))


def write_transform(path: StrPath, T: ArrayLike) -> None:
    """Write a transform, atomically, as :func:`read_transform` reads it.

    The extension is the form: .json, .npy, .tum and .kitti (a line each), and 4 lines of text under any other.

    Raises:
        InputError: it cannot be written.
    """
    suffix = Path(path).suffix.lower()
    if suffix == ".json":
        write_json(path, {"transformation": np.asarray(T, np.float64)})
    elif suffix == ".npy":
        stream = io.BytesIO()
        np.save(stream, np.asarray(T, np.float64), allow_pickle=False)
        write_bytes(path, stream.getvalue())
    else:
        form = suffix.removeprefix(".")
        write_text(path, format_transform(T, form if form in ("tum", "kitti") else "matrix") + "\n")


def _decode_json(data: bytes) -> NDArray[np.float64]:
    return parse_json(json.loads(data))


def _decode_npy(data: bytes) -> NDArray[np.float64]:
    return parse_npy(data).astype(np.float64)


def _decode_text(data: bytes) -> NDArray[np.float64]:
    if data.lstrip().startswith(b"{"):
        return _decode_json(data)
    return parse_text(data.decode())


_DECODERS = {".json": _decode_json, ".npy": _decode_npy}


def rigid_fault(matrix: NDArray[np.float64]) -> str:
    """Say what keeps a matrix (4, 4) from being a rigid transform, and how to mend it; empty if nothing does."""
    if matrix.shape != (4, 4):
        return f"expected shape (4, 4), got {matrix.shape}"
    if not np.isfinite(matrix).all():
        return "it holds NaN or infinity: save it again"
    if np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-6:
        return "its last row is not 0 0 0 1: transpose it if the translation stands there"
    rotation = matrix[:3, :3]
    with np.errstate(all="ignore"):  # huge entries overflow
        determinant = np.linalg.det(rotation)
        deviation = np.abs(rotation.T @ rotation - np.eye(3)).max()
    if not deviation <= 1e-3:  # NaN where an overflow met another
        return f"its 3 x 3 part is no rotation (determinant {determinant:.4g}): take scale and shear out of it"
    if determinant < 0:
        return "it mirrors (determinant -1): flip the sign of one axis"
    return ""
