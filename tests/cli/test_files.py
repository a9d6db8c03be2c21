"""Files on the command line: apply, info, standard input and output, and what must not be overwritten."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from idam import cli, rigid
from idam.io import PointCloud, format_transform, read_point_cloud, read_transform, write_point_cloud, write_transform

MOTION = rigid.exp(np.array([0.2, -0.4, 1.1, 3.0, -2.0, 0.5]))


class Run(NamedTuple):
    code: int
    out: str
    err: str


Call = Callable[..., Run]


def shape(count: int = 400) -> np.ndarray:
    normals = np.random.default_rng(0).normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return normals * [1.0, 0.6, 0.3] + np.maximum(normals, 0) * 0.4


@pytest.fixture
def work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder, with source.ply, target.xyz and T.txt."""
    monkeypatch.chdir(tmp_path)
    colors = np.random.default_rng(1).integers(0, 256, (400, 3), dtype=np.uint8)
    write_point_cloud("source.ply", PointCloud(shape(), colors, attributes={"intensity": np.arange(400.0)}))
    write_point_cloud("target.xyz", rigid.apply(MOTION, shape()))
    write_transform("T.txt", MOTION)
    return tmp_path


@pytest.fixture
def call(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Call:
    """Runs the command line in this process."""

    def run(*args: Any) -> Run:
        monkeypatch.setattr(sys, "argv", ["idam", *map(str, args)])
        with pytest.raises(SystemExit) as stopped:
            cli.main()
        return Run(int(stopped.value.code or 0), *capfd.readouterr())

    return run


def launch(command: str, **options: Any) -> Run:
    """Runs a shell command, with ``idam`` for this Python's command line."""
    command = command.replace("idam ", f"{sys.executable} -m idam ")
    done = subprocess.run(
        ["bash", "-o", "pipefail", "-c", command], capture_output=True, timeout=120, check=False, **options
    )
    return Run(done.returncode, done.stdout.decode(), done.stderr.decode())


def assert_refused(run: Run, *words: str) -> None:
    assert (run.code, run.out) == (2, "")
    assert run.err.startswith("idam: ") and run.err.count("\n") == 1
    for word in words:
        assert word in run.err


# --- apply ---------------------------------------------------------------------------------------------------------


def test_apply_moves_with_all_attributes(work: Path, call: Call) -> None:
    assert call("apply", "T.txt", "source.ply", "-o", "moved.ply") == (0, "", "")
    before, after = read_point_cloud("source.ply"), read_point_cloud("moved.ply")
    np.testing.assert_allclose(after.points, rigid.apply(MOTION, before.points), atol=1e-6)
    np.testing.assert_array_equal(after.colors, before.colors)
    np.testing.assert_array_equal(after.attributes["intensity"], before.attributes["intensity"])
    assert call("apply", "T.txt", "moved.ply", "-o", "back.csv", "--inverse").code == 0
    np.testing.assert_allclose(read_point_cloud("back.csv").points, before.points, atol=1e-6)


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (("T.txt", "source.ply", "-o", "source.ply"), ["source.ply: would overwrite an input"]),
        (("T.txt", "source.ply", "-o", "./../{here}/source.ply"), ["would overwrite an input"]),
        (("T.txt", "source.ply", "-o", "T.txt"), ["T.txt: would overwrite an input"]),
        (("T.txt", "source.ply", "-o", "linked.ply"), ["would overwrite an input"]),
        (("T.txt", "source.ply", "-o", "a.dwg"), ["unknown point cloud format"]),
        (("T.txt", "gone.ply", "-o", "a.ply"), ["gone.ply: no such file"]),
        (("source.ply", "source.ply", "-o", "a.ply"), ["source.ply: holds no 4 x 4 transform"]),
        (("T.txt", "source.ply"), ["--output"]),
    ],
)
def test_apply_refuses(work: Path, call: Call, args: tuple[str, ...], words: list[str]) -> None:
    os.link("source.ply", "linked.ply")
    before = {path.name: path.read_bytes() for path in work.iterdir()}
    assert_refused(call("apply", *(arg.format(here=work.name) for arg in args)), *words)
    assert {path.name: path.read_bytes() for path in work.iterdir()} == before


