"""Meshes become point clouds: points sampled on their surface."""

from __future__ import annotations

import io
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from idam.errors import InputError
from idam.io.cloud import Mesh, PointCloud
from idam.io.columns import check_size, finite, log
from idam.io.files import silenced

__all__ = [
    "SAMPLES",
    "decode_glb",
    "decode_stl",
    "encode_glb",
    "encode_stl",
    "fan",
    "mesh_or_cloud",
    "sample_surface",
    "triangles",
]

SAMPLES = 20_000


def mesh_or_cloud(vertices: PointCloud, faces: NDArray[np.int64]) -> Mesh | PointCloud:
    """Tell a mesh from a cloud to which some program has added a face or two, or faces without area.

    Args:
        vertices: all of them, whether finite or not.
        faces: (F, 3) rows of ``vertices``.

    Raises:
        InputError: a face names a vertex that is not there, or no vertex is finite.
    """
    if not len(faces):
        return finite(vertices)
    count = len(vertices.points)
    inside = (faces >= 0) & (faces < count)
    belonging = np.zeros(count, bool)
    belonging[faces[inside]] = True
    if 2 * np.count_nonzero(belonging) < count:
        log.info("left out %s faces, since most vertices belong to none: it is a cloud", f"{len(faces):,}")
        return finite(vertices)
    if not inside.all():
        raise InputError(f"a face names a vertex that is not among its {count:,}: export it again")
    if not _normals_and_areas(vertices.points, faces)[1].any():
        log.info("left out %s faces without area", f"{len(faces):,}")
        return finite(vertices)
    return Mesh(vertices, faces)


def sample_surface(mesh: Mesh) -> PointCloud:
    """Spread 20,000 points evenly over the area of a mesh, with the normals of their faces; always the same ones.

    Faces on a vertex that is not finite are left out.

    Raises:
        InputError: no face has an area that a number can hold.
    """
    normals, areas = _normals_and_areas(mesh.vertices.points, mesh.faces)
    cumulated = np.cumsum(areas)
    if not len(areas) or not 0 < cumulated[-1] < np.inf:
        raise InputError("is a mesh without area: export it as points")
    random = np.random.default_rng(0)
    strata = (np.arange(SAMPLES) + random.random(SAMPLES)) / SAMPLES * cumulated[-1]
    chosen = np.searchsorted(cumulated, strata, side="right").clip(max=np.flatnonzero(areas)[-1])
    weights = _uniform_barycentric(random.random((2, SAMPLES)))
    corners = mesh.vertices.points[mesh.faces[chosen]]
    return PointCloud(np.einsum("nk,nkc->nc", weights, corners), normals=normals[chosen] / areas[chosen, None])


def fan(polygons: NDArray[Any]) -> NDArray[np.int64]:
    """Cut polygons (F, n) of as many corners each into triangles (T, 3) that share their first corner."""
    corners = polygons.astype(np.int64)
    second, third = corners[:, 1:-1], corners[:, 2:]
    first = np.broadcast_to(corners[:, :1], third.shape)
    faces: NDArray[np.int64] = np.stack([first, second, third], axis=-1).swapaxes(0, 1).reshape(-1, 3)
    return faces


def triangles(polygons: list[NDArray[Any]]) -> NDArray[np.int64]:
    """Cut polygons of any number of corners into triangles (T, 3)."""
    if not polygons:
        return np.empty((0, 3), np.int64)
    lengths = np.array([len(polygon) for polygon in polygons])
    alike = [np.stack([polygons[row] for row in np.flatnonzero(lengths == n)]) for n in np.unique(lengths)]
    return np.concatenate([fan(each) for each in alike])


def decode_stl(data: bytes) -> Mesh | PointCloud:
    """Read an STL mesh, ASCII or binary."""
    if b"\0" in data:  # binary; trimesh would take a damaged one for ASCII, and find nothing
        check_size(84, len(data), "a binary STL header")
        end = 84 + 50 * struct.unpack_from("<I", data, 80)[0]
        check_size(end, len(data), "binary STL triangles")
        data = data[:end]
    return _joined(_load(data, "stl"))


