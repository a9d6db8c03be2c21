"""Formats of scanners and programs: what each keeps, what is left out, and what a moved file still holds."""

from __future__ import annotations

import gzip
import io
import logging
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from idam import rigid
from idam.errors import InputError, MissingDependencyError
from idam.io import Mesh, PointCloud, move_file, read_point_cloud, read_scans, write_point_cloud

UTM = np.array([412_345.678_9, 5_412_345.123_4, 312.5])
MOTION = rigid.exp(np.array([0.2, -0.4, 1.1, 3.0, -2.0, 0.5]))


def make_cloud(count: int = 60, offset: np.ndarray | float = 0.0, **attributes: Any) -> PointCloud:
    random = np.random.default_rng(5)
    normals = random.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    colors = random.integers(0, 256, (count, 3), dtype=np.uint8)
    return PointCloud(random.normal(size=(count, 3)) + offset, colors, normals, attributes)


def read(folder: Path, name: str, content: bytes | str) -> PointCloud:
    (folder / name).write_bytes(content.encode() if isinstance(content, str) else content)
    return read_point_cloud(folder / name)


# --- attributes ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", ["ply", "pcd", "xyz", "csv", "npz", "las", "laz", "ply.gz", "csv.gz"])
def test_attributes_come_back(tmp_path: Path, suffix: str) -> None:
    if suffix in ("las", "laz"):
        pytest.importorskip("laspy")
    time = np.linspace(0, 1, 60) + 1e9
    labels = np.arange(60, dtype=np.uint8)
    cloud = make_cloud(intensity=np.linspace(-3, 900, 60).astype(np.float32), time=time, label=labels)
    write_point_cloud(tmp_path / f"a.{suffix}", cloud)
    back = read_point_cloud(tmp_path / f"a.{suffix}")
    for name, values in cloud.attributes.items():
        np.testing.assert_array_equal(back.attributes[name], values)
    np.testing.assert_array_equal(back.colors, cloud.colors)
    np.testing.assert_allclose(back.normals, cloud.normals, atol=1e-6)
    np.testing.assert_allclose(back.points, cloud.points, atol=1e-6)


def test_a_point_left_out_takes_its_attributes_along(tmp_path: Path) -> None:
    cloud = read(tmp_path, "a.csv", "x,y,z,t\n0,0,0,1\nnan,0,0,2\n1,1,1,3\n")
    np.testing.assert_array_equal(cloud.attributes["t"], [1, 3])


def test_what_is_left_out_is_logged(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO, "idam.io"):
        read(tmp_path, "a.csv", "name,x,y,z\nP1,0,0,0\nP2,nan,0,0\nP3,1,1,1\n")
    assert "left out columns that hold text: name" in caplog.text
    assert "left out 1 points that are NaN or infinite" in caplog.text


# --- clouds with a stray face, and meshes ----------------------------------------------------------------------------

TRIANGLE_OF_MANY = "".join(f"{x} {x * x % 7} {x % 5}\n" for x in range(30))


def ply(vertices: str, faces: str, count: int, properties: str = "") -> bytes:
    header = f"ply\nformat ascii 1.0\nelement vertex {count}\nproperty float x\nproperty float y\nproperty float z\n"
    lists = f"element face {len(faces.splitlines())}\nproperty list uchar int vertex_indices\n"
    return f"{header}{properties}{lists}end_header\n{vertices}{faces}".encode()


@pytest.mark.parametrize("faces", ["3 0 1 2\n", "3 0 1 1\n", "3 0 1 2\n3 3 4 5\n", "3 -1 -1 -1\n"])
def test_vertices_that_mostly_belong_to_no_face_are_a_cloud(tmp_path: Path, faces: str) -> None:
    cloud = read(tmp_path, "a.ply", ply(TRIANGLE_OF_MANY, faces, 30))
    assert len(cloud.points) == 30
    vertices = "".join(f"v {line}\n" for line in TRIANGLE_OF_MANY.splitlines())
    lines = "".join("f " + " ".join(str(int(n) + 1) for n in face.split()[1:]) + "\n" for face in faces.splitlines())
    if "-1" not in faces:  # which in OBJ is the last vertex
        assert len(read(tmp_path, "a.obj", vertices + lines).points) == 30
        off = f"OFF\n30 {faces.count(chr(10))} 0\n{TRIANGLE_OF_MANY}{faces}"
        assert len(read(tmp_path, "a.off", off).points) == 30


