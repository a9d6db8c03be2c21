"""Damaged, absurd and hostile files and arrays: read or refused in one line, quickly, in little memory."""

from __future__ import annotations

import gzip
import io
import struct
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

import fuzzing
from fuzzing import check_refusal, damaged, examples, limits, needs_proc, read_or_refuse
from idam.clouds.frame import check_points
from idam.errors import InputError
from idam.io import PointCloud, as_point_cloud, move_file, read_point_cloud, read_transform, write_point_cloud
from idam.io.notations import FORMS

figures = fuzzing.figures
fuzz, few = examples(60), examples(20)
MOTION = np.array([[0.0, -1, 0, 5], [1, 0, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1]])

pytestmark = needs_proc


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fuzz")


# --- real files, damaged -------------------------------------------------------------------------------------------

MESH = "v 0 0 0\nv 3 0 0\nv 0 1 0\nv 3 0 3\nvt 0 0\nvn 0 0 1\nf 1/1/1 2/1/1 3//1\ng other\nf 1 2 4\n"
TRIANGLE = "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 3 0 0\nvertex 0 1 0\nendloop\nendfacet\n"
SOLID = "solid a\n" + TRIANGLE * 2 + "endsolid a\n"
POLYGONS = (
    "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
    "0 0 0\n1 0 0\n1 1 0\n0 1 0\n3 0 1 2\n4 0 1 2 3\n"
)


def las(suffix: str) -> bytes:
    laspy = pytest.importorskip("laspy")
    data = laspy.LasData(laspy.LasHeader(version="1.4", point_format=7))
    data.x, data.y, data.z = np.random.default_rng(0).normal(size=(3, 40))
    stream = io.BytesIO()
    data.write(stream, do_compress=suffix == "laz")
    return stream.getvalue()


def real_file(folder: Path, name: str) -> bytes:
    suffix = name.partition(".")[2]
    if suffix in ("las", "laz"):
        return las(suffix)
    if suffix == "e57":
        pytest.importorskip("pye57")
    if suffix == "glb":
        trimesh = pytest.importorskip("trimesh")
        return bytes(trimesh.creation.box().export(file_type="glb"))
    by_hand = {
        "a.obj": MESH.encode(),
        "coff.off": b"CNOFF\n3 0 0\n0 0 0 0 0 1 255 0 9 255\n1 0 0 0 0 1 255 0 9 255\n0 1 0 0 0 1 2 3 4 255\n",
        "a.ptx": (
            b"3\n1\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n0 1 0 0\n-1 0 0 0\n0 0 1 0\n10 20 30 1\n" + b"1 0 0 0.5 1 2 3\n" * 3
        )
        * 2,
        "a.bin": np.random.default_rng(0).random((40, 4), np.float32).tobytes(),
        "a.xyz.gz": gzip.compress(b"0 0 0\n1 0 0\n0 1 0\n" * 40, mtime=0),
        "a.off": b"OFF\n4 2 0\n0 0 0\n3 0 0\n0 1 0\n3 0 3\n3 0 1 2\n3 0 1 3\n",
        "ascii.stl": SOLID.encode(),
        "a.stl": bytes(80) + struct.pack("<I", 1) + struct.pack("<12fH", 0, 0, 1, 0, 0, 0, 3, 0, 0, 0, 1, 0, 0),
        "ascii.ply": POLYGONS.encode(),
    }
    if name in by_hand:
        return by_hand[name]
    random = np.random.default_rng(0)
    normals = np.tile([0.0, 0.6, 0.8], (40, 1))
    colours = random.integers(0, 256, (40, 3), dtype=np.uint8)
    offset = 5e6 if name == "utm.pcd" else 0.0  # which makes it ASCII
    write_point_cloud(folder / f"valid.{suffix}", PointCloud(random.normal(size=(40, 3)) + offset, colours, normals))
    return (folder / f"valid.{suffix}").read_bytes()


