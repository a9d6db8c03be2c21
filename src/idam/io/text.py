"""Tables of numbers as text: XYZ, TXT, ASC, CSV and PTS."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from idam.errors import InputError
from idam.io.cloud import PointCloud, joined
from idam.io.columns import (
    Numbers,
    check_size,
    cloud_from_columns,
    cloud_from_table,
    has_angles,
    has_positions,
    log,
    looks_like_colors,
    looks_like_normals,
    position_names,
    without_windows_nan,
)
from idam.io.numerals import find_marks, is_number, parse_column, strange

__all__ = ["decode", "decode_pts", "encode_csv", "encode_pts", "encode_xyz"]

_BYTE_ORDER_MARKS = {b"\xef\xbb\xbf": "utf-8-sig", b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16"}
_SLASHES = re.compile(r"(^|[ \t,;])//", re.MULTILINE)
_COMMENT = re.compile(r'("[^"]*")|(?:^|(?<=[\s,;]))#.*')
_COMMA_BY_SPACE = re.compile(r",\s|\s,")
_DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?")
_BEFORE_EMPTY_FIELD = re.compile(r",(?=[ \t]*(?:,|$))", re.MULTILINE)
_IN_BRACKETS = re.compile(r"\s*([\[({][^\])}]*[\])}])")
_NAME_THEM = "name the columns in a first line, such as x y z"


@dataclass(frozen=True)
class _Header:
    names: list[str] | None
    from_comment: bool
    count: int | None
    first: int  # the line that holds the first point


def decode(data: bytes) -> PointCloud:
    """Read a text file with a point a line: coordinates, and what the header names or the columns look like.

    Columns stand apart by white space, commas or semicolons; ``#`` and ``//`` start a comment. The names of columns may
    stand in the first line, or in a comment before the first number, and the number of points before the first point.
    Columns of text are left out.

    Raises:
        InputError: a line is no point or can be read in two ways, or there are no finite coordinates.
    """
    return joined(_decode_blocks(data))


def decode_pts(data: bytes) -> list[PointCloud]:
    """Read the scans of a PTS file, each after the number of its points, with intensities where it has them."""
    return [_with_intensity(cloud) for cloud in _decode_blocks(data)]


def encode_xyz(cloud: PointCloud) -> bytes:
    """Write lines of x y z, then red green blue, then the normal, then, under a comment with the names, all else."""
    columns = _columns(cloud)
    names = "# " + " ".join(map(_one_word, columns)) + "\n" if cloud.attributes else ""
    return names.encode() + _lines(columns.values(), " ")


def encode_csv(cloud: PointCloud) -> bytes:
    """Do as :func:`encode_xyz`, separated by commas, under a line with the names of the columns."""
    columns = _columns(cloud)
    return ",".join(map(_one_word, columns)).encode() + b"\n" + _lines(columns.values(), ",")


def encode_pts(cloud: PointCloud) -> bytes:
    """Write the number of points, then lines of x y z, and intensity (0 if unknown) red green blue if there are any."""
    columns = [*cloud.points.T]
    intensity = next((values for name, values in cloud.attributes.items() if name.casefold() == "intensity"), None)
    if cloud.colors is not None or intensity is not None:
        columns.append(np.zeros(len(cloud.points), np.uint8) if intensity is None else intensity)
    if cloud.colors is not None:
        columns += [*cloud.colors.T]
    return f"{len(cloud.points)}\n".encode() + _lines(columns, " ")


def _decode_blocks(data: bytes) -> list[PointCloud]:
    lines = _split_lines(data)
    header = _parse_header(lines)
    spans = list(_spans(lines, header))
    return [_decode_lines(lines, start, stop, header) for start, stop in spans]


def _split_lines(data: bytes) -> list[str]:
    encoding = next((name for mark, name in _BYTE_ORDER_MARKS.items() if data.startswith(mark)), "utf-8")
    if b"\0" in data and encoding != "utf-16":
        raise InputError("not a text file (it holds zero bytes): check what it is")
    if encoding != "utf-16":
        data = without_windows_nan(data)
    try:
        text = data.decode(encoding)
    except UnicodeDecodeError:
        text = data.decode("latin-1")
    return _SLASHES.sub(r"\1#", text.replace("\r\n", "\n").replace("\r", "\n")).split("\n")


def _parse_header(lines: list[str]) -> _Header:
    """Find the names of columns and the number of points, if given, and which line holds the first point."""
    names = count = None
    from_comment = False
    for index, line in enumerate(lines):
        is_comment = line.lstrip().startswith("#")
        line = line.lstrip(" \t#") if is_comment else _without_comment(line)
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
        elif numbers < len(words) and (numbers < 3 or has_positions(_names(line))):
            names, from_comment = _names(line), False
            if not has_positions(names) and not has_angles(names):
                raise InputError(f"line {index + 1} is neither numbers nor names of columns: write lines of x y z")
        else:
            return _Header(names, from_comment, count, index)
    raise InputError("holds no points: export it again")


def _names(line: str) -> list[str]:
    """Split the names of columns, each with its unit."""
    glued = _IN_BRACKETS.sub(lambda match: match[1].replace(" ", "").replace(",", "."), line)
    words = _words(glued)
    if "\t" in glued and not has_positions(words):
        words = [word.strip(" \"'") for word in glued.split("\t")]
    return words


def _words(line: str) -> list[str]:
    """Split a line; an empty field between commas counts, so that names and numbers stay in step."""
    separator = " "
    if ";" in line:
        separator = ";"
    elif "," in line and not _has_decimal_commas(line):
        separator = "\t" if "\t" in line and not _COMMA_BY_SPACE.search(line) else ","
    words = _split(line, separator)
    while words and not words[-1]:
        words.pop()
    return words


def _without_comment(line: str) -> str:
    return _COMMENT.sub(lambda match: match[1] or "", line)


def _split(line: str, separator: str) -> list[str]:
    if separator == " ":
        line = " ".join(line.split("\t")).strip()
    words = next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])
    return [word.strip() for word in words]


def _has_decimal_commas(line: str) -> bool:
    return all(_DECIMAL_COMMA.fullmatch(word) or (is_number(word) and "," not in word) for word in line.split())


def _spans(lines: list[str], header: _Header) -> Iterator[tuple[int, int]]:
    """Find the first and past-the-last line of each scan; without counts, all lines are one."""
    if header.count is None:
        yield header.first, len(lines)
        return
    rows = [at for at in range(header.first, len(lines)) if (line := lines[at].lstrip()) and not line.startswith("#")]
    place, count = 0, header.count
    while True:
        check_size(count, len(rows) - place, f"{count:,} points", "lines")
        if count:
            yield rows[place], rows[place + count - 1] + 1
        place += count
        if place == len(rows):
            return
        word = lines[rows[place]].strip()
        if not word.isdecimal():
            raise InputError(
                f"line {rows[place] + 1} is one more than the {count:,} points that it says it has: correct the number"
            )
        place, count = place + 1, int(word)


def _decode_lines(lines: list[str], start: int, stop: int, header: _Header) -> PointCloud:
    block = lines[start:stop]
    has_quotes = any('"' in line for line in block)
    table = None if has_quotes else _plain_table(block)
    if table is None:
        return _decode_fields(lines, start, stop, header)
    while table.shape[1] > 3 and np.isnan(table[:, -1]).all():  # a comma at the end of each line
        table = table[:, :-1]
    _check_width(table.shape[1])
    names = _names_for(header, table.shape[1], _counts(table[:, 0]))
    if names is None:
        _refuse_two_readings(table, commas="," in block[0] and ";" not in block[0], text="\n".join(block[:10_000]))
        return cloud_from_table(table)
    return cloud_from_columns(dict(zip(names, table.T[-len(names) :], strict=True)))


def _plain_table(lines: list[str]) -> Numbers | None:
    """Read rows of plain numbers; None if they are not all of them."""
    first = lines[0].partition("#")[0]
    delimiter = None
    if ";" in first or "," in first:
        text = "\n".join(["", *lines])
        has_decimal_commas = ";" in first or _has_decimal_commas(first)
        if has_decimal_commas and "," in text:
            if "." in text:
                return None
            text = text.replace(",", ".")
        if ";" in first or not has_decimal_commas:
            delimiter = ","
            text = _BEFORE_EMPTY_FIELD.sub(",nan", text.replace(";", ",")).replace("\n,", "\nnan,")
        lines = text.split("\n")[1:]
    try:
        return np.loadtxt(lines, np.float64, comments="#", ndmin=2, delimiter=delimiter)
    except ValueError:
        return None


def _decode_fields(lines: list[str], start: int, stop: int, header: _Header) -> PointCloud:
    """Read rows with quotes, text or unusual numbers: slower, field by field."""
    numbered = [(at + 1, line) for at in range(start, stop) if (line := _without_comment(lines[at]).strip())]
    separator = _separator([line for _, line in numbered])
    rows = [_split(line, separator) for _, line in numbered]
    widths = [len(row) for row in rows]
    if separator != " " and all(not row[-1] for row in rows):  # a separator at the end of each line
        rows = [row[:-1] for row in rows]
        widths = [width - 1 for width in widths]
    for (at, _), width in zip(numbered, widths, strict=True):
        if width != widths[0]:
            raise InputError(
                f"damaged: the number of columns changed from {widths[0]} to {width} at line {at}: "
                "mend that line or export it again"
            )
    columns = [list(column) for column in zip(*rows, strict=True)]
    is_name = all(line.startswith('"') for _, line in numbered) or all(not is_number(word) for word in columns[0])
    names = _names_for(header, len(columns), is_name or _counts_up(columns[0]))
    if names is not None:
        columns = columns[-len(names) :]
    faults = [strange(column) for column in columns]
    wanted = _needed(columns, names, faults)
    for place in wanted:
        fault = faults[place]
        if fault is not None:
            raise InputError(
                f"damaged: '{columns[place][fault][:40]}' in line {numbered[fault][0]} is no number: mend that line"
            )
    numeric = [place for place, fault in enumerate(faults) if fault is None]
    decimal, thousands = find_marks(
        (word for place in numeric for word in columns[place]), commas_separate=separator == ","
    )
    numbers = {place: parse_column(columns[place], decimal, thousands) for place in numeric}
    left_out = [names[place] if names else f"{place + 1}" for place in range(len(columns)) if place not in numbers]
    if left_out:
        log.info("left out columns that hold text: %s", ", ".join(left_out)[:200])
    if names is not None:
        return cloud_from_columns({names[place]: values for place, values in numbers.items()})
    table = np.stack([*numbers.values()], axis=1)
    _check_width(table.shape[1])
    _refuse_two_readings(table, commas=separator == ",", text="\n".join(line for _, line in numbered[:10_000]))
    return cloud_from_table(table)


def _needed(columns: list[list[str]], names: list[str] | None, faults: list[int | None]) -> list[int]:
    """The columns that must be numbers: coordinates; without names, the first three of which any row is a number."""
    if names is not None:
        return [names.index(name) for name in position_names(names)]
    return [place for place, column in enumerate(columns) if faults[place] is None or any(map(is_number, column))][:3]


def _separator(lines: list[str]) -> str:
    outside = [re.sub(r'"[^"]*"', '""', line) for line in lines]
    if any(";" in line for line in outside):
        return ";"
    if all("\t" in line for line in outside) and not any(map(_COMMA_BY_SPACE.search, outside)):
        return "\t"
    if any("," in line for line in outside) and not all(map(_has_decimal_commas, outside)):
        return ","
    return " "


def _names_for(header: _Header, width: int, first_is_name: bool) -> list[str] | None:
    """The names of the last columns of so many, or None if there are none; one more column may be the rows' names."""
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
    raise InputError(
        f"its first line names {len(names)} columns but its rows hold {width}: name every column, "
        "and write numbers with decimal points"
    )


