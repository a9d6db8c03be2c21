"""Transforms in the notations that people paste, read and written."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from idam import rigid
from idam.errors import InputError
from idam.io import format_transform, read_transform, write_transform
from idam.io.notations import FORMS, parse_text
from idam.io.quaternion import quaternion, rotation

RANDOM = np.random.default_rng(0)
TWISTS = [
    *RANDOM.normal(size=(20, 6)) * 1.5,
    np.zeros(6),
    np.array([np.pi, 0, 0, 1, 2, 3]),
    np.array([0, 1e-9, 0, 0, 0, 0]),
]


@pytest.mark.parametrize("form", FORMS)
def test_every_notation_reads_back(form: str, tmp_path: Path) -> None:
    for twist in TWISTS:
        T = rigid.exp(twist)
        (tmp_path / "T").write_text(format_transform(T, form))
        np.testing.assert_allclose(read_transform(tmp_path / "T"), T, rtol=0, atol=1e-12)


@pytest.mark.parametrize("suffix", ["tum", "kitti", "txt", "json", "npy"])
def test_the_extension_is_the_form(tmp_path: Path, suffix: str) -> None:
    T = rigid.exp(TWISTS[0])
    write_transform(tmp_path / f"T.{suffix}", T)
    np.testing.assert_allclose(read_transform(tmp_path / f"T.{suffix}"), T, rtol=0, atol=1e-12)
    if suffix in ("tum", "kitti"):
        assert len((tmp_path / f"T.{suffix}").read_text().split()) == {"tum": 8, "kitti": 12}[suffix]


def test_digits_of_far_coordinates_are_all_there() -> None:
    T = rigid.transform(rigid.rotation_exp(np.array([0.1, 0.2, 0.3])), [412_345.678_901, 5_412_345.123_456, 1e-7])
    np.testing.assert_array_equal(parse_text(format_transform(T)), T)


YAWED = np.array([[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1.0]])  # 90 degrees about z
HALF = repr(float(np.sqrt(0.5)))
QUARTER = repr(float(np.pi) / 2)
GEOMETRY = '{"translation": {"x": 1, "y": 2, "z": 3}, "rotation": {"x": 0, "y": 0, "z": HALF, "w": HALF}}'
PASTED = {
    "matrix": "0 -1 0 1\n1 0 0 2\n0 0 1 3\n0 0 0 1",
    "NumPy": "[[0. -1. 0. 1.]\n [1. 0. 0. 2.]\n [0. 0. 1. 3.]\n [0. 0. 0. 1.]]",
    "Python": "np.array([[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])",
    "CloudCompare's console": "[14:02:11] 0 -1 0.0 1\n[14:02:11] 1 0 0 2\n[14:02:11] 0 0 1 3\n[14:02:11] 0 0 0 1",
    "KITTI": "0 -1 0 1 1 0 0 2 0 0 1 3",
    "TUM": f"1700000000.25 1 2 3 0 0 {HALF} {HALF}",
    "TUM with a comment": f"# timestamp tx ty tz qx qy qz qw\n0 1 2 3 0 0 {HALF} {HALF}",
    "ROS 1": f"rosrun tf2_ros static_transform_publisher 1 2 3 {QUARTER} 0 0 map scan",
    "ROS 1 with a period": f"rosrun tf static_transform_publisher 1 2 3 0 0 {HALF} {HALF} map scan 100",
    "ROS 2": f"ros2 run tf2_ros static_transform_publisher --x 1 --y 2 --z 3 --yaw {QUARTER} --frame-id map",
    "ROS 2 arguments alone": f"--x 1 --y 2 --z 3 --qz {HALF} --qw {HALF} --frame-id map --child-frame-id scan",
    "tf2_echo": f"At time 0.0\n- Translation: [1.000, 2.000, 3.000]\n- Rotation: in Quaternion [0, 0, {HALF}, {HALF}]\n"
    f"            in RPY (radian) [0.0, 0.0, {QUARTER}]\n            in RPY (degree) [0.0, -0.0, 90.0]",
    "quaternion xyzw": f"translation: 1 2 3\nquaternion xyzw: 0 0 {HALF} {HALF}",
    "quaternion wxyz": f"quaternion (wxyz) = [{HALF}, 0, 0, {HALF}], translation = [1, 2, 3]",
    "named numbers": f"tx=1 ty=2 tz=3 qx=0 qy=0 qz={HALF} qw={HALF}",
    "Euler": "translation 1 2 3 euler xyz extrinsic degrees 0 0 90",
    "Euler intrinsic": f"euler ZYX intrinsic radians {QUARTER} 0 0\ntranslation 1 2 3",
    "roll, pitch, yaw": "t: 1 2 3  rpy (deg): 0 0 90",
    "ypr": "t: 1 2 3  ypr deg: 90 0 0",
    "geometry_msgs": GEOMETRY.replace("HALF", HALF),
    "flat JSON": '{"matrix": [0, -1, 0, 1, 1, 0, 0, 2, 0, 0, 1, 3, 0, 0, 0, 1]}',
}  # fmt: skip


@pytest.mark.parametrize("kind", PASTED)
def test_what_people_paste(kind: str, tmp_path: Path) -> None:
    (tmp_path / "T.txt").write_text(PASTED[kind])
    np.testing.assert_allclose(read_transform(tmp_path / "T.txt"), YAWED, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    "text",
    [
        "1 2 3 0 0 0 1",
        "1 2 3 0 0 0",
        "quaternion 0 0 0 1 translation 1 2 3",
        "translation 1 2 3",
        "translation 1 2 3 euler xyz degrees 0 0 90",
        "translation 1 2 3 euler extrinsic degrees 0 0 90",
        "translation 1 2 3 euler xyz extrinsic 0 0 90",
        "0 1 2 3 4 5 6 7",
        "0 1 2 3 0 0 0 1\n1 1 2 3 0 0 0 1",
        "static_transform_publisher 1 2 3",
        "nothing",
        "",
        "1 0 0 5\n0 1 0 6\n0 0 1 7\n0 0 0 one",
    ],
)
def test_what_can_be_read_in_two_ways_is_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "T.txt").write_text(text)
    with pytest.raises(InputError) as error:
        read_transform(tmp_path / "T.txt")
    assert "\n" not in str(error.value) and str(error.value).startswith(f"{tmp_path / 'T.txt'}: ")


def test_euler_angles_multiply_in_their_order() -> None:
    axes = {axis: rigid.rotation_exp(np.radians(angle) * np.eye(3)[place]) for place, (axis, angle) in
            enumerate(zip("xyz", (10.0, 20.0, 30.0), strict=True))}  # fmt: skip
    extrinsic = parse_text("t 0 0 0 euler xyz extrinsic degrees 10 20 30")[:3, :3]
    np.testing.assert_allclose(extrinsic, axes["z"] @ axes["y"] @ axes["x"], atol=1e-15)
    intrinsic = parse_text("t 0 0 0 euler zxy intrinsic degrees 30 10 20")[:3, :3]
    np.testing.assert_allclose(intrinsic, axes["z"] @ axes["x"] @ axes["y"], atol=1e-15)


def test_quaternions_are_rotations() -> None:
    for twist in TWISTS:
        turn = rigid.rotation_exp(twist[:3])
        np.testing.assert_allclose(rotation(quaternion(turn)), turn, atol=1e-14)
        np.testing.assert_allclose(rotation(-2 * quaternion(turn)), turn, atol=1e-14)
    with pytest.raises(ValueError, match="length 0"):
        rotation(np.zeros(4))


def test_angles_at_the_poles_of_pitch_read_back() -> None:
    for pitch in (-90, 90):
        T = parse_text(f"t 1 2 3 euler xyz extrinsic degrees 25 {pitch} -40")
        np.testing.assert_allclose(parse_text(format_transform(T, "euler")), T, atol=1e-9)