def test_faces_without_area_are_no_reason_to_refuse(tmp_path: Path) -> None:
    assert len(read(tmp_path, "a.ply", ply("0 0 0\n1 0 0\n2 0 0\n", "3 0 1 2\n3 0 0 1\n", 3)).points) == 3
    sampled = read(tmp_path, "b.ply", ply("0 0 0\n1 0 0\n0 1 0\n", "3 0 1 2\n3 0 0 1\n", 3))
    assert len(sampled.points) == 20_000


@pytest.mark.parametrize(
    ("end", "close"), [("\r", "\r"), ("\n\r", "\n\r"), ("\r\n", "\r\n"), ("\n", "\n"), ("\r\n", "\n"), ("\n", "\r\n")]
)
@pytest.mark.parametrize("first", [b"\x0a", b"\x0d", b"\x00"])
def test_ply_header_may_end_its_lines_in_any_way(tmp_path: Path, end: str, close: str, first: bytes) -> None:
    if end == "\n" and close == "\n" and first == b"\x0a":
        pytest.skip("the ordinary case, below")
    points = np.frombuffer(first + bytes(3) + struct.pack("<5f", 1, 2, 3, 4, 5), "<f4").reshape(2, 3)
    lines = ["ply", "format binary_little_endian 1.0", "element vertex 2", *(f"property float {a}" for a in "xyz")]
    header = end.join([*lines, "end_header"]) + close
    np.testing.assert_array_equal(read(tmp_path, "a.ply", header.encode() + points.tobytes()).points, points)


@pytest.mark.parametrize(
    ("vertices", "faces"),
    [
        ("0 0 0\n1 0 0\n0 1 0\n", "3 0 1 2 3 1 1 1\n"),
        ("0 0 0 9\n1 0 0 9\n0 1 0 9\n", "3 0 1 2\n"),
        ("0 0 0 9 9\n1 0 0\n0 1 0 9\n", "3 0 1 2 77\n"),
        ("0 0 0\n1 0 0\n0 1 0\n", "3 0 1 2\n5 5 5 5\n"),
    ],
)
def test_ply_text_with_surplus_numbers_is_read_by_its_lines(tmp_path: Path, vertices: str, faces: str) -> None:
    content = ply(vertices, faces, 3).replace(b"element face 2", b"element face 1")
    cloud = read(tmp_path, "a.ply", content)
    assert len(cloud.points) == 20_000
    np.testing.assert_array_equal(cloud.normals, np.tile([0.0, 0, 1], (20_000, 1)))


@pytest.mark.parametrize("nan", ["1.#QNAN", "-1.#IND", "nan(ind)", "-nan(ind)", "1.#INF", "1.#J", "-nan"])
def test_windows_nan_is_left_out(tmp_path: Path, nan: str) -> None:
    rows = f"0 0 0\n{nan} {nan} {nan}\n1 0 {nan}\n0 1 0\n"
    pcd = "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 4\nHEIGHT 1\nPOINTS 4\nDATA ascii\n"
    for name, content in {"a.ply": ply(rows, "", 4), "a.pcd": pcd + rows, "a.xyz": rows}.items():
        np.testing.assert_array_equal(read(tmp_path, name, content).points, [[0, 0, 0], [0, 1, 0]])


def test_obj_colours_weights_and_normals(tmp_path: Path) -> None:
    cloud = read(tmp_path, "a.obj", "v 0 0 0 1 0 0.5\nv 1 2 3 0 1 0\nvn 0 0 1\nvn 0 1 0\n")
    np.testing.assert_array_equal(cloud.colors, [[255, 0, 128], [0, 255, 0]])
    np.testing.assert_array_equal(cloud.normals, [[0, 0, 1], [0, 1, 0]])
    cloud = read(tmp_path, "b.obj", "v 2 4 6 2\nv 1 2 3\nv 1 1 1 0\n")  # the last is at infinity
    np.testing.assert_array_equal(cloud.points, [[1, 2, 3], [1, 2, 3]])
    np.testing.assert_array_equal(read(tmp_path, "c.obj", "v 1 2 3 1 255 0 9\n").colors, [[255, 0, 9]])
    with pytest.raises(InputError, match="7 numbers"):
        read(tmp_path, "d.obj", "v 1 2 3 0.5 0.1 0.2 1\n")
    with pytest.raises(InputError, match="differ in how many"):
        read(tmp_path, "d.obj", "v 1 2 3\nv 1 2 3 0.1 0.2 1\n")


