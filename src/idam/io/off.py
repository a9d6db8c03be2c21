"""OFF, and COFF with a colour and NOFF with a normal for each vertex."""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import NDArray

from idam import rigid
from idam.errors import InputError
from idam.io.cloud import Mesh, PointCloud
from idam.io.columns import check_size, parse_rows, to_uint8, without_windows_nan
from idam.io.mesh import mesh_or_cloud, triangles

__all__ = ["decode", "encode", "move"]

_KEYWORD = re.compile(rb"(ST)?(C)?(N)?(4)?OFF")


def decode(data: bytes) -> Mesh | PointCloud:
    """Read the faces between vertices, or the vertices alone where there are none.

    Raises:
        InputError: the file is damaged, or holds no vertices.
    """
    lines, at, (vertices, faces), (_, has_colors, has_normals, has_weight) = _parse(data)
    given = [lines[at + row].split() for row in range(vertices)]
    width = 3 + has_weight + 3 * has_normals
    numbers = parse_rows([words[:width] for words in given], "a vertex")
    if numbers.shape[1] != width:
        raise InputError(f"damaged: its vertices hold {numbers.shape[1]} numbers, expected {width}: export it again")
    points = numbers[:, :3] / numbers[:, 3:4] if has_weight else numbers[:, :3]
    normals = numbers[:, 3 + has_weight : width] if has_normals else None
    polygons = []
    for line in lines[at + vertices : at + vertices + faces]:
        count, *words = line.split()
        check_size(int(count), len(words), f"a face of {int(count):,} corners", "numbers")
        polygons.append(np.array(words[: max(int(count), 0)]).astype(np.int64))
    cloud = PointCloud(points, _colors([words[width:] for words in given]) if has_colors else None, normals)
    return mesh_or_cloud(cloud, triangles([polygon for polygon in polygons if len(polygon) > 2]))


def encode(content: PointCloud | Mesh) -> bytes:
    """Encode vertices, their colours and normals, and faces; every number reads back the same."""
    cloud = content.vertices if isinstance(content, Mesh) else content
    faces = content.faces.tolist() if isinstance(content, Mesh) else []
    rows = cloud.points.tolist()
    keyword = "OFF"
    if cloud.normals is not None:
        keyword, rows = "NOFF", [[*row, *more] for row, more in zip(rows, cloud.normals.tolist(), strict=True)]
    if cloud.colors is not None:
        keyword = "C" + keyword
        rows = [[*row, *more, 255] for row, more in zip(rows, cloud.colors.tolist(), strict=True)]
    lines = [keyword, f"{len(rows)} {len(faces)} 0", *(" ".join(map(repr, row)) for row in rows)]
    return ("\n".join([*lines, *(f"3 {a} {b} {c}" for a, b, c in faces)]) + "\n").encode()


def move(data: bytes, transformation: rigid.Array) -> bytes:
    """Move the vertices and turn the normals of a file by a rigid transform (4, 4); all else stays.

    Raises:
        InputError: the file is damaged, or holds no vertices.
    """
    decode(data)
    lines, at, (vertices, _), (_, _, has_normals, has_weight) = _parse(data)
    after = 3 + has_weight
    for row in range(at, at + vertices):
        words = lines[row].split()
        weight = float(words[3]) if has_weight else 1.0
        moved = transformation[:3, :3] @ np.array(words[:3], np.float64) + weight * transformation[:3, 3]
        numbers = [*moved.tolist(), *([weight] if has_weight else [])]
        if has_normals:
            numbers += (transformation[:3, :3] @ np.array(words[after : after + 3], np.float64)).tolist()
        lines[row] = b" ".join([*(repr(number).encode() for number in numbers), *words[len(numbers) :]])
    return b"\n".join(lines) + b"\n"


def _parse(data: bytes) -> tuple[list[bytes], int, tuple[int, int], tuple[bool, bool, bool, bool]]:
    """The lines of a file less comments, where vertices start, how many there are and faces, and what each holds."""
    lines = [line for each in without_windows_nan(data).splitlines() if (line := each.partition(b"#")[0].strip())]
    first = lines[0].split() if lines else []
    kind = _KEYWORD.fullmatch(first[0]) if first else None
    if kind is None and not (len(first) == 3 and all(word.isdigit() for word in first)):
        raise InputError("not an OFF file as text (no 'OFF' in its first line): check what it is")
    has = tuple(kind[group] is not None for group in range(1, 5)) if kind else (False,) * 4
    words, at = (first[1:], 1) if kind else (first, 1)
    if not words:
        words, at = (lines[1].split() if len(lines) > 1 else []), 2
    if len(words) < 2 or not all(word.isdigit() for word in words[:2]):
        raise InputError("damaged: its numbers of vertices and faces are missing: export it again")
    vertices, faces = int(words[0]), int(words[1])
    check_size(vertices + faces, len(lines) - at, f"{vertices:,} vertices and {faces:,} faces", "lines")
    if not vertices:
        raise InputError("holds no points: export it again")
    return lines, at, (vertices, faces), (has[0], has[1], has[2], has[3])


def _colors(words: list[list[bytes]]) -> NDArray[np.uint8]:
    """Colours written as 0 to 255 or as fractions, with or without an alpha."""
    colors = parse_rows([each[:3] for each in words], "a colour")
    whole = all(b"." not in word for each in words for word in each[:3])
    return to_uint8(colors.astype(np.int64) if whole else colors)
