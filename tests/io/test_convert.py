"""Clouds as other libraries hold them, by the objects themselves where they are installed, else by look-alikes."""

from __future__ import annotations

import struct
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from idam.errors import InputError
from idam.io import as_point_cloud

POINTS = np.random.default_rng(0).normal(size=(50, 3))
CORNERS = np.array([[0, 0, 0], [2, 0, 0], [0, 1, 0], [0, 0, 3.0]])
FACES = np.array([[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]])


def test_masked_rows_are_left_out() -> None:
    masked = np.ma.masked_array(POINTS, mask=np.zeros_like(POINTS, bool))
    np.testing.assert_array_equal(as_point_cloud(masked).points, POINTS)
    masked[3, 1] = masked[7] = np.ma.masked
    np.testing.assert_array_equal(as_point_cloud(masked).points, np.delete(POINTS, [3, 7], axis=0))
    np.testing.assert_array_equal(as_point_cloud(np.ma.masked_greater(POINTS, 1)).points, POINTS[(POINTS <= 1).all(1)])
    whole = np.ma.masked_array(np.hstack([POINTS, POINTS[:, :1]]), mask=np.zeros((50, 4), bool))
    whole[2, 3] = np.ma.masked  # no coordinate
    assert len(as_point_cloud(whole).points) == 50


def test_nan_stays_or_is_left_out() -> None:
    points = POINTS.copy()
    points[4, 2] = np.nan
    assert len(as_point_cloud(points).points) == 50
    np.testing.assert_array_equal(as_point_cloud(points, nan="drop").points, np.delete(POINTS, 4, axis=0))
    with pytest.raises(InputError, match="every one of its 2 points"):
        as_point_cloud(np.full((2, 3), np.nan), nan="drop")


@pytest.mark.parametrize("columns", [4, 5, 6, 7, 9, 16])
def test_further_columns_are_kept(columns: int) -> None:
    table = np.random.default_rng(1).normal(size=(50, columns))
    cloud = as_point_cloud(table)
    np.testing.assert_array_equal(cloud.points, table[:, :3])
    np.testing.assert_array_equal(cloud.attributes["column_4"], table[:, 3])


@pytest.mark.parametrize("shape", [(3, 50), (4, 50), (3, 4), (6, 50)])
def test_arrays_that_lie_on_their_side_are_refused(shape: tuple[int, int]) -> None:
    with pytest.raises(InputError, match=r"expected \(N, 3\), got shape"):
        as_point_cloud(np.zeros(shape))


def test_three_rows_hint_at_a_transpose() -> None:
    with pytest.raises(InputError, match="transpose it"):
        as_point_cloud(POINTS.T)


def test_structured_arrays() -> None:
    array = np.zeros(50, [("intensity", "u2"), ("z", "f4"), ("y", "f8"), ("x", "f8"), ("name", "U3")])
    array["x"], array["y"], array["intensity"] = POINTS[:, 0], POINTS[:, 1], np.arange(50)
    cloud = as_point_cloud(array)
    np.testing.assert_array_equal(cloud.points[:, :2], POINTS[:, :2])
    np.testing.assert_array_equal(cloud.attributes["intensity"], np.arange(50))
    masked = np.ma.masked_array(array, mask=False)
    masked["y"][5] = np.ma.masked
    assert len(as_point_cloud(masked).points) == 49
    with pytest.raises(InputError, match="no columns x, y and z"):
        as_point_cloud(array[["x", "y"]])


def frame(**columns: np.ndarray) -> Any:
    """What pandas and polars frames have in common."""
    series = {name: SimpleNamespace(to_numpy=lambda values=values: values) for name, values in columns.items()}
    kind = type("DataFrame", (dict,), {"__module__": "pandas.core.frame", "columns": property(lambda self: list(self))})
    return kind(series)


def test_data_frames() -> None:
    x, y, z = POINTS.T
    cloud = as_point_cloud(frame(name=np.full(50, "a", object), Z=z, Y=y, X=x, t=np.arange(50)))
    np.testing.assert_array_equal(cloud.points, POINTS)
    np.testing.assert_array_equal(cloud.attributes["t"], np.arange(50))
    np.testing.assert_array_equal(as_point_cloud(frame(**{"0": x, "1": y, "2": z})).points, POINTS)
    missing = as_point_cloud(frame(x=x.astype(object), y=y, z=np.array([None, *z[1:]], object)))
    assert np.isnan(missing.points[0, 2]) and len(missing.points) == 50
    with pytest.raises(InputError, match="no columns x, y and z"):
        as_point_cloud(frame(a=x, b=y, c=z))