@pytest.mark.parametrize(
    ("head", "row", "colors", "normals"),
    [
        ("COFF", "1 2 3 255 0 9 255", [255, 0, 9], None),
        ("COFF", "1 2 3 1.0 0.0 0.5 1.0", [255, 0, 128], None),
        ("CNOFF", "1 2 3 0 0 1 255 0 9 255", [255, 0, 9], [0, 0, 1]),
        ("NOFF", "1 2 3 0 0 1", None, [0, 0, 1]),
        ("4OFF", "2 4 6 2", None, None),
    ],
)
def test_off_of_each_kind(tmp_path: Path, head: str, row: str, colors: list[int], normals: list[int]) -> None:
    cloud = read(tmp_path, "a.off", f"{head}\n# made by hand\n2 0 0\n{row}\n{row}\n")
    np.testing.assert_array_equal(cloud.points, [[1, 2, 3], [1, 2, 3]])
    assert cloud.colors is None if colors is None else (cloud.colors == colors).all()
    assert cloud.normals is None if normals is None else (cloud.normals == normals).all()


CORNERS = np.array([[0, 0, 0], [2, 0, 0], [0, 1, 0], [0, 0, 3.0]])
FACES = np.array([[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]])


def mesh_in(path: Path) -> Mesh:
    """The mesh that a file holds, by trimesh: a second opinion."""
    trimesh = pytest.importorskip("trimesh")
    loaded = trimesh.load(path, force="mesh", process=False)
    return Mesh(PointCloud(np.asarray(loaded.vertices)), np.asarray(loaded.faces))


@pytest.mark.parametrize("source", ["ply", "obj", "off", "stl", "glb"])
@pytest.mark.parametrize("target", ["ply", "obj", "off", "stl", "glb"])
@pytest.mark.filterwarnings("ignore::DeprecationWarning:trimesh")
def test_a_moved_mesh_is_a_mesh(tmp_path: Path, source: str, target: str) -> None:
    trimesh = pytest.importorskip("trimesh")
    trimesh.Trimesh(CORNERS, FACES, process=False).export(tmp_path / f"a.{source}")
    move_file(tmp_path / f"a.{source}", MOTION, tmp_path / f"b.{target}")
    moved = mesh_in(tmp_path / f"b.{target}")
    assert len(moved.faces) == 4
    expected = rigid.apply(MOTION, CORNERS)[FACES]
    np.testing.assert_allclose(moved.vertices.points[moved.faces], expected, atol=1e-5)


def test_an_stl_of_several_solids_is_all_of_them(tmp_path: Path) -> None:
    pytest.importorskip("trimesh")
    facet = "facet normal 0 0 1\nouter loop\nvertex {0} 0 0\nvertex {1} 0 0\nvertex {0} 1 0\nendloop\nendfacet\n"
    solids = "".join(f"solid {at}\n{facet.format(at, at + 1)}endsolid {at}\n" for at in (0, 5))
    points = read(tmp_path, "a.stl", solids).points
    assert len(points) == 20_000 and points[:, 0].max() > 5 and not ((points[:, 0] > 1) & (points[:, 0] < 5)).any()


def test_a_moved_mesh_without_a_place_for_faces_is_sampled_with_a_word(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "a.off").write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    move_file(tmp_path / "a.off", MOTION, tmp_path / "b.xyz")
    assert "holds no faces" in caplog.text
    assert len(read_point_cloud(tmp_path / "b.xyz").points) == 20_000


def test_cloud_cannot_become_a_mesh_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds a mesh, not points"):
        write_point_cloud(tmp_path / "a.stl", make_cloud())
    assert not list(tmp_path.iterdir())


