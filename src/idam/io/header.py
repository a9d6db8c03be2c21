"""How a text file begins: comments, names of columns with their units, the number of points."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass

from idam.errors import InputError
from idam.io.names import has_angles, has_positions, is_unit
from idam.io.numerals import has_decimal_commas, is_number

__all__ = ["COMMA_BY_SPACE", "NAME_THEM", "Header", "names_for", "parse_header", "split", "without_comment"]

COMMA_BY_SPACE = re.compile(r",\s|\s,")
NAME_THEM = "name the columns in a first line, such as"
_COMMENT = re.compile(r'("[^"]*")|(?:^|(?<=[\s,;]))#.*')
_IN_BRACKETS = re.compile(r"(?<=\w)\s*([\[({][^\])}]*[\])}])")


@dataclass(frozen=True)
class Header:
    """What stands before the first point.

    Attributes:
        names: of the columns, or None.
        from_comment: whether the names stand in a comment, which may be one about the file as well.
        count: the number of points that the file says it has, or None.
        first: the line, from 0, that holds the first point.
    """

    names: list[str] | None
    from_comment: bool
    count: int | None
    first: int


def parse_header(lines: list[str]) -> Header:
    """Find the names of columns and the number of points, if given, and which line holds the first point.

    Raises:
        InputError: a line before the first point is neither, or there is no point.
    """
    names: list[str] | None = None
    count = None
    from_comment = False
    for index, line in enumerate(lines):
        is_comment = line.lstrip().startswith("#")
        line = line.lstrip(" \t#") if is_comment else without_comment(line)
        words = _words(line)
        if not any(words) or (index == 0 and line.startswith("sep=")):  # which tells Excel the separator
            continue
        numbers = sum(map(is_number, words))
        if is_comment:
            header = _names(line)
            if has_positions(header):
                names, from_comment = header, True
        elif len(words) == 1 and count is None and words[0].isdecimal():
            count = int(words[0])
        elif names is not None and not from_comment and len(words) <= len(names) and all(map(is_unit, words)):
            names = [f"{name} [{unit.strip('[](){} ')}]" for name, unit in _paired(names, words)]
        elif names is None and len(words) > 3 and words == ["", *map(str, range(len(words) - 1))]:
            names = ["", "x", "y", "z", *(f"column_{place}" for place in range(4, len(words)))]  # as pandas counts them
        elif numbers < len(words) and (numbers < 3 or has_positions(_names(line))):
            names, from_comment = _names(line), False
            if not has_positions(names) and not has_angles(names):
                raise InputError(
                    f"line {index + 1} ('{line.strip()[:40]}') is neither numbers nor names of columns with "
                    f"x, y and z: remove it, or {NAME_THEM} x y z"
                )
        else:
            return Header(names, from_comment, count, index)
    raise InputError("holds no points: export it again")


def names_for(header: Header, width: int, first_is_name: bool) -> list[str] | None:
    """Give the names of the last columns of so many, or None without any; one more column may be the rows' names.

    Raises:
        InputError: two names are the same, or there are more or fewer names than columns.
    """
    names = header.names
    if names is None:
        return None
    if len({name.casefold() for name in names if name}) < len([name for name in names if name]):
        raise InputError("two of its columns have the same name: rename one in its first line")
    if len(names) == width:
        return [name or f"column_{place + 1}" for place, name in enumerate(names)]
    if header.from_comment:
        if _says_xyz(names, width):
            return None
    elif width == len(names) + 1 and first_is_name:
        return names
    where = "a comment" if header.from_comment else "its first line"
    raise InputError(
        f"{where} names {len(names)} columns but its rows hold {width}: name every column, "
        "and write numbers with decimal points"
    )


def without_comment(line: str) -> str:
    """Leave out what follows a #, but not within quotes."""
    return _COMMENT.sub(lambda match: match[1] or "", line)


def split(line: str, separator: str) -> list[str]:
    """Split a line into fields, of which those in quotes may hold the separator."""
    if separator == " ":
        line = " ".join(line.split("\t")).strip()
    words = next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])
    return [word.strip() for word in words]


def _names(line: str) -> list[str]:
    """Split the names of columns, each with its unit."""
    glued = _IN_BRACKETS.sub(lambda match: match[1].replace(" ", "").replace(",", "."), line)
    between_tabs = [word.strip(" \"'") for word in glued.rstrip().split("\t")]
    return between_tabs if has_positions(between_tabs) else _words(glued)


def _words(line: str) -> list[str]:
    """Split a line; an empty field between commas counts, so that names and numbers stay in step."""
    separator = " "
    if ";" in line:
        separator = ";"
    elif "," in line and not has_decimal_commas(line):
        separator = "\t" if "\t" in line and not COMMA_BY_SPACE.search(line) else ","
    words = split(line, separator)
    while words and not words[-1]:
        words.pop()
    return words


def _paired(names: Sequence[str], units: Sequence[str]) -> list[tuple[str, str]]:
    return [*zip(names, [*units, *[""] * (len(names) - len(units))], strict=True)]


def _says_xyz(words: list[str], width: int) -> bool:
    """Whether a comment that does not name each column says in a sentence that the coordinates come first."""
    plain = [word.strip(",.:;()").casefold() for word in words]
    at = next((at for at in range(len(plain)) if plain[at : at + 3] == ["x", "y", "z"]), None)
    return (at == 0 and len(plain) > 3) or (at is not None and width == 3)
