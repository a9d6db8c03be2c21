"""Reading and writing: every format by hand-made files, and no input that ends in anything but InputError."""

from __future__ import annotations

import io
import json
import os
import struct
import subprocess
import sys
import zipfile
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from idam.errors import InputError, MissingDependencyError
from idam.io import (
    PointCloud,
    as_point_cloud,
    format_transform,
    read_point_cloud,
    read_transform,
    write_json,
    write_point_cloud,
    write_text,
    write_transform,
)

WRITABLE = ["ply", "pcd", "xyz", "txt", "asc", "csv", "pts", "npy", "npz"]
WITH_COLORS = {"ply", "pcd", "xyz", "txt", "asc", "csv", "pts", "npz"}
WITH_NORMALS = WITH_COLORS - {"pts"}
UTM = np.array([412_345.678_9, 5_412_345.123_4, 312.5])


def make_cloud(count: int = 50, offset: np.ndarray | float = 0.0) -> PointCloud:
    random = np.random.default_rng(3)
    normals = random.normal(size=(count, 3))
    return PointCloud(
        random.normal(size=(count, 3)) + offset,
        random.integers(0, 256, (count, 3), dtype=np.uint8),
        normals / np.linalg.norm(normals, axis=1, keepdims=True),
    )


def make_transform() -> np.ndarray:
    cos, sin = np.cos(0.3), np.sin(0.3)
    return np.array([[cos, -sin, 0, 1.5], [sin, cos, 0, -2.25], [0, 0, 1, 1e-7], [0, 0, 0, 1]])


def read(folder: Path, name: str, content: bytes | str) -> PointCloud:
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return read_point_cloud(path)