def test_ply_moves_with_everything_it_holds(tmp_path: Path) -> None:
    plyfile = pytest.importorskip("plyfile")
    vertex = np.array(
        [(0, 0, 0, 0, 0, 1, 7, 0.5), (2, 0, 0, 0, 1, 0, 8, 1.5), (0, 1, 0, 1, 0, 0, 9, 2.5)],
        [*((a, "f4") for a in "xyz"), *((f"n{a}", "f4") for a in "xyz"), ("label", "u2"), ("quality", "f8")],
    )
    face = np.empty(2, [("vertex_indices", "O"), ("texture", "O"), ("flag", "u1")])
    face[0], face[1] = ([0, 1, 2], [0.5, 1.5], 3), ([0, 2, 1, 0], [2.5], 4)
    camera = np.array([(1.5,)], [("focus", "f8")])
    elements = [plyfile.PlyElement.describe(each, name) for each, name in ((camera, "camera"), (vertex, "vertex"))]
    lists = plyfile.PlyElement.describe(
        face, "face", len_types={"vertex_indices": "u1", "texture": "u1"}, val_types={"texture": "f4"}
    )
    for text, order in ((True, "="), (False, ">"), (False, "<")):
        plyfile.PlyData([*elements, lists], text=text, byte_order=order).write(tmp_path / "a.ply")
        move_file(tmp_path / "a.ply", MOTION, tmp_path / "b.ply")
        back = plyfile.PlyData.read(tmp_path / "b.ply")
        points = np.stack([back["vertex"][axis] for axis in "xyz"], axis=1)
        normals = np.stack([back["vertex"][f"n{axis}"] for axis in "xyz"], axis=1)
        np.testing.assert_allclose(points, rigid.apply(MOTION, np.stack([vertex[a] for a in "xyz"], 1)), atol=1e-6)
        np.testing.assert_allclose(normals, [[0, 0, 1], [0, 1, 0], [1, 0, 0]] @ MOTION[:3, :3].T, atol=1e-6)
        np.testing.assert_array_equal(back["vertex"]["label"], [7, 8, 9])
        assert back["vertex"]["label"].dtype.itemsize == 2
        np.testing.assert_array_equal(back["vertex"]["quality"], [0.5, 1.5, 2.5])
        assert [list(each) for each in back["face"]["vertex_indices"]] == [[0, 1, 2], [0, 2, 1, 0]]
        assert [list(each) for each in back["face"]["texture"]] == [[0.5, 1.5], [2.5]]
        np.testing.assert_array_equal(back["face"]["flag"], [3, 4])
        assert back["camera"]["focus"][0] == 1.5


def test_ply_moved_far_away_becomes_double(tmp_path: Path) -> None:
    write_point_cloud(tmp_path / "a.ply", make_cloud())
    far = rigid.transform(np.eye(3), UTM)
    move_file(tmp_path / "a.ply", far, tmp_path / "b.ply")
    expected = read_point_cloud(tmp_path / "a.ply").points + UTM
    np.testing.assert_array_equal(read_point_cloud(tmp_path / "b.ply").points, expected)


def test_obj_moves_line_by_line(tmp_path: Path) -> None:
    text = "mtllib a.mtl\nv 1 0 0 0.5 0.5 0.5\nv 0 1 0 1 0 0\nv 0 0 1 0 1 0\nvt 0 0\nvn 0 0 1\nusemtl red\n"
    text += "f 1/1/1 2/1/1 3/1/1\n"
    (tmp_path / "a.obj").write_text(text)
    move_file(tmp_path / "a.obj", MOTION, tmp_path / "b.obj")
    lines, before = (tmp_path / "b.obj").read_text().splitlines(), text.splitlines()
    for line, old in zip(lines, before, strict=True):
        if not old.startswith(("v ", "vn ")):
            assert line == old
    moved = np.array([line.split()[1:4] for line in lines if line.startswith("v ")], float)
    np.testing.assert_allclose(moved, rigid.apply(MOTION, np.eye(3)), atol=1e-15)
    assert [line.split()[4:] for line in lines if line.startswith("v ")][1] == ["1", "0", "0"]


# --- LAS -----------------------------------------------------------------------------------------------------------


def las_file(path: Path, count: int = 500, version: str = "1.4", point_format: int = 7) -> Any:
    laspy = pytest.importorskip("laspy")
    random = np.random.default_rng(1)
    header = laspy.LasHeader(version=version, point_format=point_format)
    header.offsets, header.scales = UTM.round(), [0.001] * 3
    header.add_extra_dim(laspy.ExtraBytesParams("reflectance", "f4"))
    header.add_extra_dim(laspy.ExtraBytesParams("pair", "2u2"))
    header.vlrs.append(laspy.VLR("LASF_Projection", 2112, "WKT", b"PROJCS[]\0"))
    header.vlrs.append(laspy.VLR("mine", 7, "kept", b"123"))
    data = laspy.LasData(header)
    data.x, data.y, data.z = (random.uniform(-500, 500, (count, 3)) + UTM).T
    data.red, data.green, data.blue = random.integers(0, 65536, (3, count))
    data.intensity = random.integers(0, 65536, count)
    data.classification = random.integers(0, 20, count)
    data.gps_time = random.uniform(0, 1e9, count)
    data.return_number = random.integers(1, 4, count)
    data.reflectance = random.normal(size=count)
    data.pair = random.integers(0, 9, (count, 2))
    data.write(str(path))
    return data


