"""COPC: LAZ files in which each level of an octree holds some of the points, evenly, and the next one more of them."""

from __future__ import annotations

import contextlib
import mmap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from idam.errors import InputError
from idam.io.columns import check_size
from idam.io.files import check_unpacked_size, silenced

__all__ = ["coarse_points", "is_copc"]

_ENTRY = np.dtype([("key", "<i4", 4), ("offset", "<u8"), ("size", "<i4"), ("count", "<i4")])
_LINK = -1  # the count of an entry that stands for a page of entries


def is_copc(header: Any) -> bool:
    """Whether the header of a LAZ file says that it is a COPC file."""
    return any(record.user_id == "copc" and record.record_id == 1 for record in header.vlrs)


def coarse_points(path: Path, most: int) -> tuple[Any, int]:
    """Read the points of the first levels, at least one level and else up to so many points.

    Returns:
        The points, as laspy has them, and the number of levels that were read.

    Raises:
        InputError: the octree points to what is not there.
    """
    with _opened(path) as (reader, data):
        info = reader.copc_info
        entries = _entries(data, info.hierarchy_root_offset, info.hierarchy_root_size)
        levels = entries["key"][:, 0]
        counts = np.bincount(levels, entries["count"]).astype(np.int64)
        depth = max(1, int(np.searchsorted(counts.cumsum(), most, side="right")))
        chosen = entries[levels < depth]
        check_size(int((chosen["offset"].astype(np.float64) + chosen["size"]).max()), len(data), "nodes of its octree")
        check_unpacked_size(int(chosen["count"].sum()) * reader.header.point_format.size, int(chosen["size"].sum()))
        return reader.query(level=range(depth)), depth


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, Any]]:
    import laspy

    with path.open("rb") as stream, silenced("laspy"):
        data = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
        yield laspy.CopcReader(stream, close_fd=False), data


def _entries(data: Any, offset: int, size: int) -> Any:
    """All nodes of the octree: laspy would follow a page that names itself without end."""
    found, links, pages, seen = [], [np.empty(0, _ENTRY)], [(offset, size)], set()
    while pages:
        offset, size = pages.pop()
        if offset in seen or size < 0:
            raise InputError("damaged: a page of its octree names itself: export it again")
        seen.add(offset)
        check_size(offset + size, len(data), "a page of its octree")
        entries = np.frombuffer(data, _ENTRY, size // _ENTRY.itemsize, offset)
        is_link = entries["count"] == _LINK
        links.append(entries[is_link])
        found.append(entries[~is_link])
        pages += [(int(each["offset"]), int(each["size"])) for each in entries[is_link]]
    nodes = np.concatenate(found)
    levels, known = nodes["key"][:, 0], {key.tobytes() for key in nodes["key"]}
    possible = (levels >= 0) & (levels < 32) & (nodes["count"] >= 0) & (nodes["size"] >= 0)
    if not len(nodes) or not possible.all() or not all(key.tobytes() in known for key in np.concatenate(links)["key"]):
        raise InputError("damaged: its octree has impossible nodes: export it again")
    return nodes