def encode_stl(mesh: Mesh) -> bytes:
    """Encode a binary STL mesh; an ASCII one where float32 coordinates would not do."""
    corners = mesh.vertices.points[mesh.faces]
    normals, areas = _normals_and_areas(mesh.vertices.points, mesh.faces)
    normals = np.divide(normals, areas[:, None], out=np.zeros_like(normals), where=areas[:, None] > 0)
    if coordinate_type(mesh.vertices.points) == "f4":
        rows = np.zeros(len(corners), [("vectors", "<f4", (4, 3)), ("count", "<u2")])
        rows["vectors"] = np.concatenate([normals[:, None], corners], axis=1)
        return b"idam".ljust(80) + struct.pack("<I", len(rows)) + rows.tobytes()
    facets = (
        f"facet normal {_row(normal)}\nouter loop\n"
        + "".join(f"vertex {_row(corner)}\n" for corner in triangle)
        + "endloop\nendfacet\n"
        for normal, triangle in zip(normals.tolist(), corners.tolist(), strict=True)
    )
    return f"solid idam\n{''.join(facets)}endsolid idam\n".encode()


def decode_glb(data: bytes) -> Mesh | PointCloud:
    """Read the meshes and points of a binary glTF file, each where its scene places it."""
    return _joined(_load(data, "glb"))


def encode_glb(mesh: Mesh) -> bytes:
    """Encode a binary glTF mesh, whose coordinates are float32."""
    import trimesh

    exported = trimesh.Trimesh(
        mesh.vertices.points, mesh.faces, vertex_colors=mesh.vertices.colors, process=False
    ).export(file_type="glb")
    assert isinstance(exported, bytes)
    return exported


def coordinate_type(points: NDArray[np.float64]) -> str:
    """``f4`` where that rounds coordinates by no more than a millionth of the cloud's extent, else ``f8``."""
    points = points[np.isfinite(points).all(axis=1)]
    with np.errstate(over="ignore"):
        rounding = np.abs(points - points.astype(np.float32)).max(initial=0)
    extent = np.ptp(points, axis=0).max(initial=0) if len(points) else 0.0
    return "f8" if rounding > 1e-6 * extent else "f4"


def _load(data: bytes, file_type: str) -> list[Any]:
    """The meshes and clouds of a file, each where its scene places it."""
    import trimesh

    with silenced("trimesh"):
        loaded: Any = trimesh.load(io.BytesIO(data), file_type=file_type, process=False)
    if not isinstance(loaded, trimesh.Scene):
        return [loaded]
    placed = []
    for name in loaded.graph.nodes_geometry:
        transform, geometry = loaded.graph[name]
        placed.append(loaded.geometry[geometry].copy().apply_transform(transform))
    return placed


def _joined(parts: list[Any]) -> Mesh | PointCloud:
    if not parts:
        raise InputError("holds no points: export it again")
    offsets = np.cumsum([0, *(len(part.vertices) for part in parts)], dtype=np.int64)
    vertices = np.concatenate([np.empty((0, 3)), *(part.vertices for part in parts)])
    faces = [part.faces + offset for part, offset in zip(parts, offsets, strict=False) if hasattr(part, "faces")]
    return mesh_or_cloud(PointCloud(vertices, _colors(parts)), np.concatenate([np.empty((0, 3), np.int64), *faces]))


def _colors(parts: list[Any]) -> NDArray[np.uint8] | None:
    found = []
    for part in parts:
        colors = getattr(part, "colors", None)
        visual: Any = getattr(part, "visual", None)
        if colors is None and getattr(visual, "kind", None) == "vertex":
            colors = visual.vertex_colors
        if colors is None or len(colors) != len(part.vertices):
            return None
        found.append(np.asarray(colors)[:, :3].astype(np.uint8))
    return np.concatenate(found) if found else None


def _normals_and_areas(vertices: NDArray[Any], faces: NDArray[np.int64]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Cross products (F, 3) of faces and their lengths (F,), twice the areas; 0 where a corner is not finite."""
    with np.errstate(all="ignore"):
        corners = vertices[faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        areas = np.linalg.norm(normals, axis=1)
    areas[~np.isfinite(areas)] = 0
    return normals, areas


def _row(numbers: list[float]) -> str:
    return " ".join(map(repr, numbers))


def _uniform_barycentric(random: NDArray[np.float64]) -> NDArray[np.float64]:
    """Turn uniform numbers (2, N) of [0, 1) into barycentric coordinates (N, 3), uniform over the triangle."""
    root = np.sqrt(random[0])
    return np.stack([1 - root, root * (1 - random[1]), root * random[1]], axis=1)