def names_in(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def assert_refused(error: pytest.ExceptionInfo[InputError], path: object) -> str:
    message = str(error.value)
    assert "\n" not in message
    assert message.startswith(f"{path}: ")
    return message


# --- the cloud -----------------------------------------------------------------------------------------------------


def test_transform_moves_points_turns_normals_keeps_colours() -> None:
    cloud, transform = make_cloud(), make_transform()
    moved = cloud.transformed(transform)
    np.testing.assert_allclose(moved.points, cloud.points @ transform[:3, :3].T + transform[:3, 3])
    np.testing.assert_allclose(moved.normals, cloud.normals @ transform[:3, :3].T)
    assert moved.colors is cloud.colors


def test_cloud_refuses_arrays_that_do_not_match() -> None:
    points = np.zeros((4, 3))
    with pytest.raises(InputError, match=r"colours: expected uint8 \(4, 3\), got float64 \(4, 3\)"):
        PointCloud(points, colors=points)
    with pytest.raises(InputError, match=r"normals: expected one for each point"):
        PointCloud(points, normals=np.zeros((3, 3)))


# --- round trips ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", WRITABLE)
def test_round_trip(tmp_path: Path, suffix: str) -> None:
    cloud, path = make_cloud(), tmp_path / f"cloud.{suffix.upper()}"
    write_point_cloud(path, cloud)
    back = read_point_cloud(path)
    np.testing.assert_allclose(back.points, cloud.points, atol=1e-6)
    assert back.points.dtype == np.float64
    if suffix in WITH_COLORS:
        np.testing.assert_array_equal(back.colors, cloud.colors)
    if suffix in WITH_NORMALS:
        np.testing.assert_allclose(back.normals, cloud.normals, atol=1e-6)
    assert names_in(tmp_path) == [path.name]


@pytest.mark.parametrize("suffix", WRITABLE)
@pytest.mark.parametrize("extras", ["none", "colors", "normals"])
def test_round_trip_of_part_of_a_cloud_far_from_the_origin_is_exact(tmp_path: Path, suffix: str, extras: str) -> None:
    cloud, path = make_cloud(offset=UTM), tmp_path / f"cloud.{suffix}"
    part = PointCloud(cloud.points, **({} if extras == "none" else {extras: getattr(cloud, extras)}))
    write_point_cloud(path, part)
    back = read_point_cloud(path)
    np.testing.assert_array_equal(back.points, cloud.points)
    assert (back.colors is not None) == (extras == "colors" and suffix in WITH_COLORS)
    assert (back.normals is not None) == (extras == "normals" and suffix in WITH_NORMALS)


@pytest.mark.parametrize(("offset", "kind"), [(0.0, b"float x"), (UTM, b"double x")])
def test_ply_is_double_only_where_it_must_be(tmp_path: Path, offset: np.ndarray, kind: bytes) -> None:
    write_point_cloud(tmp_path / "a.ply", make_cloud(offset=offset))
    assert b"property " + kind in (tmp_path / "a.ply").read_bytes()


def test_write_takes_an_array(tmp_path: Path) -> None:
    write_point_cloud(tmp_path / "a.ply", np.eye(3, dtype=np.float32))
    np.testing.assert_array_equal(read_point_cloud(tmp_path / "a.ply").points, np.eye(3))


@pytest.mark.parametrize("suffix", WRITABLE)
def test_empty_cloud_is_written_and_refused_on_reading(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a.{suffix}"
    write_point_cloud(path, np.empty((0, 3)))
    with pytest.raises(InputError) as error:
        read_point_cloud(path)
    assert_refused(error, path)


# --- PLY -----------------------------------------------------------------------------------------------------------

SQUARE = "0 0 0\n1 0 0\n1 1 0\n0 1 0\n"


def ply_header(*lines: str, form: str = "ascii", end: str = "\n") -> str:
    return end.join(["ply", f"format {form} 1.0", "comment made by hand", *lines, "end_header", ""])


XYZ_PROPERTIES = ("property double x", "property double y", "property double z")
ONE_FACE = ("element face 1", "property list int int vertex_index")


def test_ply_ascii_with_other_elements_and_properties(tmp_path: Path) -> None:
    header = ply_header(
        "obj_info nothing",
        "element camera 1",
        "property list uchar float view",
        "property int id",
        "element vertex 2",
        *XYZ_PROPERTIES,
        "property float quality",
        "property uchar red",
        "property uchar green",
        "property uchar blue",
        "element edge 1",
        "property int vertex1",
        "property int vertex2",
        end="\r\n",
    )
    cloud = read(tmp_path, "a.ply", header + "2 0.5 0.5 7\r\n5412345.1234 2 3 .5 0 1 1\r\n4 5 6 .5 1 0 1\r\n0 1\r\n")
    np.testing.assert_array_equal(cloud.points, [[5412345.1234, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(cloud.colors, [[0, 1, 1], [1, 0, 1]])
    assert cloud.normals is None


@pytest.mark.parametrize(("form", "order"), [("binary_little_endian", "<"), ("binary_big_endian", ">")])
def test_ply_binary_of_both_byte_orders(tmp_path: Path, form: str, order: str) -> None:
    names = [*XYZ_PROPERTIES, *(f"property float n{axis}" for axis in "xyz"), "property ushort red"]
    names += ["property ushort green", "property ushort blue"]
    rows = [(*UTM, 0, 0, 1, 65535, 0, 257), (np.nan, 0, 0, 0, 0, 1, 0, 0, 0), (1, 2, 3, 1, 0, 0, 0, 514, 0)]
    body = b"".join(struct.pack(f"{order}3d3f3H", *row) for row in rows)
    cloud = read(tmp_path, "a.ply", ply_header("element vertex 3", *names, form=form).encode() + body)
    np.testing.assert_array_equal(cloud.points, [UTM, [1, 2, 3]])
    np.testing.assert_array_equal(cloud.normals, [[0, 0, 1], [1, 0, 0]])
    np.testing.assert_array_equal(cloud.colors, [[255, 0, 1], [0, 2, 0]])


@pytest.mark.parametrize(
    "faces", [["4 0 1 2 3"], ["3 0 1 2", "3 0 2 3"], ["3 0 1 2", "4 0 1 2 3"], ["2 0 1", "4 0 1 2 3"]]
)
@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_ply_with_faces_is_sampled(tmp_path: Path, faces: list[str], form: str) -> None:
    lists = f"element face {len(faces)}", "property list uchar int vertex_indices", "property uchar flags"
    header = ply_header("element vertex 4", *XYZ_PROPERTIES, *lists, form=form).encode()
    order = ">" if "big" in form else "<"
    if form == "ascii":
        body = (SQUARE + "".join(f"{face} 9\n" for face in faces)).encode()
    else:
        body = struct.pack(f"{order}12d", *map(float, SQUARE.split()))
        for face in faces:
            length, *corners = map(int, face.split())
            body += struct.pack(f"{order}B{length}iB", length, *corners, 9)
    cloud = read(tmp_path, "a.ply", header + body)
    assert cloud.points.shape == (20_000, 3)
    assert cloud.points.min() >= 0 and cloud.points.max() <= 1
    np.testing.assert_array_equal(cloud.normals, np.tile([0.0, 0.0, 1.0], (20_000, 1)))
    np.testing.assert_array_equal(cloud.points, read_point_cloud(tmp_path / "a.ply").points)


def test_ply_whose_faces_are_none_is_its_points(tmp_path: Path) -> None:
    header = ply_header("element vertex 4", *XYZ_PROPERTIES, "element face 0", "property list uchar int vertex_index")
    assert len(read(tmp_path, "a.ply", header + SQUARE).points) == 4


@pytest.mark.parametrize(
    ("lines", "body", "message"),
    [
        (("element vertex 2", *XYZ_PROPERTIES), "1 2 3\n", "cut short"),
        (("element vertex 1", *XYZ_PROPERTIES), "1 2 x\n", "damaged"),
        (("element vertex 1", *XYZ_PROPERTIES[:2]), "1 2\n", "no columns x, y and z"),
        (("element vertex 1", *XYZ_PROPERTIES), "nan nan nan\n", "NaN"),
        (("element vertex 1", "property real x"), "1\n", "unknown type 'real'"),
        (("element point 1", *XYZ_PROPERTIES), "1 2 3\n", "no columns"),
        (("element vertex 4", *XYZ_PROPERTIES, *ONE_FACE), SQUARE + "3 0 1 4", "names a vertex"),
        (("element vertex 4", *XYZ_PROPERTIES, *ONE_FACE), SQUARE + "-3 0 1 1", "damaged"),
    ],
)  # fmt: skip
def test_ply_faults(tmp_path: Path, lines: tuple[str, ...], body: str, message: str) -> None:
    with pytest.raises(InputError, match=message) as error:
        read(tmp_path, "a.ply", ply_header(*lines) + body)
    assert_refused(error, tmp_path / "a.ply")


# --- PCD -----------------------------------------------------------------------------------------------------------


def pcd_header(fields: str, sizes: str, types: str, points: int, data: str, count: str = "") -> bytes:
    counts = count or " ".join("1" for _ in fields.split())
    return (
        f"# .PCD v0.7\nVERSION 0.7\nFIELDS {fields}\nSIZE {sizes}\nTYPE {types}\nCOUNT {counts}\n"
        f"WIDTH {points}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {points}\nDATA {data}\n"
    ).encode()


def lzf_literals(data: bytes) -> bytes:
    runs = [data[start : start + 32] for start in range(0, len(data), 32)]
    return b"".join(bytes([len(run) - 1]) + run for run in runs)


def test_pcd_ascii(tmp_path: Path) -> None:
    packed = repr(float(np.array([0x00102030], np.uint32).view(np.float32)[0]))
    header = pcd_header("x y z rgb normal_x normal_y normal_z", "8 8 8 4 4 4 4", "F F F F F F F", 2, "ascii")
    cloud = read(tmp_path, "a.pcd", header + f"5412345.1234 2 3 {packed} 0 0 1\nnan nan nan 0 nan nan nan\n".encode())
    np.testing.assert_array_equal(cloud.points, [[5412345.1234, 2, 3]])
    np.testing.assert_array_equal(cloud.colors, [[0x10, 0x20, 0x30]])
    np.testing.assert_array_equal(cloud.normals, [[0, 0, 1]])


def test_pcd_binary_with_padding_and_repeated_fields(tmp_path: Path) -> None:
    header = pcd_header("x y z _ rgba _", "4 4 4 1 4 2", "F F F U U I", 2, "binary", count="1 1 1 4 1 2")
    body = b"".join(struct.pack("<3f4xI4x", x, 2, 3, 0xFF010203) for x in (1, 4))
    cloud = read(tmp_path, "a.pcd", header + body)
    np.testing.assert_array_equal(cloud.points, [[1, 2, 3], [4, 2, 3]])
    np.testing.assert_array_equal(cloud.colors, [[1, 2, 3], [1, 2, 3]])


def test_pcd_binary_compressed(tmp_path: Path) -> None:
    points, colors = make_cloud().points.astype(np.float32), np.arange(50, dtype=np.uint32) << 16
    raw = points.T.tobytes() + colors.tobytes()
    packed = lzf_literals(raw)
    header = pcd_header("x y z rgb", "4 4 4 4", "F F F U", 50, "binary_compressed")
    cloud = read(tmp_path, "a.pcd", header + struct.pack("<II", len(packed), len(raw)) + packed)
    np.testing.assert_array_equal(cloud.points, points)
    np.testing.assert_array_equal(cloud.colors[:, 0], np.arange(50))


def test_pcd_lzf_references_overlap_and_run_long(tmp_path: Path) -> None:
    # 4 literal bytes, then 116 more that repeat them from 4 back (length 2 + 7 + 107 in the long form)
    packed = bytes([3]) + struct.pack("<f", 1.5) + bytes([7 << 5, 107, 3])
    header = pcd_header("x y z", "4 4 4", "F F F", 10, "binary_compressed")
    cloud = read(tmp_path, "a.pcd", header + struct.pack("<II", len(packed), 120) + packed)
    np.testing.assert_array_equal(cloud.points, np.full((10, 3), 1.5))


@pytest.mark.parametrize(
    ("packed", "message"),
    [(bytes([32, 5]), "refer to what is not there"), (bytes([0, 1]), "unpack to 1 bytes"), (bytes([32]), "damaged")],
)
def test_pcd_lzf_faults(tmp_path: Path, packed: bytes, message: str) -> None:
    header = pcd_header("x y z", "4 4 4", "F F F", 1, "binary_compressed")
    with pytest.raises(InputError, match=message):
        read(tmp_path, "a.pcd", header + struct.pack("<II", len(packed), 12) + packed)


# --- text and arrays -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "content",
    [
        "1 2 3\n4 5 6\n",
        "1\t2\t3\r\n4\t5\t6",
        "# a comment\n\n1 2 3  # here too\n// and\n4 5 6\n",
        "1,2,3\n4,5,6\n",
        "1, 2, 3,\n4, 5, 6,\n",
        "1;2;3\n4;5;6\n",
        "1,0;2,0;3,0\n4,0;5,0;6,0\n",
        "1,0 2,0 3,0\n4,0 5,0 6,0\n",
        "2\n1 2 3\n4 5 6\n",
        "\ufeffX,Y,Z\n1,2,3\n4,5,6\n",
        '"x","y","z"\n"1","2","3"\n"4","5","6"\n',
        ",x,y,z\n0,1,2,3\n1,4,5,6\n",
        "id z y x\n7 3 2 1\n8 6 5 4\n",
        "//X Y Z\n1 2 3\n4 5 6\n",
        "# x y z of the scan\n1 2 3\n4 5 6\n",
        "Points:0,Points:1,Points:2\n1,2,3\n4,5,6\n",
        "1 2 3\nnan 0 0\n4 5 6\n1 inf 0\n",
        "1,2,3,,8\n4,5,6,,9\n",
        "1 2 3 0.5\n4 5 6 0.7\n",
        "1 2 3 900 8 1\n4 5 6 3 2 2\n",
    ],
)
def test_text_is_two_points(tmp_path: Path, content: str) -> None:
    cloud = read(tmp_path, "a.xyz", content)
    np.testing.assert_array_equal(cloud.points, [[1, 2, 3], [4, 5, 6]])
    assert cloud.colors is None and cloud.normals is None


@pytest.mark.parametrize(
    "content",
    [
        "1 2 3 255 0 9\n4 5 6 7 8 9\n",
        "2\n1 2 3 -500 255 0 9\n4 5 6 88 7 8 9\n",
        "1 2 3 255 0 9 0 0 1\n4 5 6 7 8 9 1 0 0\n",
        "1 2 3 0 0 1 255 0 9\n4 5 6 1 0 0 7 8 9\n",
        "b,x,y,z,r,g\n9,1,2,3,255,0\n9,4,5,6,7,8\n",
        f"x y z Rf Gf Bf\n1 2 3 1 0 {9 / 255}\n4 5 6 {7 / 255} {8 / 255} {9 / 255}\n",
    ],
)
def test_text_colours(tmp_path: Path, content: str) -> None:
    cloud = read(tmp_path, "a.pts", content)
    np.testing.assert_array_equal(cloud.points, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(cloud.colors, [[255, 0, 9], [7, 8, 9]])


@pytest.mark.parametrize(
    "content", ["1 2 3 0 0 1\n4 5 6 0.6 0 0.8\n", "x,y,z,Nx,Ny,Nz\n1,2,3,0,0,1\n4,5,6,0.6,0,0.8\n"]
)
def test_text_normals(tmp_path: Path, content: str) -> None:
    cloud = read(tmp_path, "a.csv", content)
    np.testing.assert_array_equal(cloud.normals, [[0, 0, 1], [0.6, 0, 0.8]])
    assert cloud.colors is None


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("1 2\n3 4\n", "2 numbers"),
        ("1 2 3\n4 5\n", "columns changed from 3 to 2"),
        ("1 2 3\n4 5 six\n", "six"),
        ("what is this\n1 2 3\n", "line 1"),
        ("5\n1 2 3\n", "cut short"),
        ("# nothing\n", "no points"),
        ("nan nan nan\n", "NaN"),
        ("1 2 3\n\0\n", "not a text file"),
        ("12\n", "no points"),
    ],
)
def test_text_faults(tmp_path: Path, content: str, message: str) -> None:
    with pytest.raises(InputError, match=message) as error:
        read(tmp_path, "a.txt", content)
    assert_refused(error, tmp_path / "a.txt")


def npy(array: np.ndarray, **options: bool) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array, **options)
    return stream.getvalue()


def npz(**arrays: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    return stream.getvalue()


def npz_of(member: bytes) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("points.npy", member)
    return stream.getvalue()


@pytest.mark.parametrize("dtype", ["<f4", ">f8", "<i4", "<f2"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_npy(tmp_path: Path, dtype: str, order: str) -> None:
    array = np.arange(12).reshape(4, 3).astype(dtype, order=order)
    np.testing.assert_array_equal(read(tmp_path, "a.npy", npy(array)).points, array)


def test_npy_with_normals_behind_the_points(tmp_path: Path) -> None:
    cloud = make_cloud()
    back = read(tmp_path, "a.npy", npy(np.hstack([cloud.points, cloud.normals])))
    np.testing.assert_array_equal(back.normals, cloud.normals)


@pytest.mark.parametrize("key", ["points", "xyz", "pcd", "pos", "anything"])
def test_npz_keys(tmp_path: Path, key: str) -> None:
    points = make_cloud().points
    np.testing.assert_array_equal(read(tmp_path, "a.npz", npz(**{key: points}, label=np.zeros(3))).points, points)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.npy", npy(np.zeros(3)), r"shape \(3,\), expected \(N, 3\)"),
        ("a.npy", npy(np.zeros((3, 2))), r"shape \(3, 2\)"),
        ("a.npy", npy(np.zeros((2, 3), complex)), "complex128"),
        ("a.npy", npy(np.full((2, 3), None), allow_pickle=True), "object"),
        ("a.npz", npz(points=np.zeros((3, 2))), r"shape \(3, 2\)"),
        ("a.npz", npz(a=np.zeros((2, 3)), b=np.zeros((2, 3))), "2 arrays of shape"),
        ("a.npz", npz(a=np.zeros(3)), "0 arrays of shape"),
        ("a.npz", npz(points=np.zeros((2, 3)), normals=np.zeros((3, 3))), "differ in number"),
    ],
)
def test_array_file_faults(tmp_path: Path, name: str, content: bytes, message: str) -> None:
    with pytest.raises(InputError, match=message) as error:
        read(tmp_path, name, content)
    assert_refused(error, tmp_path / name)


# --- meshes --------------------------------------------------------------------------------------------------------

OBJ = "# a mesh\no part\nv 0 0 0\nv 3 0 0\nv 0 1 0\nv 3 0 3\nvn 0 0 1\nf 1//1 2//1 3//1\ng other\nf 1 2 4\n"
OFF = "OFF\n4 2 0\n0 0 0\n3 0 0\n0 1 0\n3 0 3\n3 0 1 2\n3 0 1 3\n"
TRIANGLES = [[(0, 0, 0), (3, 0, 0), (0, 1, 0)], [(0, 0, 0), (3, 0, 0), (3, 0, 3)]]
STL = b"\0" * 80 + struct.pack("<I", 2) + b"".join(struct.pack("<12fH", 0, 0, 0, *sum(t, ()), 0) for t in TRIANGLES)
STL_ASCII = "solid a\n{}endsolid a\n".format(
    "".join(
        "facet normal 0 0 0\nouter loop\n" + "".join(f"vertex {x} {y} {z}\n" for x, y, z in t) + "endloop\nendfacet\n"
        for t in TRIANGLES
    )
)


@pytest.mark.parametrize(
    ("name", "content"),
    [("a.obj", OBJ), ("a.off", OFF), ("a.stl", STL), ("a.stl", STL + b"tail"), ("a.stl", STL_ASCII)],
    ids=["obj", "off", "stl", "stl-tail", "stl-ascii"],
)
def test_mesh_is_sampled_evenly_by_area(tmp_path: Path, name: str, content: bytes | str) -> None:
    if name.endswith(".stl"):
        pytest.importorskip("trimesh", reason="STL is read with trimesh")
    cloud = read(tmp_path, name, content)
    assert cloud.points.shape == (20_000, 3)
    lying = cloud.points[:, 2] == 0
    assert lying.mean() == pytest.approx(1.5 / 6.0, abs=0.001)
    np.testing.assert_allclose(np.abs(cloud.normals[lying]), np.tile([0.0, 0, 1], (lying.sum(), 1)))
    np.testing.assert_allclose(cloud.points[lying].mean(axis=0), [1, 1 / 3, 0], atol=0.03)
    np.testing.assert_array_equal(cloud.points, read_point_cloud(tmp_path / name).points)


def test_obj_without_faces_is_its_vertices(tmp_path: Path) -> None:
    cloud = read(tmp_path, "a.obj", "v 5412345.1234 2 3\nv 4 5 6\nv 7 8 9\n")
    np.testing.assert_array_equal(cloud.points, [[5412345.1234, 2, 3], [4, 5, 6], [7, 8, 9]])


def test_damaged_mesh_says_nothing_but_its_error(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(InputError):
        read(tmp_path, "a.stl", STL_ASCII.replace("0 0 0", "0 x 0", 1).replace("vertex 3", "vertex", 1))
    assert not caplog.records
    assert capfd.readouterr() == ("", "")


# --- LAS -----------------------------------------------------------------------------------------------------------


def las_bytes(suffix: str, version: str = "1.4", point_format: int = 7) -> tuple[bytes, PointCloud]:
    laspy = pytest.importorskip("laspy")
    cloud = make_cloud(offset=UTM)
    header = laspy.LasHeader(version=version, point_format=point_format)
    header.offsets, header.scales = UTM.round(), [0.0001] * 3
    las = laspy.LasData(header)
    las.x, las.y, las.z = cloud.points.T
    las.red, las.green, las.blue = cloud.colors.T.astype(np.uint16) * 257
    stream = io.BytesIO()
    las.write(stream, do_compress=suffix == "laz")
    return stream.getvalue(), cloud


@pytest.mark.parametrize("suffix", ["las", "laz"])
@pytest.mark.parametrize(("version", "point_format"), [("1.2", 3), ("1.4", 7)])
def test_las_keeps_its_offset_and_colours(tmp_path: Path, suffix: str, version: str, point_format: int) -> None:
    content, cloud = las_bytes(suffix, version, point_format)
    back = read(tmp_path, f"a.{suffix}", content)
    np.testing.assert_allclose(back.points, cloud.points, rtol=0, atol=0.000051)
    np.testing.assert_array_equal(back.colors, cloud.colors)


def test_las_without_laspy_names_the_pip_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "laspy", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'idam\[las\]'"):
        read(tmp_path, "a.las", b"LASF")


# --- bad files -----------------------------------------------------------------------------------------------------

READABLE = ["ply", "pcd", "xyz", "txt", "asc", "csv", "pts", "npy", "npz", "obj", "stl", "off", "las", "laz"]


@pytest.mark.parametrize("suffix", READABLE)
@pytest.mark.parametrize(
    "content", [b"", b"\0" * 1000, b"\n", bytes(range(256)) * 4, "häßlich".encode(), b"ply\n", b"LASF"]
)
def test_garbage(tmp_path: Path, suffix: str, content: bytes) -> None:
    if suffix in ("las", "laz"):
        pytest.importorskip("laspy")
    with pytest.raises(InputError) as error:
        read(tmp_path, f"a.{suffix}", content)
    assert_refused(error, tmp_path / f"a.{suffix}")


def test_what_is_no_file(tmp_path: Path) -> None:
    (tmp_path / "folder.ply").mkdir()
    os.mkfifo(tmp_path / "pipe.ply")
    (tmp_path / "broken.ply").symlink_to(tmp_path / "gone")
    for name, message in [
        ("none.ply", "no such file"),
        ("folder.ply", "is a folder"),
        (".", "is a folder"),
        ("pipe.ply", "not a regular file"),
        ("broken.ply", "no such file"),
        ("a\0b.ply", "cannot be read|no such file"),
        ("a" * 300 + ".ply", "cannot be read|no such file"),
        ("a.py", r"unknown point cloud format '.py': the ones to read are .asc, .bin, .csv, .*\.xyz"),
        ("a", "unknown point cloud format ''"),
    ]:
        with pytest.raises(InputError, match=message) as error:
            read_point_cloud(tmp_path / name)
        assert_refused(error, tmp_path / name)


def test_unreadable_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_: Path) -> bytes:
        raise PermissionError(13, "Permission denied")

    (tmp_path / "a.ply").write_bytes(b"ply")
    monkeypatch.setattr(Path, "read_bytes", refuse)
    with pytest.raises(InputError, match="Permission denied"):
        read_point_cloud(tmp_path / "a.ply")


def huge_files() -> dict[str, bytes]:
    many = 10**12
    faces = (f"element face {many}", "property list uchar int vertex_indices")
    uint_list = "property list uint double x"
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (many, 3)})
    return {
        "ascii.ply": ply_header(f"element vertex {many}", *XYZ_PROPERTIES).encode() + b"1 2 3\n",
        "binary.ply": ply_header(f"element vertex {many}", *XYZ_PROPERTIES, form="binary_big_endian").encode(),
        "faces.ply": ply_header("element vertex 4", *XYZ_PROPERTIES, *faces).encode() + SQUARE.encode(),
        "list.ply": ply_header("element vertex 1", uint_list, form="binary_big_endian").encode() + b"\xff\xff\xff\xff",
        "ascii.pcd": pcd_header("x y z", "4 4 4", "F F F", many, "ascii") + b"1 2 3\n",
        "binary.pcd": pcd_header("x y z", "4 4 4", "F F F", many, "binary"),
        "counts.pcd": pcd_header("x y z", "4 4 4", "F F F", 1, "binary", count=f"{many} 1 1"),
        "lzf.pcd": pcd_header("x y z", "4 4 4", "F F F", 300_000_000, "binary_compressed")
        + struct.pack("<II", 9, 3_600_000_000) + bytes(9),
        "count.pts": f"{many}\n1 2 3\n".encode(),
        "shape.npy": header.getvalue() + bytes(24),
        "shape.npz": npz_of(header.getvalue() + bytes(24)),
        "count.stl": bytes(80) + b"\xff\xff\xff\xff" + bytes(50),
        "count.off": OFF.replace("4 2", f"{many} 2").encode(),
    }  # fmt: skip


@pytest.mark.parametrize("name", huge_files())
def test_huge_counts_are_refused_before_anything_is_allocated(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError) as error:
        read(tmp_path, name, huge_files()[name])
    assert_refused(error, tmp_path / name)


@pytest.mark.parametrize(
    ("suffix", "at", "form"), [("las", 100, "<I"), ("las", 247, "<Q"), ("laz", 247, "<Q"), ("laz", 100, "<I")]
)
def test_huge_counts_in_las(tmp_path: Path, suffix: str, at: int, form: str) -> None:
    content = bytearray(las_bytes(suffix)[0])
    struct.pack_into(form, content, at, 2**32 - 1)
    with pytest.raises(InputError, match=r"cut short|damaged"):
        read(tmp_path, f"a.{suffix}", bytes(content))


def test_laz_chunks_and_layers_are_checked(tmp_path: Path) -> None:
    content = las_bytes("laz")[0]
    (start,) = struct.unpack_from("<I", content, 96)
    (table,) = struct.unpack_from("<q", content, start)
    row = 36
    for at in (table + 4, start + 8 + row + 4):
        damaged = bytearray(content)
        struct.pack_into("<I", damaged, at, 2**32 - 1)
        with pytest.raises(InputError, match="cut short"):
            read(tmp_path, "a.laz", bytes(damaged))


def test_zip_bomb_is_not_unpacked(tmp_path: Path) -> None:
    content = npz_of(bytes(1_234_567))
    assert len(content) < 2000
    with pytest.raises(InputError, match="packed bytes promise 2,147,483,648"):
        read(tmp_path, "a.npz", content.replace(struct.pack("<I", 1_234_567), struct.pack("<I", 2**31)))


def sample_files() -> dict[str, bytes]:
    """Valid files of the formats and flavours that are read but not written."""
    lists = "element face 2", "property list uchar int vertex_indices"
    raw = make_cloud(20).points.astype("<f4").T.tobytes()
    packed = lzf_literals(raw)
    lzf = pcd_header("x y z", "4 4 4", "F F F", 20, "binary_compressed") + struct.pack("<II", len(packed), len(raw))
    return {
        "ascii.ply": (
            ply_header("element vertex 4", *XYZ_PROPERTIES, *lists) + SQUARE + "3 0 1 2\n4 0 1 2 3\n"
        ).encode(),
        "ascii.pcd": pcd_header("x y z rgb", "4 4 4 4", "F F F F", 2, "ascii") + b"1 2 3 4e-39\n4 5 6 0\n",
        "lzf.pcd": lzf + packed,
        "obj.obj": OBJ.encode(),
        "off.off": OFF.encode(),
        "binary.stl": STL,
        "ascii.stl": STL_ASCII.encode(),
    }


@pytest.fixture(scope="module")
def samples(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    files, folder = sample_files(), tmp_path_factory.mktemp("samples")
    for suffix in WRITABLE:
        write_point_cloud(folder / f"a.{suffix}", make_cloud(20))
        files[f"{suffix}.{suffix}"] = (folder / f"a.{suffix}").read_bytes()
    return files


@pytest.mark.parametrize(
    "name", [*sample_files(), *(f"{suffix}.{suffix}" for suffix in WRITABLE), "las.las", "laz.laz"]
)
def test_damaged_files_read_or_are_refused(
    samples: dict[str, bytes], tmp_path_factory: pytest.TempPathFactory, name: str
) -> None:
    if name.endswith(".stl"):
        pytest.importorskip("trimesh", reason="STL is read with trimesh")
    valid = samples[name] if name in samples else las_bytes(name[:3])[0]
    path = tmp_path_factory.mktemp("damaged") / name

    @settings(max_examples=80, deadline=None, derandomize=True, database=None)
    @given(st.data())
    def check(data: st.DataObject) -> None:
        damaged = bytearray(valid)
        for _ in range(data.draw(st.integers(0, 3))):
            # headers are where it hurts
            at = data.draw(st.integers(0, min(400, len(valid) - 1)) | st.integers(0, len(valid) - 1))
            damaged[at] = data.draw(st.sampled_from(b"\0\xff\x80 \n09-,") | st.integers(0, 255))
        path.write_bytes(damaged[: data.draw(st.just(len(valid)) | st.integers(0, len(valid)))])
        try:
            cloud = read_point_cloud(path)
        except InputError as error:
            assert str(error).startswith(f"{path}: ") and "\n" not in str(error)
        else:
            assert len(cloud.points) and np.isfinite(cloud.points).all()

    path.write_bytes(valid)
    read_point_cloud(path)
    check()


# --- writing -------------------------------------------------------------------------------------------------------


def test_failed_write_leaves_the_old_file_and_nothing_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.ply"
    write_point_cloud(path, make_cloud())
    before = path.read_bytes()

    def refuse(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", refuse)
    with pytest.raises(InputError, match="No space left on device") as error:
        write_point_cloud(path, make_cloud(7))
    assert_refused(error, path)
    assert path.read_bytes() == before
    assert names_in(tmp_path) == ["a.ply"]


def test_where_nothing_can_be_written(tmp_path: Path) -> None:
    (tmp_path / "folder.txt").mkdir()
    (tmp_path / "file").write_text("")
    os.mkfifo(tmp_path / "pipe.txt")
    for name, message in [
        ("none/a.txt", "there is no folder .*: create it first"),
        ("file/a.txt", "there is no folder"),
        ("folder.txt", "is a folder"),
        ("pipe.txt", "not a regular file"),
        ("a\0b.txt", "cannot be written"),
        ("a" * 300 + ".txt", "cannot be written"),
    ]:
        for write in (lambda path: write_text(path, "a"), lambda path: write_point_cloud(path, make_cloud())):
            with pytest.raises(InputError, match=message) as error:
                write(tmp_path / name)
            assert_refused(error, tmp_path / name)
    with pytest.raises(InputError, match=r"unknown point cloud format '.dwg': the ones to write are .*\.ply"):
        write_point_cloud(tmp_path / "a.dwg", make_cloud())
    assert names_in(tmp_path) == ["file", "folder.txt", "pipe.txt"]


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_read_only_folder(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    try:
        with pytest.raises(InputError, match="Permission denied"):
            write_text(tmp_path / "a.txt", "a")
    finally:
        tmp_path.chmod(0o700)


def test_write_goes_through_a_link_and_keeps_the_mode(tmp_path: Path) -> None:
    target, link = tmp_path / "target.txt", tmp_path / "link.txt"
    target.write_text("old")
    target.chmod(0o640)
    link.symlink_to(target)
    write_text(link, "new")
    assert link.is_symlink() and target.read_text() == "new"
    assert target.stat().st_mode & 0o777 == 0o640


def test_json_is_strict_and_plain(tmp_path: Path) -> None:
    write_json(
        tmp_path / "a.json", {"a": np.eye(2), "b": np.float32(0.5), "c": [float("nan"), np.inf], "d": (True, None)}
    )
    content = json.loads((tmp_path / "a.json").read_text(), parse_constant=pytest.fail)
    assert content == {"a": [[1, 0], [0, 1]], "b": 0.5, "c": [None, None], "d": [True, None]}


# --- transforms ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", ["txt", "json", "npy", "mat"])
def test_transform_round_trip_is_exact(tmp_path: Path, suffix: str) -> None:
    write_transform(tmp_path / f"T.{suffix}", make_transform())
    np.testing.assert_array_equal(read_transform(tmp_path / f"T.{suffix}"), make_transform())


def test_transform_is_four_lines_of_four_numbers() -> None:
    lines = format_transform(make_transform() * [1, 1, -1, 1] * [1, 1, -1, 1]).split("\n")
    assert [len(line.split(" ")) for line in lines] == [4, 4, 4, 4]
    assert lines[3] == "0.0 0.0 0.0 1.0"
    np.testing.assert_array_equal([[float(number) for number in line.split(" ")] for line in lines], make_transform())


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("T.txt", "1 0 0 5\n0 1 0 6\n0 0 1 7\n0 0 0 1\n"),
        ("T.txt", "# from somewhere\n1, 0, 0, 5\n0, 1, 0, 6\n0, 0, 1, 7\n0, 0, 0, 1"),
        ("T", "[[1 0 0 5]\n [0 1 0 6]\n [0 0 1 7]\n [0 0 0 1]]"),
        ("T.json", "[[1,0,0,5],[0,1,0,6],[0,0,1,7],[0,0,0,1]]"),
        ("T.JSON", '{"fitness": 1, "transformation": [[1,0,0,5],[0,1,0,6],[0,0,1,7],[0,0,0,1]]}'),
    ],
)
def test_transform_files(tmp_path: Path, name: str, content: str) -> None:
    (tmp_path / name).write_text(content)
    expected = np.eye(4)
    expected[:3, 3] = 5, 6, 7
    np.testing.assert_array_equal(read_transform(tmp_path / name), expected)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("T.txt", b"", "is empty"),
        ("T.txt", b"1 2 3", "no 4 x 4 transform"),
        ("T.txt", b"1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 one", "one"),
        ("T.txt", b"\xff\xfe\0", "no 4 x 4 transform"),
        ("T.txt", b"2 0 0 0\n0 2 0 0\n0 0 2 0\n0 0 0 1", "no rotation .determinant 8"),
        ("T.txt", b"-1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1", "mirrors"),
        ("T.txt", b"1 0 0 0\n0 1 0 0\n0 0 1 0\n5 6 7 1", "last row"),
        ("T.txt", b"1 0 0 nan\n0 1 0 0\n0 0 1 0\n0 0 0 1", "NaN"),
        ("T.txt", b" " * 2_000_000, "bytes are no 4 x 4"),
        ("T.json", b"{", "no 4 x 4 transform"),
        ("T.json", b"{}", 'no key "transformation"'),
        ("T.json", b"[1, 2]", r"got \(2,\)"),
        ("T.json", b"[" * 500_000, "no 4 x 4 transform"),
        ("T.json", b'{"transformation": "no"}', "no 4 x 4 transform"),
        ("T.npy", npy(np.zeros((4, 3))), r"got \(4, 3\)"),
        ("T.npy", b"nothing", "no 4 x 4 transform"),
    ],
)
def test_transform_faults(tmp_path: Path, name: str, content: bytes, message: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=message) as error:
        read_transform(tmp_path / name)
    assert_refused(error, tmp_path / name)