@pytest.mark.parametrize(("source", "target"), [("las", "laz"), ("laz", "las"), ("laz", "laz")])
@pytest.mark.parametrize(("version", "point_format"), [("1.2", 3), ("1.4", 7)])
def test_las_moves_with_every_attribute(
    tmp_path: Path, source: str, target: str, version: str, point_format: int, caplog: pytest.LogCaptureFixture
) -> None:
    laspy = pytest.importorskip("laspy")
    before = las_file(tmp_path / f"a.{source}", version=version, point_format=point_format)
    move_file(tmp_path / f"a.{source}", MOTION, tmp_path / f"b.{target}")
    after = laspy.read(tmp_path / f"b.{target}")
    names = [name for name in before.point_format.dimension_names if name not in ("X", "Y", "Z")]
    assert [name for name in after.point_format.dimension_names if name not in ("X", "Y", "Z")] == names
    for name in names:
        np.testing.assert_array_equal(after[name], before[name])
    expected = rigid.apply(MOTION, before.xyz)
    assert np.abs(after.xyz - expected).max() <= 0.000_051  # a twentieth of the source's step
    np.testing.assert_allclose(after.header.mins, expected.min(axis=0), atol=1e-3)
    assert "coordinate system" in caplog.text
    assert [vlr.user_id for vlr in after.header.vlrs if vlr.user_id in ("mine", "LASF_Projection")] == ["mine"]


