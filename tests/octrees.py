"""COPC files, written here since laspy only reads them: LAZ whose chunks are the nodes of an octree."""

from __future__ import annotations

import io
import struct
from pathlib import Path

import numpy as np
import pytest

ENTRY = [("key", "<i4", 4), ("offset", "<u8"), ("size", "<i4"), ("count", "<i4")]


def write_copc(path: Path, points: np.ndarray, levels: int = 4, pages: bool = False) -> np.ndarray:
    """Writes points (N, 3), with their numbers as intensity, and returns the level (N,) of each.

    A level has four times as many points as the one above it. With ``pages``, what is below one node of the first level
    stands in a page of the hierarchy of its own.
    """
    laspy, lazrs = pytest.importorskip("laspy"), pytest.importorskip("lazrs")
    low, high = points.min(axis=0), points.max(axis=0)
    centre, half = (low + high) / 2, float((high - low).max()) / 2 + 1e-3
    shares = np.cumsum(4.0 ** np.arange(levels))
    level = np.searchsorted(shares / shares[-1], np.random.default_rng(0).random(len(points)), side="right")
    cell = np.floor((points - centre + half) / (2 * half) * 2.0 ** level[:, None])
    nodes, node = np.unique(np.column_stack([level, cell]).astype(np.int64), axis=0, return_inverse=True)
    order = np.argsort(node.reshape(-1), kind="stable")
    counts = np.bincount(node.reshape(-1))

    header = laspy.LasHeader(version="1.4", point_format=6)
    header.offsets, header.scales = centre.round(), np.full(3, 0.001)
    record = laspy.ScaleAwarePointRecord.zeros(len(points), header=header)
    record.x, record.y, record.z = points[order].T
    record.intensity = order % 65536
    header.grow(record)
    header.are_points_compressed = True
    description = lazrs.LazVlr.new_for_compression(6, 0, True)
    entries = np.zeros(len(nodes), ENTRY)
    entries["key"], entries["count"] = nodes, counts

    with path.open("w+b") as stream:
        _write_header(stream, header, description, bytes(160))
        compressor = lazrs.LasZipCompressor(stream, description)
        compressor.reserve_offset_to_chunk_table()
        at = 0
        for place, count in enumerate(counts):
            entries["offset"][place] = stream.tell()
            compressor.compress_many(np.frombuffer(record.array[at : at + count].tobytes(), np.uint8))
            compressor.finish_current_chunk()
            entries["size"][place] = stream.tell() - entries["offset"][place]
            at += count
        compressor.done()
        stream.seek(0, io.SEEK_END)
        header.start_of_first_evlr, header.number_of_evlrs = stream.tell(), 1
        body, first = _hierarchy(stream.tell() + 60, entries, pages)
        stream.write(struct.pack("<H16sHQ32s", 0, b"copc", 1000, len(body), b""))
        stream.write(body)
        spacing = 2 * half / 128
        info = struct.pack("<5d2Q2d", *centre, half, spacing, header.start_of_first_evlr + 60, first, 0, 0)
        stream.seek(0)
        _write_header(stream, header, description, info.ljust(160, b"\0"))
    return level


def _hierarchy(at: int, entries: np.ndarray, pages: bool) -> tuple[bytes, int]:
    """The pages of the hierarchy, and the length of the first."""
    if not pages:
        return entries.tobytes(), entries.nbytes
    levels, cells = entries["key"][:, 0], entries["key"][:, 1:]
    below = (levels > 0) & (cells >> np.maximum(levels - 1, 0)[:, None] == cells[1]).all(axis=1)
    link = np.zeros(1, ENTRY)
    first = 32 * (np.count_nonzero(~below) + 1)
    link["key"], link["offset"], link["size"], link["count"] = entries["key"][1], at + first, 32 * below.sum(), -1
    return entries[~below].tobytes() + link.tobytes() + entries[below].tobytes(), first


def _write_header(stream: io.IOBase, header: object, description: object, info: bytes) -> None:
    import laspy

    header.vlrs.clear()
    header.vlrs.append(laspy.VLR("copc", 1, "COPC info VLR", info))
    header.vlrs.append(laspy.VLR("laszip encoded", 22204, "", description.record_data()))
    header.write_to(stream)