# --- whatever a caller has in hand ---------------------------------------------------------------------------------


def library_object(module: str, **attributes: object) -> object:
    return type("PointCloud", (SimpleNamespace,), {"__module__": module})(**attributes)


def as_tensor(array: np.ndarray) -> SimpleNamespace:
    return SimpleNamespace(cpu=lambda: SimpleNamespace(numpy=lambda: array))


def test_arrays_and_paths(tmp_path: Path) -> None:
    cloud = make_cloud()
    write_point_cloud(tmp_path / "a.npy", cloud)
    assert as_point_cloud(cloud) is cloud
    assert as_point_cloud(cloud.points).points is cloud.points
    for data in (cloud.points.tolist(), cloud.points.astype(">f8"), tmp_path / "a.npy", str(tmp_path / "a.npy")):
        np.testing.assert_array_equal(as_point_cloud(data).points, cloud.points)
    assert np.isnan(as_point_cloud([[np.nan, 0, 0]]).points[0, 0])


def test_torch_tensors() -> None:
    torch = pytest.importorskip("torch")
    points = torch.arange(12.0).reshape(4, 3)
    for tensor in (
        points,
        points.double(),
        points.int(),
        points.clone().requires_grad_(),
        points.bfloat16(),
        points.half(),
    ):
        np.testing.assert_array_equal(as_point_cloud(tensor).points, points.numpy())
    for tensor in (points.to(torch.complex64), points > 1, points.to("meta"), points.to_sparse(), points[None]):
        with pytest.raises(InputError, match=r"expected \(N, 3\)"):
            as_point_cloud(tensor)


