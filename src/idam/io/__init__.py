"""Reading and writing point clouds and transforms.

Whatever is wrong with a file, a folder or an array ends in :class:`idam.errors.InputError`, whose one line names the
file and says what to do. Every write is atomic: a failed one leaves the old file as it was, and nothing beside it.
"""

from idam.io.cloud import Mesh, PointCloud, Scan
from idam.io.convert import as_point_cloud
from idam.io.files import check_destination, check_outputs, make_folder, write_json, write_text
from idam.io.formats import (
    check_writable,
    is_readable,
    move_file,
    read_content,
    read_point_cloud,
    read_scans,
    write_point_cloud,
)
from idam.io.transforms import format_transform, read_transform, rigid_fault, write_transform

__all__ = [
    "Mesh",
    "PointCloud",
    "Scan",
    "as_point_cloud",
    "check_destination",
    "check_outputs",
    "check_writable",
    "format_transform",
    "is_readable",
    "make_folder",
    "move_file",
    "read_content",
    "read_point_cloud",
    "read_scans",
    "read_transform",
    "rigid_fault",
    "write_json",
    "write_point_cloud",
    "write_text",
    "write_transform",
]