@pytest.mark.parametrize("library", ["pandas", "polars"])
def test_data_frames_themselves(library: str) -> None:
    module = pytest.importorskip(library)
    table = module.DataFrame({"label": ["a"] * 50, **dict(zip("xyz", POINTS.T, strict=True))})
    np.testing.assert_array_equal(as_point_cloud(table).points, POINTS)
    np.testing.assert_array_equal(as_point_cloud(module.DataFrame(POINTS)).points, POINTS)


def test_open3d_itself() -> None:
    o3d = pytest.importorskip("open3d")
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(POINTS))
    for data in (cloud, cloud.points, o3d.t.geometry.PointCloud(POINTS), o3d.core.Tensor(POINTS)):
        np.testing.assert_array_equal(as_point_cloud(data).points, POINTS)
    mesh = o3d.geometry.TriangleMesh(o3d.utility.Vector3dVector(CORNERS), o3d.utility.Vector3iVector(FACES))
    for data in (mesh, o3d.t.geometry.TriangleMesh.from_legacy(mesh)):
        assert as_point_cloud(data).points.shape == (20_000, 3)


def test_pyvista() -> None:
    def poly(**attributes: Any) -> Any:
        return type("PolyData", (SimpleNamespace,), {"__module__": "pyvista.core.pointset"})(**attributes)

    np.testing.assert_array_equal(as_point_cloud(poly(points=POINTS, faces=np.empty(0, int))).points, POINTS)
    faces = np.hstack([np.full((4, 1), 3), FACES]).ravel()
    assert len(as_point_cloud(poly(points=CORNERS, faces=faces)).points) == 20_000


def test_pyvista_itself() -> None:
    pyvista = pytest.importorskip("pyvista")
    np.testing.assert_allclose(as_point_cloud(pyvista.PolyData(POINTS)).points, POINTS)
    assert len(as_point_cloud(pyvista.Sphere()).points) == 20_000


def test_laspy_itself() -> None:
    laspy = pytest.importorskip("laspy")
    data = laspy.LasData(laspy.LasHeader(version="1.4", point_format=6))
    data.x, data.y, data.z = POINTS.T
    np.testing.assert_allclose(as_point_cloud(data).points, POINTS, atol=0.006)


def ros_message(big_endian: bool = False, height: int = 1, padding: int = 0) -> Any:
    """A sensor_msgs/PointCloud2 with x, y, z, rgb, one reserved field, and padding behind each row."""
    order = ">" if big_endian else "<"
    rgb = struct.unpack("<f", struct.pack("<I", 0x00FF0009))[0]
    rows = [struct.pack(f"{order}3f4xf", *point, rgb) for point in POINTS]
    width = len(rows) // height
    data = b"".join(b"".join(rows[row * width : (row + 1) * width]) + bytes(padding) for row in range(height))
    fields = [SimpleNamespace(name=n, offset=o, datatype=7, count=1) for n, o in zip("xyz", (0, 4, 8), strict=True)]
    fields += [SimpleNamespace(name="rgb", offset=16, datatype=7, count=1)]
    fields += [SimpleNamespace(name="code", offset=0, datatype=6, count=3)]
    return SimpleNamespace(
        header=None, height=height, width=width, fields=fields, is_bigendian=big_endian, point_step=20,
        row_step=20 * width + padding, data=data, is_dense=True,
    )  # fmt: skip


@pytest.mark.parametrize("big_endian", [False, True])
@pytest.mark.parametrize(("height", "padding"), [(1, 0), (5, 0), (5, 12)])
def test_ros_messages(big_endian: bool, height: int, padding: int) -> None:
    message = ros_message(big_endian, height, padding)
    for data in (message.data, list(message.data), np.frombuffer(message.data, np.uint8)):
        message.data = data
        cloud = as_point_cloud(message)
        np.testing.assert_array_equal(cloud.points, POINTS.astype(np.float32))
        np.testing.assert_array_equal(cloud.colors, np.tile([255, 0, 9], (50, 1)))


def test_ros_messages_that_are_wrong_or_hold_nan() -> None:
    message = ros_message()
    message.data = message.data[:-1]
    with pytest.raises(InputError, match="its data are shorter"):
        as_point_cloud(message)
    message = ros_message()
    message.data = struct.pack("<f", np.nan) + message.data[4:]
    assert len(as_point_cloud(message).points) == 49
    message.fields = message.fields[1:]
    with pytest.raises(InputError, match="no columns x, y and z"):
        as_point_cloud(message)