def _says_xyz(words: list[str], width: int) -> bool:
    """Whether a comment that does not name each column says that the coordinates come first."""
    plain = [word.strip(",.:;()").casefold() for word in words]
    at = next((at for at in range(len(plain)) if plain[at : at + 3] == ["x", "y", "z"]), None)
    return at == 0 or (at is not None and width == 3)


def _check_width(width: int) -> None:
    if width < 3:
        raise InputError(f"its lines hold {width} numbers, expected x y z: export it with coordinates")


def _counts(column: Numbers) -> bool:
    """Whether a column numbers the rows from 0 or from 1."""
    return bool(column[0] in (0, 1) and (column == column[0] + np.arange(len(column))).all())


def _counts_up(fields: list[str]) -> bool:
    return all(word.isdecimal() for word in fields) and _counts(np.array(fields, np.float64))


def _refuse_two_readings(table: Numbers, commas: bool, text: str) -> None:
    """Refuse columns without names that may well not be x y z."""
    rows, width = table.shape
    if rows >= 3 and width >= 4 and _counts(table[:, 0]):
        raise InputError(f"its first column seems to number the rows, not to be x: {_NAME_THEM}, such as number x y z")
    if rows >= 3 and width >= 5 and _is_grid(table):
        raise InputError(
            "its first two columns seem to be a scanner's rows and columns: name the columns in a first line, "
            "such as row column x y z, or x y z and what follows"
        )
    if commas and width >= 5 and (table == np.round(table)).all():
        fractions = table[:, 1::2]
        if not looks_like_colors(table[:, 3:6]) or (fractions <= 9).all() or re.search(r",0\d", text):
            raise InputError(
                "its commas can be read in two ways (between fields or before decimals): "
                f"write numbers with decimal points, or {_NAME_THEM}"
            )


