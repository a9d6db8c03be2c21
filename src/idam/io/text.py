"""Tables of numbers as text: XYZ, TXT, ASC, CSV and PTS."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace

import numpy as np

from idam.errors import InputError
from idam.io.cloud import PointCloud, joined
from idam.io.columns import Numbers, check_size, cloud_from_columns, cloud_from_table, log, without_windows_nan
from idam.io.header import COMMA_BY_SPACE, Header, names_for, parse_header, split, without_comment
from idam.io.names import position_names
from idam.io.numerals import find_marks, has_decimal_commas, is_number, parse_column, strange
from idam.io.readings import counts, refuse_two_readings

__all__ = ["decode", "decode_pts", "encode_csv", "encode_pts", "encode_xyz"]

_BYTE_ORDER_MARKS = {b"\xef\xbb\xbf": "utf-8-sig", b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16"}
# what starts a comment besides #: // anywhere, and in front of a line % or !, or the only semicolon of the line
_COMMENTS = re.compile(r"(^|[ \t,;])//|^[ \t]*(?:[%!]|;(?=[^;\r\n]*$))", re.MULTILINE)
_BEFORE_EMPTY_FIELD = re.compile(r",(?=[ \t]*(?:,|$))", re.MULTILINE)


def decode(data: bytes) -> PointCloud:
    """Read a text file with a point a line: coordinates, and what the header names or the columns look like.

    Columns stand apart by white space, commas, semicolons or bars; ``#``, ``//``, ``%`` and ``!`` start a comment. The
    names of columns may stand in the first line, or in a comment before the first number, and the number of points
    before the first point. Columns of text are left out.

    Raises:
        InputError: a line is no point or can be read in two ways, or there are no finite coordinates.
    """
    return joined(_decode_blocks(data))


def decode_pts(data: bytes) -> list[PointCloud]:
    """Read the scans of a PTS file, each after the number of its points, with intensities where it has them."""
    return [_with_intensity(cloud) for cloud in _decode_blocks(data)]


def encode_xyz(cloud: PointCloud) -> bytes:
    """Write lines of x y z; further columns (colours, the normal, all else) under a comment with their names."""
    columns = _columns(cloud)
    names = "# " + " ".join(map(_one_word, columns)) + "\n" if len(columns) > 3 else ""
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
    header = parse_header(lines)
    spans = list(_spans(lines, header))
    return [_decode_lines(lines, start, stop, header) for start, stop in spans]


def _split_lines(data: bytes) -> list[str]:
    encoding = _encoding(data)
    if encoding.startswith("utf-16"):
        text = without_windows_nan(data.decode(encoding).encode()).decode()
    elif b"\0" in data:
        raise InputError("not a text file (it holds zero bytes): check what it is")
    else:
        data = without_windows_nan(data)
        try:
            text = data.decode(encoding)
        except UnicodeDecodeError:
            text = data.decode("latin-1")
    text = text.rstrip("\x1a").replace("\u2212", "-")  # the end of a file of DOS, and the typographic minus
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    if any(mark in text for mark in ("//", "%", "!", ";")):  # most files have none, and the search is slow
        text = _COMMENTS.sub(r"\1#", text)
    lines = text.splitlines()
    return _without_bars(lines) if "|" in text else lines


def _encoding(data: bytes) -> str:
    known = next((name for mark, name in _BYTE_ORDER_MARKS.items() if data.startswith(mark)), None)
    if known is not None:
        return known
    if b"\0" not in data[:2]:
        return "utf-8"
    return "utf-16-be" if data.startswith(b"\0") else "utf-16-le"  # of an ASCII character, one byte is 0


def _without_bars(lines: list[str]) -> list[str]:
    """Put semicolons where all columns stand apart by bars, as databases print them."""
    rows = [line for line in lines if line.strip() and not line.startswith("#")]
    if not all("|" in line and ";" not in line for line in rows):
        return lines
    return [line.strip(" \t|").replace("|", ";") for line in lines]


def _spans(lines: list[str], header: Header) -> Iterator[tuple[int, int]]:
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


def _decode_lines(lines: list[str], start: int, stop: int, header: Header) -> PointCloud:
    block = lines[start:stop]
    has_quotes = any('"' in line for line in block)
    table = None if has_quotes else _plain_table(block)
    if table is None:
        return _decode_fields(lines, start, stop, header)
    while table.shape[1] > 3 and np.isnan(table[:, -1]).all():  # a comma at the end of each line
        table = table[:, :-1]
    _check_width(table.shape[1])
    names = names_for(header, table.shape[1], counts(table[:, 0]))
    if names is None:
        refuse_two_readings(table, commas="," in block[0] and ";" not in block[0], lines=block[:10_000])
        return cloud_from_table(table)
    return cloud_from_columns(dict(zip(names, table.T[-len(names) :], strict=True)))


def _plain_table(lines: list[str]) -> Numbers | None:
    """Read rows of plain numbers; None if they are not all of them."""
    first = lines[0].partition("#")[0]
    delimiter = None
    if ";" in first or "," in first:
        text = "\n".join(["", *lines])
        commas_are_decimal = ";" in first or has_decimal_commas(first)
        if commas_are_decimal and "," in text:
            if "." in text:
                return None
            text = text.replace(",", ".")
        if ";" in first or not commas_are_decimal:
            delimiter = ","
            text = _BEFORE_EMPTY_FIELD.sub(",nan", text.replace(";", ",")).replace("\n,", "\nnan,")
        lines = text.split("\n")[1:]
    try:
        return np.loadtxt(lines, np.float64, comments="#", ndmin=2, delimiter=delimiter)
    except ValueError:
        return None


def _decode_fields(lines: list[str], start: int, stop: int, header: Header) -> PointCloud:
    """Read rows with quotes, text or unusual numbers: slower, field by field."""
    numbered = [(at + 1, line) for at in range(start, stop) if (line := without_comment(lines[at]).strip())]
    separator = _separator([line for _, line in numbered])
    rows = [split(line, separator) for _, line in numbered]
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
    names = names_for(header, len(columns), is_name or _counts_up(columns[0]))
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
    refuse_two_readings(table, commas=separator == ",", lines=[line for _, line in numbered[:10_000]])
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
    if all("\t" in line for line in outside) and not any(map(COMMA_BY_SPACE.search, outside)):
        return "\t"
    if any("," in line for line in outside) and not all(map(has_decimal_commas, outside)):
        return ","
    return " "


def _check_width(width: int) -> None:
    if width < 3:
        raise InputError(f"its lines hold {width} numbers, expected x y z: export it with coordinates")


def _counts_up(fields: list[str]) -> bool:
    return all(word.isdecimal() for word in fields) and counts(np.array(fields, np.float64))


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