# --- info ----------------------------------------------------------------------------------------------------------


def test_info_of_a_cloud(work: Path, call: Call) -> None:
    Path("a.csv").write_text("name,x,y,z,red,green,blue,t\nP,0,0,0,1,2,3,5\nQ,nan,0,0,1,2,3,6\nR,0,3,4,1,2,3,7\n")
    code, out, err = call("info", "a.csv")
    assert (code, err) == (0, "")
    rows = dict(line.split(None, 1) for line in out.splitlines())
    assert rows["points"] == "2"
    assert rows["y"] == "0 to 3  (3)"
    assert rows["spacing"].startswith("5 ")
    assert rows["colours"] == "red, green, blue"
    assert rows["t"] == "5 to 7"
    assert "left out columns that hold text: name" in out
    assert "left out 1 points that are NaN or infinite" in out


def test_register_and_view_say_what_a_file_leaves_out(work: Path, call: Call) -> None:
    points = np.concatenate([shape(), np.full((7, 3), np.nan)])
    np.save("camera.npy", points)
    words = "idam: camera.npy: left out 7 points that are NaN or infinite\n"
    code, out, err = call("register", "camera.npy", "target.xyz", "--refine", "none")
    assert (code, err) == (0, words)
    assert np.isfinite(np.loadtxt(out.splitlines()[:4])).all()
    assert call("register", "camera.npy", "target.xyz", "--refine", "none", "-q").err == ""
    assert call("view", "camera.npy", "target.xyz", "--no-open").err == words


def test_info_of_meshes_scans_and_transforms(work: Path, call: Call) -> None:
    Path("a.off").write_text("OFF\n4 2 0\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 1 2\n3 0 1 3\n")
    assert "mesh        2 triangles" in call("info", "a.off").out
    Path("a.pts").write_text("1\n0 0 0\n2\n0 0 1\n1 0 0\n")
    out = call("info", "a.pts").out
    assert "scans       2" in out and "a.pts#2" in out
    out = call("info", "T.txt").out
    assert format_transform(MOTION) in out and format_transform(MOTION, "tum") in out
    assert_refused(call("info", "gone.json"), "gone.json: no such file")
    assert_refused(call("info", "gone.ply"), "gone.ply: no such file")


@pytest.mark.parametrize(
    ("points", "words"),
    [
        (np.array([[412_000.0, 5_412_000, 0], [412_010, 5_412_020, 9]]), "UTM"),
        (np.array([[0, 0, 0], [9000.0, 0, 0]]), "millimetres"),
        (np.array([[0, 0, 0], [0.5, 0.1, 0]]), "normalised"),
        (np.array([[0, 0, 0], [50, 20.0, 0]]), "if it is a place"),
    ],
)
def test_info_guesses_the_unit(work: Path, call: Call, points: np.ndarray, words: str) -> None:
    write_point_cloud("a.xyz", points)
    assert words in call("info", "a.xyz").out


# --- view ----------------------------------------------------------------------------------------------------------


def test_view_writes_a_page_without_a_judgement(work: Path, call: Call) -> None:
    code, out, err = call("view", "source.ply", "target.xyz", "T.txt", "--no-open")
    assert (code, out, err) == (0, "look at view.html\n", "")
    page = Path("view.html").read_text()
    assert '<body class="unjudged">' in page and "source.ply" in page and "100.0 %" in page and "{{" not in page
    call("view", "source.ply", "target.xyz", "-o", "apart.html", "--no-open")
    assert "100.0 %" not in Path("apart.html").read_text()
    assert_refused(call("view", "source.ply", "target.xyz", "-o", "source.ply"), "would overwrite an input")


