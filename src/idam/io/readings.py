"""Columns without names that can be read in two ways: refused, with the way to write them."""

from __future__ import annotations

import re

import numpy as np

from idam.errors import InputError
from idam.io.columns import Numbers, looks_like_colors, looks_like_normals
from idam.io.header import NAME_THEM

__all__ = ["counts", "refuse_two_readings"]

# three numbers and more with commas between thousands, unquoted: 412,341.066,5,412,336.049,350.2
_THOUSANDS = re.compile(r"\s*(?:[+-]?\d{1,3}(?:,\d{3})*\.\d+\s*(?:,|$)\s*){3}.*")
_GROUPED = re.compile(r"(?<![\d.])\d{1,3},\d{3}(?:,\d{3})*\.\d")

LARGEST = 1e8
"""What no coordinate reaches in metres (the Earth's circumference is 4e7), but times in seconds since 1970 do."""


def refuse_two_readings(table: Numbers, commas: bool, lines: list[str]) -> None:
    """Refuse columns (N, width) without names that may well not be x, y, z and what follows.

    Args:
        table: the numbers.
        commas: whether they stand apart by commas.
        lines: the text of some rows.

    Raises:
        InputError: there are two readings.
    """
    rows, width = table.shape
    if rows > 1 and (table[0] == np.arange(width)).all() and not any(map(_is_whole, table[1:].T)):
        raise InputError(
            f"its first line (0 1 2) may be a point or number the columns: {NAME_THEM} x y z, or remove it"
        )
    if width < 4:
        return
    if rows >= 3 and (np.diff(table[:, 0]) == 1).all() and _is_whole(table[:, 0]):
        raise InputError(f"its first column seems to number the rows, not to be x: {NAME_THEM} number x y z")
    if rows >= 2 and _is_whole(table[:, 0]) and not any(map(_is_whole, table[:, 1:4].T)):
        raise InputError(
            f"its first column alone holds whole numbers, which seem to be no x: {NAME_THEM} number x y z, "
            "or x y z and what follows"
        )
    known = table[np.isfinite(table[:, :4]).all(axis=1), :4]
    if len(known) and known[:, 0].min() > LARGEST > np.abs(known[:, 1:]).max():
        raise InputError(f"its first column seems to be a time, not x: {NAME_THEM} time x y z")
    if width >= 5 and rows >= 3 and _is_grid(table):
        raise InputError(
            f"its first two columns seem to be a scanner's rows and columns: {NAME_THEM} row column x y z, "
            "or x y z and what follows"
        )
    if commas and width >= 5 and _has_two_commas(table, lines):
        raise InputError(
            "its commas can be read in two ways (between fields, before decimals or between thousands): "
            f"write numbers with decimal points and nothing between thousands, or {NAME_THEM} x,y,z"
        )


def counts(column: Numbers) -> bool:
    """Whether a column numbers the rows from 0 or from 1."""
    return bool(column[0] in (0, 1) and (column == column[0] + np.arange(len(column))).all())


def _is_whole(values: Numbers) -> bool:
    known = values[np.isfinite(values)]
    return bool((known == np.round(known)).all())


def _has_two_commas(table: Numbers, lines: list[str]) -> bool:
    """Whether commas may be decimal ones, or stand between thousands."""
    if (table == np.round(table)).all():
        fractions = table[:, 1::2]
        is_decimal = (fractions <= 9).all() or any(re.search(r",0\d", line) for line in lines)
        return bool(is_decimal) or not looks_like_colors(table[:, 3:6])
    return all(_THOUSANDS.fullmatch(line) and _GROUPED.search(line) for line in lines if line.strip())


def _is_grid(table: Numbers) -> bool:
    """Whether the first two columns look like rows and columns of a scanner's grid, as FARO exports them."""
    indices, rest = table[:, :2], table[:, 2:5]
    if not ((indices >= 0) & (indices == np.round(indices)) & (indices < 1e5)).all() or (rest == np.round(rest)).all():
        return False
    if table.shape[1] >= 6 and looks_like_normals(table[:, 3:6]):
        return False
    return len(np.unique(indices @ [1e5, 1.0])) == len(indices)  # a cell is there once