def test_open3d_clouds() -> None:
    cloud, fractions = make_cloud(), make_cloud().colors / 255
    legacy = library_object("open3d.cpu.pybind.geometry", points=cloud.points, colors=fractions, normals=cloud.normals)
    tensors = {
        "positions": as_tensor(cloud.points),
        "colors": as_tensor(cloud.colors),
        "normals": as_tensor(cloud.normals),
    }
    for data in (legacy, library_object("open3d.cpu.pybind.t.geometry", point=tensors)):
        back = as_point_cloud(data)
        np.testing.assert_array_equal(back.points, cloud.points)
        np.testing.assert_array_equal(back.colors, cloud.colors)
        np.testing.assert_array_equal(back.normals, cloud.normals)
    empty = np.empty((0, 3))
    bare = as_point_cloud(library_object("open3d.geometry", points=cloud.points, colors=empty, normals=empty))
    assert bare.colors is None and bare.normals is None


def test_trimesh_clouds_and_meshes() -> None:
    trimesh = pytest.importorskip("trimesh")
    cloud = make_cloud()
    plain, coloured = trimesh.PointCloud(cloud.points), trimesh.PointCloud(cloud.points, colors=cloud.colors)
    np.testing.assert_array_equal(as_point_cloud(plain).points, cloud.points)
    assert as_point_cloud(plain).colors is None
    np.testing.assert_array_equal(as_point_cloud(coloured).colors, cloud.colors)
    sampled = as_point_cloud(trimesh.creation.box())
    np.testing.assert_allclose(np.abs(sampled.points).max(axis=1), 0.5)
    assert sampled.points.shape == (20_000, 3)
    holed = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [np.inf, 0, 0]], [[0, 1, 2], [0, 1, 3]], process=False)
    assert np.isfinite(as_point_cloud(holed).points).all()


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (np.zeros((3, 100)), r"expected \(N, 3\), got shape \(3, 100\): transpose it"),
        (np.zeros((2, 4)), r"expected \(N, 3\), got shape \(2, 4\)"),
        (np.zeros(3), r"got shape \(3,\)"),
        (np.zeros((1, 2, 3)), r"got shape \(1, 2, 3\)"),
        (np.zeros((2, 3), complex), "got complex128"),
        (np.zeros((2, 3), bool), "got bool"),
        (np.full((2, 3), None), "got object"),
        ([["a", "b", "c"]], r"expected \(N, 3\) real numbers"),
        ([[1, 2, 3], [4, 5]], "unequal length"),
        ([], r"got shape \(0,\)"),
        (None, "cannot find points in a NoneType"),
        (5, "cannot find points in a int"),
        ({"points": [[1, 2, 3]]}, "cannot find points in a dict"),
        (library_object("open3d.geometry", vertices=[]), "cannot find points in a PointCloud"),
    ],
)
def test_what_is_no_cloud(data: object, message: str) -> None:
    with pytest.raises(InputError, match=message) as error:
        as_point_cloud(data)
    assert "expected (N, 3)" in str(error.value) and "\n" not in str(error.value)


def test_importing_is_light() -> None:
    code = "import idam.io, sys; print(*{'torch', 'scipy', 'trimesh', 'laspy', 'open3d'} & set(sys.modules))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "\n"
