"""Wavefront OBJ: meshes and clouds of points, with a colour for each vertex where there are any."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from idam import rigid
from idam.errors import InputError
from idam.io.cloud import Mesh, PointCloud
from idam.io.columns import Numbers, parse_rows, to_uint8, without_windows_nan
from idam.io.mesh import mesh_or_cloud, triangles

__all__ = ["decode", "encode", "move"]


def decode(data: bytes) -> Mesh | PointCloud:
    """Read the faces between vertices, or the vertices alone where there are none.

    A vertex is x y z, then a weight w that divides them, or a colour, or both.

    Raises:
        InputError: the file is damaged, or holds no vertices.
    """
    vertices: list[list[bytes]] = []
    normals: list[list[bytes]] = []
    polygons: list[NDArray[np.int64]] = []
    for line in _lines(data):
        match line.split():
            case [b"v", *words]:
                vertices.append(words)
            case [b"vn", *words]:
                normals.append(words)
            case [b"f", *words]:
                corners = np.array([int(word.partition(b"/")[0]) for word in words], np.int64)
                polygons.append(np.where(corners < 0, corners + len(vertices), corners - 1))
    if not vertices:
        raise InputError("holds no points: export it again")
    points, colors = _points_and_colors(vertices)
    given = not polygons and len(normals) == len(points) and all(len(words) == 3 for words in normals)
    cloud = PointCloud(points, colors, parse_rows(normals, "a normal") if given else None)
    return mesh_or_cloud(cloud, triangles([polygon for polygon in polygons if len(polygon) > 2]))


def encode(content: PointCloud | Mesh) -> bytes:
    """Encode vertices, with their colours as fractions, and faces; every number reads back the same."""
    cloud = content.vertices if isinstance(content, Mesh) else content
    columns: list[Numbers] = [*cloud.points.T]
    if cloud.colors is not None:
        columns += [*np.round(cloud.colors.T / 255, 6)]
    rows = ["v " + " ".join(map(repr, row)) for row in zip(*(column.tolist() for column in columns), strict=True)]
    if isinstance(content, Mesh):
        rows += [f"f {a} {b} {c}" for a, b, c in (content.faces + 1).tolist()]
    elif cloud.normals is not None:
        rows += ["vn " + " ".join(map(repr, row)) for row in cloud.normals.tolist()]
    return ("\n".join(rows) + "\n").encode()


def move(data: bytes, transformation: rigid.Array) -> bytes:
    """Move the vertices and turn the normals of a file by a rigid transform (4, 4); every other line stays.

    Raises:
        InputError: the file is damaged, or holds no vertices.
    """
    decode(data)
    lines = _lines(data)
    words = [line.split() for line in lines]
    for key, translation in ((b"v", transformation[:3, 3]), (b"vn", np.zeros(3))):
        rows = [row for row, each in enumerate(words) if each[:1] == [key]]
        given = parse_rows([words[row][1:4] for row in rows], "a line").reshape(-1, 3)
        weights = np.ones(len(rows))
        if key == b"v":
            weights = np.array([float(words[row][4]) if len(words[row]) in (5, 8) else 1.0 for row in rows])
        moved = given @ transformation[:3, :3].T + weights[:, None] * translation
        for row, numbers in zip(rows, moved.tolist(), strict=True):
            lines[row] = b" ".join([key, *(repr(number).encode() for number in numbers), *words[row][4:]])
    return b"\n".join(lines) + b"\n"


def _lines(data: bytes) -> list[bytes]:
    return (
        without_windows_nan(data.removeprefix(b"\xef\xbb\xbf"))
        .replace(b"\\\r\n", b" ")
        .replace(b"\\\n", b" ")
        .splitlines()
    )


def _points_and_colors(vertices: list[list[bytes]]) -> tuple[NDArray[np.float64], NDArray[np.uint8] | None]:
    width = len(vertices[0])
    if {len(words) for words in vertices} <= {3, 4}:
        rows = parse_rows([words if len(words) == 4 else [*words, b"1"] for words in vertices], "a vertex")
        with np.errstate(all="ignore"):
            return rows[:, :3] / rows[:, 3:], None
    if width not in (6, 7) or any(len(words) != width for words in vertices):
        raise InputError("damaged: its vertices differ in how many numbers they hold: export it again")
    rows = parse_rows(vertices, "a vertex")
    if width == 7:
        if not (rows[:, 3] == 1).all():
            raise InputError("its vertices hold 7 numbers: write x y z red green blue")
        rows = np.delete(rows, 3, axis=1)
    return rows[:, :3], to_uint8(rows[:, 3:])