def _is_grid(table: Numbers) -> bool:
    """Whether the first two columns run like rows and columns of a scanner's grid, as FARO exports them."""
    indices, rest = table[:, :2], table[:, 2:5]
    if not ((indices >= 0) & (indices == np.round(indices)) & (indices < 1e5)).all() or (rest == np.round(rest)).all():
        return False
    if table.shape[1] >= 6 and looks_like_normals(table[:, 3:6]):
        return False
    steps = np.diff(indices, axis=0)
    return any(((slow > 0) | ((slow == 0) & (fast > 0))).all() for slow, fast in (steps.T, steps.T[::-1]))


def _with_intensity(cloud: PointCloud) -> PointCloud:
    attributes = {"intensity" if name == "column_4" else name: each for name, each in cloud.attributes.items()}
    return replace(cloud, attributes=attributes)


def _columns(cloud: PointCloud) -> Mapping[str, Numbers]:
    columns: dict[str, Numbers] = dict(zip("xyz", cloud.points.T, strict=True))
    if cloud.colors is not None:
        columns |= dict(zip(("red", "green", "blue"), cloud.colors.T, strict=True))
    if cloud.normals is not None:
        columns |= dict(zip(("nx", "ny", "nz"), cloud.normals.T, strict=True))
    return columns | {name: values for name, values in cloud.attributes.items() if name not in columns}


def _one_word(name: str) -> str:
    return re.sub(r'[\s,;"#]+', "_", name.strip()) or "unnamed"


def _lines(columns: Iterable[Numbers], separator: str) -> bytes:
    """Write a line a row, every number in the shortest form that reads back the same."""
    rows = zip(*(column.tolist() for column in columns), strict=True)
    return "".join(separator.join(map(repr, row)) + "\n" for row in rows).encode()