NAMES = [
    "a.ply",
    "ascii.ply",
    "a.pcd",
    "utm.pcd",
    "a.xyz",
    "a.txt",
    "a.csv",
    "a.pts",
    "a.npy",
    "a.npz",
    "a.obj",
    "a.off",
]
NAMES += ["a.stl", "ascii.stl", "a.las", "a.laz", "coff.off", "a.ptx", "a.bin", "a.xyz.gz", "a.glb", "a.e57"]


@pytest.mark.parametrize("name", NAMES)
def test_damaged_files(folder: Path, name: str) -> None:
    if name.endswith(".stl"):
        pytest.importorskip("trimesh", reason="STL is read with trimesh")
    valid, path = real_file(folder, name), folder / name
    assert read_or_refuse(path, valid, read_point_cloud) is not None

    @fuzz
    @given(damaged(valid))
    def check(data: bytes) -> None:
        read_or_refuse(path, data, read_point_cloud)

    check()


@pytest.mark.parametrize(
    "name", ["a.ply", "ascii.ply", "a.obj", "a.off", "coff.off", "a.stl", "a.las", "a.laz", "a.csv"]
)
def test_damaged_files_move_or_are_refused(folder: Path, name: str) -> None:
    valid, source, moved = real_file(folder, name), folder / f"still-{name}", folder / f"moved-{name}"

    @fuzz
    @given(damaged(valid))
    def check(data: bytes) -> None:
        moved.unlink(missing_ok=True)
        done = read_or_refuse(source, data, lambda path: [move_file(path, MOTION, moved)], moved)
        assert (done is not None) == moved.exists()

    check()


# --- headers made up -----------------------------------------------------------------------------------------------

COUNTS = st.sampled_from([0, 1, 2, 3, 20, 255, 2**31, 10**12, 2**64]) | st.integers(0, 40)
PLY_TYPES = ["char", "uchar", "short", "ushort", "int", "uint", "float", "double", "int8", "float64"]
PLY_NAMES = ["x", "y", "z", "nx", "red", "x", "vertex_indices", "vertex_index", "flags", "ä"]


@st.composite
def ply_files(draw: st.DrawFn) -> bytes:
    form = draw(st.sampled_from(["ascii", "binary_little_endian", "binary_big_endian"]))
    lines = ["ply", f"format {form} 1.0"]
    for _ in range(draw(st.integers(0, 4))):
        lines.append(f"element {draw(st.sampled_from(['vertex', 'face', 'vertex', 'edge']))} {draw(COUNTS)}")
        for _ in range(draw(st.integers(0, 6))):
            kinds = [draw(st.sampled_from(PLY_TYPES)) for _ in range(draw(st.integers(1, 2)))]
            is_list = "list " if len(kinds) == 2 else ""
            lines.append(f"property {is_list}{' '.join(kinds)} {draw(st.sampled_from(PLY_NAMES))}")
        if draw(st.booleans()):
            lines += [f"property float {axis}" for axis in "xyz"]
    if draw(st.integers(0, 9)) == 0:
        lines += ["property uchar flags"] * 3000
    body = draw(st.binary(max_size=300))
    if form == "ascii":
        body = b" ".join(b"%d" % byte for byte in body)
    return "\n".join([*lines, "end_header", ""]).encode("latin-1") + body


@st.composite
def pcd_files(draw: st.DrawFn) -> bytes:
    names = [*draw(st.lists(st.sampled_from(["x", "y", "rgb", "normal_x", "_"]), max_size=4)), "x", "y", "z"]
    fields = {
        "FIELDS": names,
        "SIZE": [draw(st.sampled_from([1, 2, 4, 8, 16, 4, 4, 3, 0])) for _ in names],
        "TYPE": [draw(st.sampled_from("FFFUIX" if draw(st.booleans()) else "F")) for _ in names],
        "COUNT": [draw(st.sampled_from([1, 1, 1, 1, 2, 0, -1, 10**12])) for _ in names],
        "WIDTH": [draw(COUNTS)],
        "HEIGHT": [draw(st.sampled_from([1, 0, 10**12]))],
        "POINTS": [draw(COUNTS)],
    }
    for name in draw(st.lists(st.sampled_from(list(fields)), max_size=1)):
        del fields[name]
    data = draw(st.sampled_from(["ascii", "binary", "binary_compressed"]))
    body = draw(st.binary(max_size=400))
    if data == "ascii":
        body = b" ".join(b"%d" % byte for byte in body)
    if data == "binary_compressed":
        body = struct.pack("<II", *draw(st.tuples(*[st.sampled_from([len(body), 0, 12, 240, 2**32 - 1])] * 2))) + body
    lines = [f"{name} {' '.join(map(str, values))}" for name, values in fields.items()]
    return "\n".join([*lines, f"DATA {data}", ""]).encode() + body


