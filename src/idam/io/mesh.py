"""Meshes become point clouds: points sampled on their surface."""

from __future__ import annotations

import io
import re
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from idam.errors import InputError
from idam.io.cloud import PointCloud
from idam.io.columns import check_size, finite_cloud
from idam.io.files import silenced

__all__ = ["SAMPLES", "decode_obj", "decode_off", "decode_stl", "fan", "sample_surface", "triangles"]

SAMPLES = 20_000
_MATERIAL = re.compile(rb"^[ \t]*(usemtl|mtllib)\b.*$", re.MULTILINE)


def sample_surface(vertices: NDArray[Any], faces: NDArray[np.int64]) -> PointCloud:
    """Spread 20,000 points evenly over the area of a mesh, with the normals of their faces; always the same ones.

    Args:
        vertices: (V, 3); faces on one that is not finite are left out.
        faces: (F, 3) rows of ``vertices``.

    Raises:
        InputError: a face names a vertex that is not there, or no face has an area.
    """
    if faces.min(initial=0) < 0 or faces.max(initial=-1) >= len(vertices):
        raise InputError(f"a face names a vertex that is not among its {len(vertices):,}: export it again")
    corners = vertices.astype(np.float64)[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(normals, axis=1)
    areas[~np.isfinite(areas)] = 0
    cumulated = np.cumsum(areas)
    if not len(faces) or not 0 < cumulated[-1] < np.inf:
        raise InputError("is a mesh without area: export it as points")

    random = np.random.default_rng(0)
    strata = (np.arange(SAMPLES) + random.random(SAMPLES)) / SAMPLES * cumulated[-1]
    chosen = np.searchsorted(cumulated, strata, side="right").clip(max=np.flatnonzero(areas)[-1])
    weights = _uniform_barycentric(random.random((2, SAMPLES)))
    return PointCloud(np.einsum("nk,nkc->nc", weights, corners[chosen]), normals=normals[chosen] / areas[chosen, None])


def fan(polygons: NDArray[Any]) -> NDArray[np.int64]:
    """Cut polygons (F, n) of as many corners each into triangles (T, 3) that share their first corner."""
    corners = polygons.astype(np.int64)
    second, third = corners[:, 1:-1], corners[:, 2:]
    first = np.broadcast_to(corners[:, :1], third.shape)
    faces: NDArray[np.int64] = np.stack([first, second, third], axis=-1).swapaxes(0, 1).reshape(-1, 3)
    return faces


def triangles(polygons: list[NDArray[Any]]) -> NDArray[np.int64]:
    """Cut polygons of any number of corners into triangles (T, 3)."""
    lengths = np.array([len(polygon) for polygon in polygons])
    alike = [np.stack([polygons[row] for row in np.flatnonzero(lengths == n)]) for n in np.unique(lengths)]
    return np.concatenate([fan(each) for each in alike])


def decode_obj(data: bytes) -> PointCloud:
    """Sample the surface of a Wavefront OBJ mesh, or take its vertices if it has no faces."""
    # trimesh takes minutes over thousands of materials, which are of no use here
    return _decode(_MATERIAL.sub(b"", data), "obj")


def decode_off(data: bytes) -> PointCloud:
    """Sample the surface of an OFF mesh, or take its vertices if it has no faces."""
    return _decode(data, "off")


def decode_stl(data: bytes) -> PointCloud:
    """Sample the surface of an STL mesh, ASCII or binary."""
    if b"\0" in data:  # binary; trimesh would take a damaged one for ASCII, and find nothing
        check_size(84, len(data), "a binary STL header")
        end = 84 + 50 * struct.unpack_from("<I", data, 80)[0]
        check_size(end, len(data), "binary STL triangles")
        data = data[:end]
    return _decode(data, "stl")


def _decode(data: bytes, file_type: str) -> PointCloud:
    import trimesh

    with silenced("trimesh"):
        loaded: Any = trimesh.load(io.BytesIO(data), file_type=file_type, process=False)
    parts = list(loaded.geometry.values()) if isinstance(loaded, trimesh.Scene) else [loaded]
    offsets = np.cumsum([0, *(len(part.vertices) for part in parts)], dtype=np.int64)
    vertices = np.concatenate([np.empty((0, 3)), *(part.vertices for part in parts)])
    faces = [part.faces + offset for part, offset in zip(parts, offsets, strict=False) if hasattr(part, "faces")]
    if sum(map(len, faces)):
        return sample_surface(vertices, np.concatenate(faces))
    return finite_cloud(vertices, None, None)


def _uniform_barycentric(random: NDArray[np.float64]) -> NDArray[np.float64]:
    """Turn uniform numbers (2, N) of [0, 1) into barycentric coordinates (N, 3), uniform over the triangle."""
    root = np.sqrt(random[0])
    return np.stack([1 - root, root * (1 - random[1]), root * random[1]], axis=1)