# --- register ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "args",
    [
        ("-o", "source.ply"),
        ("-o", "target.xyz"),
        ("--json", "source.ply"),
        ("-o", "a.xyz", "--transform", "a.xyz"),
        ("--json", "r.json", "--html", "./r.json"),
        ("-o", "-", "--transform", "-"),
        ("--init", "T.txt", "--transform", "T.txt"),
    ],
)
def test_register_overwrites_no_input_and_no_other_output(work: Path, call: Call, args: tuple[str, ...]) -> None:
    before = {path.name: path.read_bytes() for path in work.iterdir()}
    run = call("register", "source.ply", "target.xyz", *args)
    assert_refused(run)
    assert "overwrite an input" in run.err or "two outputs to one file" in run.err
    assert {path.name: path.read_bytes() for path in work.iterdir()} == before


def test_register_names_the_file_at_fault(work: Path, call: Call) -> None:
    Path("few.xyz").write_text("0 0 0\n1 0 0\n0 1 0\n")
    assert_refused(call("register", "source.ply", "few.xyz"), "few.xyz: has 3 points")
    assert_refused(call("register", "few.xyz", "source.ply"), "few.xyz: has 3 points")
    Path("nan.csv").write_text("name,x,y,z\nP,nan,0,0\n" + "".join(f"a,{x},{x * x % 7},{x % 5}\n" for x in range(40)))
    run = call("register", "nan.csv", "nan.csv", "-v")
    assert "left out columns that hold text: name" in run.err and "left out 1 points" in run.err


def test_register_json_is_json_under_any_name(work: Path, call: Call) -> None:
    assert call("register", "source.ply", "target.xyz", "--json", "r.txt").code == 0
    assert "confidence" in json.loads(Path("r.txt").read_text())


def test_register_writes_the_mesh_itself(work: Path, call: Call) -> None:
    trimesh = pytest.importorskip("trimesh")
    cone = trimesh.creation.icosphere(3).apply_transform(np.diag([1.0, 0.6, 0.3, 1]))
    cone.vertices = cone.vertices + np.maximum(cone.vertices, 0) * 0.4
    cone.export("part.stl")
    write_point_cloud("scan.ply", rigid.apply(MOTION, cone.sample(1000, seed=0)))
    assert call("register", "part.stl", "scan.ply", "-o", "moved.stl", "--transform", "found.txt").code in (0, 1)
    moved = trimesh.load("moved.stl", process=False)
    assert len(moved.faces) == len(cone.faces)
    expected = rigid.apply(read_transform("found.txt"), np.asarray(trimesh.load("part.stl", process=False).triangles))
    np.testing.assert_allclose(moved.triangles, expected, atol=1e-5)


def test_standard_input_and_output(work: Path) -> None:
    run = launch("cat target.xyz | idam register - source.ply -o - -q | idam info -")
    assert run.code == 0, run.err
    assert "points      400" in run.out
    run = launch("idam register source.ply target.xyz -q | idam apply - source.ply -o moved.ply")
    assert (run.code, run.out, run.err) == (0, "", "")
    np.testing.assert_allclose(read_point_cloud("moved.ply").points, read_point_cloud("target.xyz").points, atol=1e-2)
    assert_refused(launch("idam register - - < target.xyz"), "standard input")
    assert_refused(launch("idam info - < /dev/null"), "standard input")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
@pytest.mark.parametrize("command", ["idam register source.ply target.xyz", "idam info source.ply", "idam --help"])
def test_a_full_disk_is_bad_input_and_no_traceback(work: Path, command: str) -> None:
    run = launch(f"{command} > /dev/full")
    assert_refused(run, "cannot write to the standard output")


def test_a_reader_that_leaves_is_no_error(work: Path) -> None:
    run = launch("idam info source.ply | true")
    assert run.err == "" and run.code in (0, 141)


# --- habits --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("args", [("-h",), ("register", "-h"), ("apply", "-h"), ("info", "-h")])
def test_short_help(call: Call, args: tuple[str, ...]) -> None:
    code, out, err = call(*args)
    assert (code, err) == (0, "") and "Usage" in out


def test_shell_completion() -> None:
    asked = {"_IDAM_COMPLETE": "complete_bash", "COMP_WORDS": "idam app", "COMP_CWORD": "1"}
    code, out, _ = launch("idam ", env={**os.environ, **asked})
    assert (code, out.split()) == (0, ["apply"])