def test_las_at_rest_stays_as_it_is(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    laspy = pytest.importorskip("laspy")
    before = las_file(tmp_path / "a.las")
    move_file(tmp_path / "a.las", np.eye(4), tmp_path / "b.las")
    after = laspy.read(tmp_path / "b.las")
    np.testing.assert_array_equal(np.asarray(after.points.array), np.asarray(before.points.array))
    assert "LASF_Projection" in [vlr.user_id for vlr in after.header.vlrs]
    assert not caplog.records


def test_las_becomes_ply_with_its_attributes(tmp_path: Path) -> None:
    before = las_file(tmp_path / "a.las")
    move_file(tmp_path / "a.las", MOTION, tmp_path / "b.ply")
    after = read_point_cloud(tmp_path / "b.ply")
    for name in ("intensity", "classification", "gps_time", "reflectance"):
        np.testing.assert_array_equal(after.attributes[name], before[name])
    np.testing.assert_array_equal(after.attributes["pair_1"], np.asarray(before["pair"])[:, 1])
    np.testing.assert_allclose(after.points, rigid.apply(MOTION, before.xyz), rtol=0, atol=1e-8)


@pytest.mark.parametrize("offset", [0.0, UTM])
def test_cloud_as_las_loses_no_precision(tmp_path: Path, offset: Any) -> None:
    pytest.importorskip("laspy")
    cloud = make_cloud(offset=offset, intensity=np.arange(60) * 1000, classification=np.full(60, 400))
    write_point_cloud(tmp_path / "a.laz", cloud)
    back = read_point_cloud(tmp_path / "a.laz")
    np.testing.assert_allclose(back.points, cloud.points, rtol=0, atol=1e-8)
    np.testing.assert_array_equal(back.attributes["intensity"], cloud.attributes["intensity"])
    np.testing.assert_array_equal(back.attributes["classification"], cloud.attributes["classification"])


def test_large_las_is_thinned_while_it_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    from idam.io import las

    before = las_file(tmp_path / "a.laz")
    monkeypatch.setattr(las, "MOST_POINTS", 200)
    monkeypatch.setattr(las, "_CHUNK", 64)
    cloud = read_point_cloud(tmp_path / "a.laz")
    np.testing.assert_array_equal(cloud.points, np.asarray(before.xyz)[::3])
    assert "every 3. of its 500 points" in caplog.text
    move_file(tmp_path / "a.laz", MOTION, tmp_path / "b.ply.gz")
    move_file(tmp_path / "a.laz", MOTION, tmp_path / "b.laz")
    monkeypatch.undo()
    assert len(read_point_cloud(tmp_path / "b.laz").points) == 500


def test_copc_is_read_to_the_level_that_the_work_needs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    from idam.io import las
    from octrees import write_copc

    points = np.random.default_rng(1).uniform(-50, 50, (8000, 3)).round(3)
    for pages in (False, True):
        level = write_copc(tmp_path / "a.copc.laz", points, levels=4, pages=pages)
        assert len(read_point_cloud(tmp_path / "a.copc.laz").points) == 8000
        for most, levels in ((3000, 3), (1000, 2), (10, 1)):
            monkeypatch.setattr(las, "COPC_POINTS", most)
            cloud = read_point_cloud(tmp_path / "a.copc.laz")
            numbers = np.sort(cloud.attributes["intensity"].astype(int))
            np.testing.assert_array_equal(numbers, np.flatnonzero(level < levels))
            order = cloud.attributes["intensity"].astype(int)
            np.testing.assert_allclose(cloud.points, points[order], atol=1e-3)
            assert f"of its 8,000 points, {levels} levels of its octree" in caplog.text
        monkeypatch.undo()


def test_a_damaged_octree_of_copc_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from idam.io import las
    from octrees import ENTRY, write_copc

    write_copc(tmp_path / "a.copc.laz", np.random.default_rng(1).uniform(-50, 50, (2000, 3)), levels=3, pages=True)
    monkeypatch.setattr(las, "COPC_POINTS", 500)
    whole = (tmp_path / "a.copc.laz").read_bytes()
    (at, size) = struct.unpack_from("<2Q", whole, 375 + 54 + 40)
    first = np.frombuffer(whole, ENTRY, size // 32, at)
    link = at + 32 * int(np.flatnonzero(first["count"] == -1)[0])
    changes = {
        "count": (at + 28, "<i", 2**31 - 1),
        "offset": (at + 16, "<Q", 2**63),
        "size": (at + 24, "<i", 2**31 - 1),
        "level": (at, "<i", 10**9),
        "a page that is itself": (link + 16, "<Q", at),
        "a page past the end": (link + 16, "<Q", 2**62),
        "a long page": (link + 24, "<i", 2**31 - 1),
        "the first page": (375 + 54 + 40, "<Q", 2**62),
    }
    for place, form, value in changes.values():
        content = bytearray(whole)
        struct.pack_into(form, content, place, value)
        with pytest.raises(InputError):
            read(tmp_path, "b.copc.laz", bytes(content))


# --- E57 -----------------------------------------------------------------------------------------------------------


def e57_file(path: Path, *scans: dict[str, Any]) -> None:
    """Scans as pye57 writes them, given as its fields, with poses under rotation (w x y z) and translation."""
    pye57 = pytest.importorskip("pye57")
    with pye57.E57(str(path), mode="w") as file:
        for scan in scans:
            data = {name: values for name, values in scan.items() if name not in ("rotation", "translation")}
            file.write_scan_raw(data, rotation=scan.get("rotation"), translation=scan.get("translation"))


def e57_scan(count: int = 40, seed: int = 0, **more: Any) -> dict[str, Any]:
    points = np.random.default_rng(seed).normal(size=(count, 3)).astype(np.float32).astype(np.float64)
    return {**dict(zip(("cartesianX", "cartesianY", "cartesianZ"), points.T.copy(), strict=True)), **more}


def test_e57_scans_and_poses(tmp_path: Path) -> None:
    half = np.sqrt(0.5)
    first = e57_scan(intensity=np.linspace(0, 1, 40).astype(np.float32))
    second = e57_scan(seed=1, rotation=np.array([half, 0, 0, half]), translation=np.array([10.0, 20, 30]))
    e57_file(tmp_path / "site.e57", first, second)
    scans = read_scans(tmp_path / "site.e57")
    assert [scan.name for scan in scans] == ["site.e57#1", "site.e57#2"]
    local = np.stack([second[f"cartesian{axis}"] for axis in "XYZ"], axis=1)
    np.testing.assert_allclose(scans[1].cloud.points, local)
    np.testing.assert_allclose(scans[1].pose, [[0, -1, 0, 10], [1, 0, 0, 20], [0, 0, 1, 30], [0, 0, 0, 1]], atol=1e-12)
    np.testing.assert_allclose(scans[0].cloud.attributes["intensity"], first["intensity"])
    placed = np.stack([10 - local[:, 1], 20 + local[:, 0], 30 + local[:, 2]], axis=1)
    np.testing.assert_allclose(read_point_cloud(f"{tmp_path}/site.e57#2").points, placed, atol=1e-12)
    assert len(read_point_cloud(tmp_path / "site.e57").points) == 80
    for number in (0, 3):
        with pytest.raises(InputError, match=f"no scan {number}: it holds 2"):
            read_point_cloud(f"{tmp_path}/site.e57#{number}")


def test_e57_invalid_points_and_colours(tmp_path: Path) -> None:
    state = np.zeros(40, np.int8)
    state[::4] = 1
    colors = np.random.default_rng(3).integers(0, 256, (3, 40), dtype=np.uint8)
    fields = dict(zip(("colorRed", "colorGreen", "colorBlue"), colors, strict=True))
    e57_file(tmp_path / "a.e57", e57_scan(cartesianInvalidState=state, **fields))
    cloud = read_point_cloud(tmp_path / "a.e57")
    assert len(cloud.points) == 30
    np.testing.assert_array_equal(cloud.colors, colors.T[state == 0])
    assert "cartesianInvalidState" not in cloud.attributes


def test_e57_keeps_rows_and_columns(tmp_path: Path) -> None:
    grid = {"rowIndex": np.arange(40, dtype=np.uint16), "columnIndex": np.arange(40, dtype=np.uint16)[::-1].copy()}
    e57_file(tmp_path / "a.e57", e57_scan(**grid))
    move_file(tmp_path / "a.e57", MOTION, tmp_path / "b.e57")
    for name, values in grid.items():
        np.testing.assert_array_equal(read_point_cloud(tmp_path / "b.e57").attributes[name], values)


@pytest.mark.parametrize("damage", ["cut", "changed"])
def test_a_damaged_e57_is_refused_in_a_line(tmp_path: Path, damage: str) -> None:
    e57_file(tmp_path / "a.e57", e57_scan())
    data = bytearray((tmp_path / "a.e57").read_bytes())
    data[1500] ^= 255
    with pytest.raises(InputError, match="damaged") as error:
        read(tmp_path, "b.e57", bytes(data[:3000] if damage == "cut" else data))
    assert "****" not in str(error.value) and "exception" not in str(error.value)


def test_e57_is_written_with_poses_and_far_from_the_origin(tmp_path: Path) -> None:
    pytest.importorskip("pye57")
    cloud = make_cloud(offset=UTM, intensity=np.linspace(0, 1, 60).astype(np.float32))
    write_point_cloud(tmp_path / "a.e57", cloud)
    back = read_point_cloud(tmp_path / "a.e57")
    np.testing.assert_allclose(back.points, cloud.points, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(back.colors, cloud.colors)
    np.testing.assert_array_equal(back.attributes["intensity"], cloud.attributes["intensity"])
    e57_file(
        tmp_path / "b.e57", e57_scan(), e57_scan(seed=1, translation=np.ones(3), rotation=np.array([1.0, 0, 0, 0]))
    )
    move_file(tmp_path / "b.e57", MOTION, tmp_path / "c.e57")
    for before, after in zip(read_scans(tmp_path / "b.e57"), read_scans(tmp_path / "c.e57"), strict=True):
        np.testing.assert_allclose(after.placed().points, rigid.apply(MOTION, before.placed().points), atol=1e-6)


def test_e57_of_spherical_coordinates() -> None:
    from idam.io.e57 import _points

    columns = {"sphericalRange": [2.0, 3], "sphericalAzimuth": [0.5, 0], "sphericalElevation": [0.25, np.pi / 2]}
    found = _points({name: np.array(values) for name, values in columns.items()}, 1)
    flat = 2 * np.cos(0.25)
    np.testing.assert_allclose(
        found, [[flat * np.cos(0.5), flat * np.sin(0.5), 2 * np.sin(0.25)], [0, 0, 3]], atol=1e-15
    )
    with pytest.raises(InputError, match="scan 1 has no coordinates"):
        _points({"intensity": np.zeros(2)}, 1)


def test_e57_faults(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pye57")
    e57_file(tmp_path / "a.e57", e57_scan())
    whole = (tmp_path / "a.e57").read_bytes()
    for damaged in (b"ASTM-E57" + bytes(100), whole[:2000], b"no", whole.replace(b"cartesianX", b"cartesianQ")):
        with pytest.raises(InputError):
            read(tmp_path, "b.e57", damaged)
        assert (tmp_path / "b.e57").read_bytes() == damaged  # pye57 deletes what it cannot read
    from idam.io import e57

    monkeypatch.setattr(e57, "MOST_POINTS", 30)
    with pytest.raises(InputError, match="scan 1 has 40 points: export it in parts"):
        read_point_cloud(tmp_path / "a.e57")


def test_e57_without_pye57_names_the_pip_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "pye57", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'idam\[e57\]'"):
        read(tmp_path, "a.e57", b"ASTM-E57")


# --- PTX, PTS, KITTI, gz --------------------------------------------------------------------------------------------

PTX = """2
1
0 0 0
1 0 0
0 1 0
0 0 1
0 1 0 0
-1 0 0 0
0 0 1 0
10 20 30 1
1 0 0 0.5 255 0 9
0 0 0 0.5 0 0 0
"""


def test_ptx_poses_and_points_not_seen(tmp_path: Path) -> None:
    (tmp_path / "a.ptx").write_text(PTX + PTX.replace("10 20 30 1", "0 0 0 1"))
    scans = read_scans(tmp_path / "a.ptx")
    assert [scan.name for scan in scans] == ["a.ptx#1", "a.ptx#2"]
    np.testing.assert_array_equal(scans[0].cloud.points, [[1, 0, 0]])
    np.testing.assert_array_equal(scans[0].cloud.colors, [[255, 0, 9]])
    np.testing.assert_array_equal(scans[0].cloud.attributes["intensity"], [0.5])
    np.testing.assert_array_equal(scans[0].pose, [[0, -1, 0, 10], [1, 0, 0, 20], [0, 0, 1, 30], [0, 0, 0, 1]])
    np.testing.assert_array_equal(read_point_cloud(tmp_path / "a.ptx").points, [[10, 21, 30], [0, 1, 0]])


@pytest.mark.parametrize(
    "content",
    [
        "",
        "1\n",
        "a\nb\n",
        PTX[:-20],
        PTX.replace("1 0 0 0.5 255 0 9", "0 0 0 0 0 0 0"),
        PTX + "2\n",
        PTX.replace("-1 0 0 0", "-2 0 0 0"),
        PTX.replace("-1 0 0 0", "1 0 0 0"),
        PTX.replace("10 20", "1e400 20"),
    ],
)
def test_ptx_faults(tmp_path: Path, content: str) -> None:
    with pytest.raises(InputError):
        read(tmp_path, "a.ptx", content)


def test_kitti_and_nuscenes(tmp_path: Path) -> None:
    rows = np.random.default_rng(0).normal(size=(20, 5)).astype("<f4") ** 2
    cloud = read(tmp_path, "a.bin", np.ascontiguousarray(rows[:, :4]).tobytes())
    np.testing.assert_array_equal(cloud.points, rows[:, :3])
    np.testing.assert_array_equal(cloud.attributes["intensity"], rows[:, 3])
    np.testing.assert_array_equal(read(tmp_path, "a.pcd.bin", rows.tobytes()).attributes["ring"], rows[:, 4])
    write_point_cloud(tmp_path / "b.bin", cloud)
    assert (tmp_path / "b.bin").read_bytes() == (tmp_path / "a.bin").read_bytes()
    for content in (rows[:, :3].tobytes()[:-4], (-rows[:, :4]).tobytes(), bytes(range(256)) * 4):
        with pytest.raises(InputError, match="not rows of 4 float32 numbers"):
            read(tmp_path, "c.bin", content)
    with pytest.raises(InputError, match="too far from the origin"):
        write_point_cloud(tmp_path / "d.bin", make_cloud(offset=UTM))


def test_gz_of_any_format(tmp_path: Path) -> None:
    for suffix in ("ply", "xyz", "npy", "pcd"):
        write_point_cloud(tmp_path / f"a.{suffix}.gz", make_cloud())
        packed = (tmp_path / f"a.{suffix}.gz").read_bytes()
        write_point_cloud(tmp_path / f"b.{suffix}", make_cloud())
        assert gzip.decompress(packed) == (tmp_path / f"b.{suffix}").read_bytes()
        np.testing.assert_allclose(read_point_cloud(tmp_path / f"a.{suffix}.gz").points, make_cloud().points, atol=1e-6)
    for content in (packed[:-20], b"no", gzip.compress(b"")):
        with pytest.raises(InputError):
            read(tmp_path, "c.xyz.gz", content)
    with pytest.raises(InputError, match="packed bytes promise"):
        read(tmp_path, "bomb.xyz.gz", gzip.compress(bytes(2**28 + 2**26), 9))


def test_glb_nodes_are_where_the_scene_places_them(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.Trimesh(CORNERS, FACES, process=False), transform=rigid.transform(np.eye(3), [5, 0, 0]))
    stream = io.BytesIO(scene.export(file_type="glb"))
    cloud = read(tmp_path, "a.glb", stream.getvalue())
    assert len(cloud.points) == 20_000
    assert 4.999 < cloud.points[:, 0].min() < 5.01 and cloud.points[:, 0].max() <= 7.0001
