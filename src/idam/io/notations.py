"""Rigid transforms as people paste them: matrices, poses of TUM and KITTI, quaternions, Euler angles, ROS."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from idam import rigid
from idam.errors import InputError
from idam.io.quaternion import quaternion, rotation

__all__ = ["FORMS", "parse_json", "parse_text"]

_NUMBER = r"[+-]?(?:(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?|(?:nan|inf)\b)"
_TOKEN = re.compile(rf"(?<![\w.]){_NUMBER}(?![\w.])|[^\W\d_][\w-]*")
_NOISE = re.compile(r"#.*|\[\d\d:\d\d:\d\d\]|\bin\b")  # comments, the clock of CloudCompare's console, tf2_echo's "in"
_ROS = re.compile(r"static_transform_publisher|--(?:frame-id|child-frame-id|yaw|roll|pitch|q?[xyzw])\b")
_ORDER = re.compile(r"[xyz]{3}")
_HOW = (
    "write 4 lines of 4 numbers, or say what they are, such as 'translation 1 2 3 quaternion xyzw 0 0 0 1' or "
    "'translation 1 2 3 euler xyz extrinsic degrees 10 20 30'"
)


def parse_text(text: str) -> rigid.Array:
    """Read one transform (4, 4) of a text.

    It may be 16 numbers, row by row; a line of KITTI's 12 or of TUM's 8 (time, translation, quaternion x y z w);
    ``static_transform_publisher``'s arguments, as ROS 1 or 2 has them, or what ``tf2_echo`` prints; or a translation
    with a quaternion whose order is named (``xyzw`` or ``wxyz``), or with Euler angles whose order, frame
    (``intrinsic`` or ``extrinsic``) and unit (``degrees`` or ``radians``) are named.

    Raises:
        InputError: it is none of them, or can be read in two ways.
    """
    text = _NOISE.sub(" ", text)
    if _ROS.search(text):
        return _ros(text.split())
    words = _TOKEN.findall(text)
    numbers = [float(word) for word in words if _is_number(word)]
    if len(numbers) == len(words) and not re.search(r"[^\W\d_]{2,}", re.sub(_NUMBER, "", text)):
        return _of_numbers(numbers)
    return _of_groups(_groups(words))


def parse_json(content: Any) -> rigid.Array:
    """Read one transform (4, 4) of parsed JSON: a matrix, or an object that holds one, or a translation and a rotation.

    Raises:
        InputError: it holds none.
    """
    if isinstance(content, dict):
        for key in ("transformation", "transform", "matrix", "T"):
            if key in content:
                return parse_json(content[key])
        if "translation" not in content or "rotation" not in content:
            raise InputError('no key "transformation"')
        turn, shift = content["rotation"], content["translation"]
        if not isinstance(turn, dict):
            raise InputError('"rotation" must name x, y, z and w')
        names = shift if isinstance(shift, dict) else dict(zip("xyz", shift, strict=True))
        return rigid.transform(
            rotation(np.array([float(turn[axis]) for axis in "wxyz"])), [float(names[axis]) for axis in "xyz"]
        )
    matrix = np.asarray(content, np.float64)
    return matrix.reshape(4, 4) if matrix.shape == (16,) else matrix


def _of_numbers(numbers: Sequence[float]) -> rigid.Array:
    match len(numbers):
        case 16:
            return np.array(numbers).reshape(4, 4)
        case 12:
            return np.vstack([np.reshape(numbers, (3, 4)), [0, 0, 0, 1]])
        case 8:
            x, y, z, w = numbers[4:]
            return rigid.transform(_unit(np.array([w, x, y, z])), numbers[1:4])
        case 6 | 7:
            raise InputError(f"{len(numbers)} numbers can be read in several ways: {_HOW}")
    raise InputError(f"{len(numbers)} numbers: {_HOW}")


def _groups(words: Sequence[str]) -> list[tuple[set[str], list[float]]]:
    """Runs of numbers, each with the words before it."""
    groups: list[tuple[set[str], list[float]]] = []
    for word in words:
        if _is_number(word):
            if not groups:
                other = next(word for word in words if not _is_number(word))
                raise InputError(f"numbers before the word '{other[:40]}': {_HOW}")
            groups[-1][1].append(float(word))
        elif groups and not groups[-1][1]:
            groups[-1][0].add(word.casefold())
        else:
            groups.append(({word.casefold()}, []))
    return [(names, numbers) for names, numbers in groups if numbers]


def _of_groups(groups: list[tuple[set[str], list[float]]]) -> rigid.Array:
    single = {name: numbers[0] for names, numbers in groups if len(numbers) == 1 for name in names}
    shift = [single[name] for name in ("tx", "ty", "tz") if name in single]
    turn = _turn_of_names(single)
    for names, numbers in groups:
        if len(numbers) == 16:
            return _of_numbers(numbers)
        if len(numbers) == 3 and names & {"translation", "t", "position", "trans"}:
            shift = numbers
        elif len(numbers) == 4 and names & {"quaternion", "quat", "q"}:
            turn = _quaternion(names, numbers)
        elif turn is None and len(numbers) == 3 and names & {"euler", "rpy", "ypr"}:
            turn = _euler(names, numbers)
    if turn is None or len(shift) != 3:
        raise InputError(f"no translation and rotation found: {_HOW}")
    return rigid.transform(turn, shift)


def _turn_of_names(single: Mapping[str, float]) -> rigid.Array | None:
    names = ("qw", "qx", "qy", "qz")
    return _unit(np.array([single[name] for name in names])) if all(map(single.__contains__, names)) else None


def _quaternion(names: set[str], numbers: Sequence[float]) -> rigid.Array:
    if "wxyz" in names:
        return _unit(np.array(numbers))
    if "xyzw" in names or {"rotation", "quaternion"} <= names:  # tf2_echo
        return _unit(np.array([numbers[3], *numbers[:3]]))
    raise InputError("a quaternion without its order: write 'quaternion xyzw' or 'quaternion wxyz' before it")


def _euler(names: set[str], numbers: Sequence[float]) -> rigid.Array:
    in_degrees, in_radians = names & {"degrees", "degree", "deg"}, names & {"radians", "radian", "rad"}
    if bool(in_degrees) == bool(in_radians):
        raise InputError("Euler angles without a unit: write degrees or radians before them")
    angles = np.radians(numbers) if in_degrees else np.array(numbers)
    if "rpy" in names:
        return _turned("xyz", angles)
    if "ypr" in names:
        return _turned("xyz", angles[::-1])
    order = next((name for name in names if _ORDER.fullmatch(name)), None)
    if order is None or len({"intrinsic", "extrinsic"} & names) != 1:
        raise InputError(
            "Euler angles without their convention: write such as 'euler xyz extrinsic degrees' before them"
        )
    return _turned(order, angles) if "extrinsic" in names else _turned(order[::-1], angles[::-1])


def _turned(order: str, angles: Sequence[float] | rigid.Array) -> rigid.Array:
    """The rotation about axes that stay where they are, one after the other."""
    matrix = np.eye(3)
    for axis, angle in zip(order, angles, strict=True):
        matrix = rigid.rotation_exp(angle * np.eye(3)["xyz".index(axis)]) @ matrix
    return matrix


def _ros(words: Sequence[str]) -> rigid.Array:
    """A transform that takes the child's coordinates to the frame's."""
    named = {
        name.removeprefix("--"): float(value)
        for name, value in pairwise(words)
        if name.startswith("--") and _is_number(value)
    }
    if named:
        shift = [named.get(axis, 0.0) for axis in "xyz"]
        if any(name.startswith("q") for name in named):
            turn = _unit(np.array([named.get("qw", 1.0), *(named.get(f"q{axis}", 0.0) for axis in "xyz")]))
        else:
            turn = _turned("xyz", [named.get(angle, 0.0) for angle in ("roll", "pitch", "yaw")])
        return rigid.transform(turn, shift)
    place = next((at for at, word in enumerate(words) if _is_number(word)), len(words))
    numbers = [float(word) for word in words[place : place + 7] if _is_number(word)]
    if len(numbers) == 7:
        return rigid.transform(_unit(np.array([numbers[6], *numbers[3:6]])), numbers[:3])
    if len(numbers) == 6:
        return rigid.transform(_turned("xyz", numbers[:2:-1]), numbers[:3])
    raise InputError("static_transform_publisher needs x y z and yaw pitch roll, or x y z and qx qy qz qw")


def _unit(wxyz: rigid.Array) -> rigid.Array:
    if not abs(np.linalg.norm(wxyz) - 1) < 1e-2:
        raise InputError(f"a quaternion of length {np.linalg.norm(wxyz):.4g}, not 1: {_HOW}")
    return rotation(wxyz)


def _is_number(word: str) -> bool:
    return re.fullmatch(_NUMBER, word) is not None


# Writing


def _numbers(values: Any) -> str:
    return " ".join(repr(value) for value in (np.ravel(values) + 0.0).tolist())  # no -0.0


def _xyzw(matrix: rigid.Array) -> rigid.Array:
    return np.roll(quaternion(matrix[:3, :3]), -1)


def _angles(matrix: rigid.Array) -> rigid.Array:
    """Roll, pitch and yaw: angles (3,) about x, y and z, which stay where they are."""
    turn = matrix[:3, :3]
    pitch = np.arctan2(-turn[2, 0], np.hypot(turn[0, 0], turn[1, 0]))
    if np.hypot(turn[0, 0], turn[1, 0]) < 1e-9:  # only roll and yaw together are fixed
        return np.array([0.0, pitch, np.arctan2(-turn[0, 1], turn[1, 1])])
    return np.array([np.arctan2(turn[2, 1], turn[2, 2]), pitch, np.arctan2(turn[1, 0], turn[0, 0])])


FORMS: dict[str, Callable[[rigid.Array], str]] = {
    "matrix": lambda matrix: "\n".join(map(_numbers, matrix)),
    "kitti": lambda matrix: _numbers(matrix[:3]),
    "tum": lambda matrix: f"0.0 {_numbers(matrix[:3, 3])} {_numbers(_xyzw(matrix))}",
    "quaternion": lambda matrix: f"translation {_numbers(matrix[:3, 3])} quaternion xyzw {_numbers(_xyzw(matrix))}",
    "euler": lambda matrix: (
        f"translation {_numbers(matrix[:3, 3])} euler xyz extrinsic degrees {_numbers(np.degrees(_angles(matrix)))}"
    ),
    "ros": lambda matrix: (
        "ros2 run tf2_ros static_transform_publisher "
        + " ".join(f"--{name} {value!r}" for name, value in zip("xyz", matrix[:3, 3].tolist(), strict=True))
        + "".join(f" --q{name} {value!r}" for name, value in zip("xyzw", _xyzw(matrix).tolist(), strict=True))
        + " --frame-id target --child-frame-id source"
    ),
    "json": lambda matrix: json.dumps({"transformation": (matrix + 0.0).tolist()}),
}
"""How a transform (4, 4) is written in each notation; :func:`parse_text` reads all but JSON, which is for files."""