@st.composite
def npy_files(draw: st.DrawFn) -> bytes:
    kinds = ["<f8", "<f4", ">f2", "<f16", "<c16", "|b1", "|O", "|S3", "<U2", "<M8[s]", "|V8", "<i8", "|u1", "<f0", "x"]
    sizes = st.sampled_from([0, 1, 2, 3, 6, 9, -1, 10**12, 2**63, 2**64])
    header = {
        "descr": draw(st.sampled_from(["<f8", *kinds, [("x", "<f8"), ("y", "<f8")], ("<f8", (10**9,))])),
        "fortran_order": draw(st.sampled_from([False, True, 0])),
        "shape": draw(st.lists(sizes, max_size=3).map(tuple) | st.just((2, 3)) | st.just(7)),
    }
    text = repr(header).encode().ljust(draw(st.sampled_from([0, 118]))) + b"\n"
    version = draw(st.sampled_from([b"\1\0", b"\1\0", b"\2\0", b"\3\0", b"\xff\xff"]))
    length = draw(st.sampled_from([len(text), len(text), len(text), 0, 65535]))
    packed = struct.pack("<H" if version == b"\1\0" else "<I", length)
    return b"\x93NUMPY" + version + packed + text + draw(st.binary(max_size=200))


@st.composite
def npz_files(draw: st.DrawFn) -> bytes:
    stream = io.BytesIO()
    packing = draw(st.sampled_from([zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2]))
    with zipfile.ZipFile(stream, "w", packing) as archive:
        for name in draw(st.lists(st.sampled_from(["points", "xyz", "normals", "colors", "a", "../b"]), unique=True)):
            archive.writestr(f"{name}.npy", draw(npy_files()))
    return draw(damaged(stream.getvalue()))


NUMBERS = ["0", "1", "-2.5", "1e400", "1e-400", "nan", "inf", "", "1,5", "x", "#", "//", '"3"', "1_0", "0x1", "²"]


@st.composite
def tables(draw: st.DrawFn) -> bytes:
    separator = draw(st.sampled_from([" ", ",", ";", "\t", ", ", " , ; "]))
    words = st.sampled_from(["1", "2", "3", *(NUMBERS if draw(st.booleans()) else [])])
    width = draw(st.integers(0, 10))
    rows = draw(st.lists(st.lists(words, min_size=width, max_size=width), max_size=12))
    head = draw(
        st.sampled_from(["", "x y z", "X,Y,Z,red,green,blue", "1000000000000", "3", "# x y z", "\ufeff", "a b c"])
    )
    end = draw(st.sampled_from(["\n", "\r\n", "\r"]))
    return end.join([head, *(separator.join(row) for row in rows)]).encode()


@st.composite
def meshes(draw: st.DrawFn) -> bytes:
    words = ["0", "1", "2", "3", "-1", "1/1/1", "1//", "99999999999", "1e308", "nan", "x", "3 0 1 2", "4 4 0"]
    words += ["v 0 0 1", "v", "f 1 2 3", "f", "vn", "usemtl a", "mtllib ../a.mtl", "vertex", "solid", "OFF", "COFF"]
    lines = draw(st.lists(st.lists(st.sampled_from(words), max_size=5).map(" ".join), max_size=25))
    start = draw(st.sampled_from(["", "OFF\n", "OFF\n4 2 0\n", "OFF 3 1 0\n", "solid a\n", MESH, SOLID]))
    return (start + "\n".join(lines)).encode()


