"""Numbers as people write them: with a decimal comma, with marks between thousands, or missing."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from idam.errors import InputError

__all__ = ["find_marks", "has_decimal_commas", "is_number", "parse_column", "strange"]

_NUMBER = re.compile(r"[+-]?(?=[.,]?\d)[\d.,]+(?:[ed][+-]?\d+)?|[+-]?(?:nan|inf|infinity)", re.IGNORECASE)
_DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?")
_FORTRAN = re.compile(r"(?<=[\d.,])d(?=[+-]?\d)")  # 1.5D+02
_MISSING = {"", "na", "n/a", "<na>", "null", "none", "-"}
_GAPS = re.compile("(?<=\\d)[ \u00a0\u202f'\u2019](?=\\d{3}(?!\\d))")  # between thousands

_COMMA_AND_DOT = {
    "thousands": re.compile(r"[+-]?\d{1,3}(?:(?:M\d{3}){2,}|M\d{3}(?=D))(?:D\d*)?(?:e[+-]?\d+)?"),
    "either": re.compile(r"[+-]?[1-9]\d{0,2}M\d{3}"),
    "decimal": re.compile(r"[+-]?(?:\d+|\d{1,3}(?:D\d{3})+|)M\d*(?:e[+-]?\d+)?"),
}
"""What a mark M, with D the other of comma and dot, can be in a number: tried in this order."""


def is_number(word: str) -> bool:
    """Whether a field is a number, as far as one field tells, or says that there is none."""
    word = _GAPS.sub("", word.strip())
    return word.casefold() in _MISSING or _NUMBER.fullmatch(word) is not None


def strange(fields: Sequence[str]) -> int | None:
    """The place of the first field that is no number."""
    return next((place for place, word in enumerate(fields) if not is_number(word)), None)


def find_marks(fields: Iterable[str], commas_separate: bool) -> tuple[str, str]:
    """Find which mark stands before decimals and which between thousands, from all numbers of a file.

    Args:
        fields: the numbers.
        commas_separate: whether fields stand apart by commas, as they do not where a comma is the decimal mark.

    Raises:
        InputError: the numbers can be read in two ways.
    """
    comma, dot = set(), set()
    for word in fields:
        word = _plain(word)
        if "," in word:
            comma.add(_role(word, ",", "."))
        if "." in word:
            dot.add(_role(word, ".", ","))
    if {"decimal", "thousands"} <= comma or {"decimal", "thousands"} <= dot or "decimal" in comma & dot:
        raise InputError("its numbers mix decimal commas and decimal points: write them with points alone")
    if "thousands" in dot or "decimal" in comma:
        return ",", "."
    if "thousands" in comma or "decimal" in dot or not comma:
        return ".", ","
    if dot or commas_separate:
        raise InputError(
            "its numbers can be read in two ways (a comma before decimals or between thousands): "
            "write them with decimal points and nothing between thousands"
        )
    return ",", "."  # a comma that does not separate fields is a decimal comma, unless something says otherwise


def parse_column(fields: Sequence[str], decimal: str, thousands: str) -> NDArray[np.float64]:
    """Read numbers with these marks; a missing one becomes NaN."""
    words = map(_plain, fields)
    plain = ("nan" if word in _MISSING else word.replace(thousands, "").replace(decimal, ".") for word in words)
    return np.fromiter(map(float, plain), np.float64, len(fields))


def has_decimal_commas(line: str) -> bool:
    """Whether the words of a line are numbers, those with a comma having a decimal one."""
    return all(_DECIMAL_COMMA.fullmatch(word) or (is_number(word) and "," not in word) for word in line.split())


def _plain(word: str) -> str:
    """A number in small letters, without gaps between thousands, and with e before its exponent."""
    return _FORTRAN.sub("e", _GAPS.sub("", word.strip()).casefold())


def _role(word: str, mark: str, other: str) -> str:
    text = word.replace(mark, "M").replace(other, "D")
    for role, pattern in _COMMA_AND_DOT.items():
        if pattern.fullmatch(text):
            return role
    raise InputError(f"'{word[:40]}' is no number: write numbers with decimal points")