MADE_UP = {
    "made.ply": ply_files(),
    "made.pcd": pcd_files(),
    "made.npy": npy_files(),
    "made.npz": npz_files(),
    "made.csv": tables(),
    "made.pts": tables(),
    "made.obj": meshes(),
    "made.off": meshes(),
    "made.stl": meshes(),
    "made.xyz": tables(),
    "made.ptx": tables(),
}


@pytest.mark.parametrize("name", MADE_UP)
def test_made_up_files(folder: Path, name: str) -> None:
    @examples(120)
    @given(MADE_UP[name])
    def check(content: bytes) -> None:
        read_or_refuse(folder / name, content, read_point_cloud)

    check()


@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_made_up_las_headers(folder: Path, suffix: str) -> None:
    valid = las(suffix)

    @fuzz
    @given(st.lists(st.tuples(st.integers(24, 374), st.sampled_from([0, 1, 255, 2**16, 2**32 - 1])), max_size=4))
    def check(fields: list[tuple[int, int]]) -> None:
        content = bytearray(valid)
        for at, value in fields:
            struct.pack_into("<I", content, at, value)
        read_or_refuse(folder / f"made.{suffix}", bytes(content), read_point_cloud)

    check()


@pytest.mark.parametrize("suffix", ["ply", "pcd", "csv", "npy", "npz", "obj", "stl", "off"])
@few
@given(size=st.sampled_from([0, 1, 83, 84, 10**5]), byte=st.sampled_from(b"\0\xff \n,1#vO"))
def test_one_byte_over_and_over(folder: Path, suffix: str, size: int, byte: int) -> None:
    assert read_or_refuse(folder / f"same.{suffix}", bytes([byte]) * size, read_point_cloud) is None


def test_thousands_of_materials_and_corners(folder: Path) -> None:
    parts = b"".join(b"usemtl m%d\nf 1 2 3\n" % n for n in range(5000))
    assert (
        read_or_refuse(folder / "materials.obj", b"mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\n" + parts, read_point_cloud)
        is not None
    )
    header, lists = (
        POLYGONS.split("element face")[0],
        "element face 1\nproperty list uint uchar vertex_index\nend_header\n",
    )
    square = struct.pack("<12f", 0, 0, 0, 1, 0, 0, 1, 1, 0, 0, 1, 0)
    corners = struct.pack("<I", 2**20) + bytes(range(4)) * 2**18
    binary = (header.replace("ascii", "binary_little_endian") + lists).encode()
    assert read_or_refuse(folder / "corners.ply", binary + square + corners, read_point_cloud) is not None


@pytest.mark.skipif(np.finfo(np.longdouble).max == np.finfo(np.float64).max, reason="no extended floats here")
@pytest.mark.parametrize("suffix", ["npy", "pcd"])
def test_extended_floats_past_the_largest_double_are_left_out(folder: Path, suffix: str) -> None:
    points = np.ones((5, 3), np.longdouble)
    points[0, 0] = np.longdouble("1e400")
    stream = io.BytesIO()
    np.save(stream, points)
    pcd = b"FIELDS x y z\nSIZE 16 16 16\nTYPE F F F\nPOINTS 5\nDATA binary\n" + points.tobytes()
    assert (
        len(
            read_or_refuse(
                folder / f"wide.{suffix}", {"npy": stream.getvalue(), "pcd": pcd}[suffix], read_point_cloud
            ).points
        )
        == 4
    )


@fuzz
@given(damaged(b"[[1, 0, 0, 5], [0, 1, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1]]"), st.sampled_from(["txt", "json", "npy"]))
def test_damaged_transforms(folder: Path, content: bytes, suffix: str) -> None:
    found = read_or_refuse(folder / f"T.{suffix}", content, read_transform)
    if found is not None:
        assert found.shape == (4, 4) and np.isfinite(found).all()


WORDS = [
    "1", "0", "-0.5", "1e400", "nan", "90", "translation", "quaternion", "xyzw", "wxyz", "euler", "xyz", "ZYX", "rpy",
    "degrees", "intrinsic", "extrinsic", "static_transform_publisher", "--x", "--qw", "--yaw", "[", "\n", "tx", "qw",
]  # fmt: skip


@fuzz
@given(st.lists(st.sampled_from(WORDS), max_size=24), st.sampled_from([*FORMS]))
def test_made_up_transforms(folder: Path, words: list[str], form: str) -> None:
    found = read_or_refuse(folder / "made.txt", " ".join(words).encode(), read_transform)
    if found is not None:
        (folder / "again.txt").write_text(FORMS[form](found))
        np.testing.assert_allclose(read_transform(folder / "again.txt"), found, atol=2e-3)


@pytest.mark.parametrize("huge", ["1e308 0 0", "1e308 1e308 0", "1e200 -1e200 1e200"])
def test_transforms_that_overflow_are_refused(folder: Path, huge: str) -> None:
    content = f"{huge} 5\n1e308 -1e308 0 6\n0 0 1 7\n0 0 0 1\n".encode()
    assert read_or_refuse(folder / "T.txt", content, read_transform) is None


# --- arrays --------------------------------------------------------------------------------------------------------


def checked(data: Any) -> np.ndarray | None:
    """What registration makes of it, or None where it is refused as it should be."""
    with limits(), np.errstate(over="ignore"):
        try:
            points = as_point_cloud(data).points
            check_points(points, "source")
        except InputError as error:
            check_refusal(error)
            return None
    assert points.dtype == np.float64
    assert points.ndim == 2 and points.shape[1] == 3 and len(points) >= 20
    assert np.isfinite(points).all()
    return points


DTYPES = hnp.scalar_dtypes() | st.sampled_from([np.dtype("O"), np.dtype([("x", "f8")]), np.dtype("f2"), np.dtype("g")])
SHAPES = hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4) | st.sampled_from([(25, 3), (3, 25), (25, 4)])


@examples(150)
@given(st.data())
def test_any_array(data: st.DataObject) -> None:
    checked(data.draw(hnp.arrays(data.draw(DTYPES), data.draw(SHAPES), fill=st.nothing())))


NESTED = st.recursive(
    st.none() | st.integers() | st.floats() | st.text(max_size=3) | st.binary(max_size=3),
    lambda inner: st.lists(inner, max_size=4) | st.tuples(inner, inner, inner) | st.dictionaries(st.text(), inner),
    max_leaves=30,
)


@fuzz
@given(NESTED)
def test_anything_else_in_lists(data: Any) -> None:
    if not isinstance(data, str):  # a path
        assert checked(data) is None


def surface(count: int = 30) -> np.ndarray:
    return np.random.default_rng(0).normal(size=(count, 3))


@pytest.mark.parametrize("exponent", [-10, -5, 0, 5, 20, 90])
def test_surfaces_of_any_scale_are_taken(exponent: int) -> None:
    assert checked(surface() * 10.0**exponent) is not None


@pytest.mark.parametrize("spoiled", [np.nan, np.inf, -np.inf, 1e300])
@few
@given(row=st.integers(0, 29), column=st.integers(0, 2))
def test_a_value_that_is_no_number_is_refused(spoiled: float, row: int, column: int) -> None:
    points = surface()
    points[row, column] = spoiled
    assert checked(points) is None


@fuzz
@given(
    direction=st.tuples(*[st.floats(-1, 1)] * 3),
    start=st.tuples(*[st.floats(-1e6, 1e6)] * 3),
    exponent=st.integers(-320, 300),
    count=st.integers(0, 200),
)
def test_points_on_a_line_are_refused(direction: Any, start: Any, exponent: int, count: int) -> None:
    with np.errstate(all="ignore"):
        along = np.linspace(0, 1, count)[:, None] * direction
        points = np.array(start) * (exponent > -10) + along * 10.0**exponent
    assert checked(points) is None


@fuzz
@given(distinct=st.integers(1, 40), copies=st.integers(1, 40), exponent=st.integers(-5, 5))
def test_copies_of_points(distinct: int, copies: int, exponent: int) -> None:
    points = np.tile(surface(distinct) * 10.0**exponent, (copies, 1))
    taken = checked(points)
    assert (taken is not None) == (len(points) >= 20 and distinct >= 3)


def test_checks_leave_the_points_as_they_were() -> None:
    points = surface()
    check_points(points, "source")
    np.testing.assert_array_equal(points, surface())
