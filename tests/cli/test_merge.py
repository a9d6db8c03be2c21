"""``idam merge``: what it writes, its exit codes, and how it says no."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest

from cheap import ENVIRONMENT
from idam import cli, rigid
from idam.io import read_point_cloud, read_transform, write_point_cloud
from killing import alive, descendants, processes, until
from many.worlds import world

NAMES = [f"view{i}.ply" for i in range(4)]


class Run(NamedTuple):
    code: int
    out: str
    err: str


Call = Callable[..., Run]


@pytest.fixture
def poses() -> np.ndarray:
    random = np.random.default_rng(0)
    return rigid.exp(random.normal(size=(4, 6)))


@pytest.fixture
def work(tmp_path: Path, poses: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder, with four scans of an egg in scans/."""
    random = np.random.default_rng(1)
    (tmp_path / "scans").mkdir()
    for name, pose in zip(NAMES, poses, strict=True):
        direction = random.normal(size=(500, 3))
        points = direction / np.linalg.norm(direction, axis=1, keepdims=True) * [1.0, 0.7, 0.5]
        write_point_cloud(tmp_path / "scans" / name, rigid.apply(rigid.inverse(pose), points))
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def calls(work: Path, poses: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """Takes the place of ``idam.register``: the truth, and a record of what it was asked with."""
    centres = [read_point_cloud(work / "scans" / name).points[0] for name in NAMES]
    record: list[dict[str, Any]] = []

    def register(source: Any, target: Any, **options: Any) -> SimpleNamespace:
        one, other = (
            int(np.argmin([np.linalg.norm(cloud.points[0] - centre) for centre in centres]))
            for cloud in (source, target)
        )
        record.append({"pair": (one, other), **options})
        return SimpleNamespace(
            transformation=rigid.inverse(poses[other]) @ poses[one],
            information=1e4 * np.eye(6),
            confidence=0.97,
            reason="",
            fitness=0.8,
            inlier_rmse=0.01,
            max_correspondence_distance=0.1,
        )

    monkeypatch.setattr("idam.registration.register", register)
    return record


@pytest.fixture
def call(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Call:
    """Runs the command line in this process."""

    def run(*args: Any) -> Run:
        monkeypatch.setattr(sys, "argv", ["idam", "merge", *map(str, args), "--jobs", "1"])
        with pytest.raises(SystemExit) as stopped:
            cli.main()
        return Run(int(stopped.value.code or 0), *capfd.readouterr())

    return run


def files_in(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


def test_a_folder_becomes_one_model(work: Path, call: Call, calls: list[Any], poses: np.ndarray) -> None:
    before = {name: (work / "scans" / name).read_bytes() for name in NAMES}
    run = call("scans", "-o", "out")
    assert run.code == 0, run
    assert run.err == ""
    assert "4 of 4 scans in one frame" in run.out
    assert files_in(work / "out") == {
        "poses.json",
        "poses.tum",
        "poses.kitti",
        "poses.kitti.names",
        "graph.g2o",
        "merged.ply",
        "report.html",
        "pairs.jsonl",
        *(f"transforms/{name}.txt" for name in NAMES),
    }
    assert {name: (work / "scans" / name).read_bytes() for name in NAMES} == before
    entries = json.loads((work / "out" / "poses.json").read_text())
    assert list(entries) == NAMES
    for name, pose in zip(NAMES, poses, strict=True):
        assert entries[name].keys() == {"matrix", "component", "confidence", "reason"}
        assert entries[name]["component"] == 0
        assert 0.9 <= entries[name]["confidence"] <= 1
        assert entries[name]["reason"] == ""
        np.testing.assert_allclose(entries[name]["matrix"], rigid.inverse(poses[0]) @ pose, atol=0.05)
        np.testing.assert_array_equal(
            read_transform(work / "out" / "transforms" / f"{name}.txt"), entries[name]["matrix"]
        )


def test_other_tools_formats_hold_the_same_poses(work: Path, call: Call, calls: list[Any]) -> None:
    call("scans", "-o", "out")
    out = work / "out"
    entries = json.loads((out / "poses.json").read_text())
    matrices = np.array([entries[name]["matrix"] for name in NAMES])
    kitti = np.loadtxt(out / "poses.kitti").reshape(-1, 3, 4)
    np.testing.assert_array_equal(kitti, matrices[:, :3])
    assert (out / "poses.kitti.names").read_text().split() == NAMES
    tum = np.loadtxt(out / "poses.tum")
    np.testing.assert_array_equal(tum[:, 0], np.arange(4))
    np.testing.assert_array_equal(tum[:, 1:4], matrices[:, :3, 3])
    for row, matrix in zip(tum, matrices, strict=True):
        np.testing.assert_allclose(from_quaternion(row[4:]), matrix[:3, :3], atol=1e-12)
    vertices, edges = [], []
    for line in (out / "graph.g2o").read_text().splitlines():
        kind, *words = line.split()
        (vertices if kind == "VERTEX_SE3:QUAT" else edges).append(np.array(words, float))
        assert kind in ("VERTEX_SE3:QUAT", "EDGE_SE3:QUAT")
    assert [len(vertex) for vertex in vertices] == [8] * 4
    assert [len(edge) for edge in edges] == [2 + 7 + 21] * 6
    for edge in edges:
        i, j = int(edge[0]), int(edge[1])
        measured = rigid.transform(from_quaternion(edge[5:9]), edge[2:5])
        expected = rigid.inverse(matrices[i]) @ matrices[j]
        np.testing.assert_allclose(measured, expected, atol=0.05)


def from_quaternion(xyzw: np.ndarray) -> np.ndarray:
    x, y, z, w = xyzw
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def test_the_page_stands_alone_and_names_all_scans(work: Path, call: Call, calls: list[Any]) -> None:
    (work / "scans" / "broken.ply").write_text("no cloud </script><b>")
    call("scans", "-o", "out")
    page = (work / "out" / "report.html").read_text()
    assert page.startswith("<!DOCTYPE html>")
    for name in [*NAMES, "broken.ply"]:
        assert name in page
    assert "http" not in page.replace("http-equiv", "")
    assert "{{" not in page
    scene = json.loads(page.split('id="scene">')[1].split("</script>")[0])
    assert [scan is None for scan in scene["scans"]] == [True, False, False, False, False]


def test_a_broken_scan_is_named_and_costs_an_exit_code_of_1(work: Path, call: Call, calls: list[Any]) -> None:
    (work / "scans" / "broken.ply").write_bytes(b"")
    run = call("scans", "-o", "out")
    assert run.code == 1
    assert "broken.ply" in run.out
    assert "is empty" in run.out
    entry = json.loads((work / "out" / "poses.json").read_text())["broken.ply"]
    assert entry["matrix"] is None
    assert entry["component"] == -1
    assert "is empty" in entry["reason"]
    strict = call("scans", "-o", "strict", "--strict")
    assert strict.code == 2
    assert "broken.ply" in strict.err
    assert not (work / "strict" / "poses.json").exists()


def test_a_scan_that_hangs_on_one_link_costs_an_exit_code_of_1(
    work: Path, call: Call, calls: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    run = call("scans/view0.ply", "scans/view1.ply", "-o", "out")
    assert run.code == 1
    assert "hangs on one link" in run.out
    assert call("scans/view0.ply", "scans/view1.ply", "-o", "out", "--threshold", "0.97").code == 1
    assert json.loads((work / "out" / "poses.json").read_text())["view1.ply"]["matrix"] is None


def test_run_again_it_goes_on_from_the_pairs_it_has(work: Path, call: Call, calls: list[Any]) -> None:
    first = call("scans", "-o", "out", "-q")
    poses = (work / "out" / "poses.json").read_bytes()
    assert (first.out, len(calls)) == ("", 6)
    kept = work / "out" / "pairs.jsonl"
    kept.write_text("".join(kept.read_text().splitlines(keepends=True)[:2]))
    call("scans", "-o", "out", "-q")
    assert len(calls) == 6 + 4
    assert (work / "out" / "poses.json").read_bytes() == poses


@pytest.fixture
def command(tmp_path: Path) -> list[str]:
    """The command that merges five scans in two processes."""
    (tmp_path / "scans").mkdir()
    for view, scan in enumerate(world(5, seed=3, points=600, seen=0.8).scans):
        write_point_cloud(tmp_path / "scans" / f"view{view}.ply", scan)
    folders = str(tmp_path / "scans"), "-o", str(tmp_path / "out")
    return [sys.executable, "-m", "idam", "merge", *folders, "-q", "--jobs", "2"]


@processes
@pytest.mark.parametrize("stop", [signal.SIGKILL, signal.SIGINT])
def test_a_stopped_run_leaves_no_process_and_no_half_file_and_goes_on(
    tmp_path: Path, command: list[str], stop: signal.Signals
) -> None:
    kept = tmp_path / "out" / "pairs.jsonl"
    run = subprocess.Popen(command, env=ENVIRONMENT, start_new_session=True, stderr=subprocess.PIPE, text=True)
    assert until(lambda: kept.exists() and kept.read_bytes().count(b"\n") >= 1, 120)
    below = descendants(run.pid)
    if stop == signal.SIGINT:
        os.killpg(run.pid, stop)  # as a terminal's Ctrl-C, which reaches all
        assert run.communicate(timeout=60)[1] == "idam: interrupted: run the same command to go on\n"
        assert run.returncode == 130
    else:
        run.kill()
        run.communicate(timeout=60)
    assert until(lambda: not alive(below))
    assert files_in(tmp_path / "out") == {"pairs.jsonl"}
    done = kept.read_text().split("\n")[0]
    again = subprocess.run([*command, "--jobs", "1"], env=ENVIRONMENT, timeout=120, check=False)
    assert again.returncode == 0
    assert kept.read_text().startswith(done)
    assert len(kept.read_text().splitlines()) == 10
    calm = subprocess.run([*command, "-o", str(tmp_path / "calm")], env=ENVIRONMENT, timeout=120, check=False)
    assert calm.returncode == 0
    differ = {"pairs.jsonl", "report.html"}  # the order in which pairs were done; the time it took
    for name in files_in(tmp_path / "calm") - differ:
        assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "calm" / name).read_bytes(), name


@processes
def test_a_worker_that_is_killed_costs_nothing(tmp_path: Path, command: list[str]) -> None:
    run = subprocess.Popen(command, env=ENVIRONMENT, stderr=subprocess.PIPE, text=True)
    assert until(lambda: len(workers(run.pid)) == 2, 60)
    os.kill(workers(run.pid)[0], signal.SIGKILL)
    assert run.communicate(timeout=120)[1] == ""
    assert run.returncode == 0
    assert len((tmp_path / "out" / "pairs.jsonl").read_text().splitlines()) == 10


def workers(process: int) -> list[int]:
    """The processes below one that register pairs, less those that help Python to keep count."""
    found = []
    for below in descendants(process):
        with contextlib.suppress(OSError):
            found += [below] if b"spawn_main" in Path(f"/proc/{below}/cmdline").read_bytes() else []
    return found


def test_scans_of_one_name_are_told_apart_by_their_folders(work: Path, call: Call, calls: list[Any]) -> None:
    for name in NAMES[:3]:
        (work / name[:-4]).mkdir()
        (work / "scans" / name).rename(work / name[:-4] / "scan.ply")
    folders = [name[:-4] for name in NAMES[:3]]
    run = call(*folders, "scans/view3.ply", "-o", "out", "--reference", "view1/scan.ply")
    assert run.code == 0, run
    names = [*(f"{folder}/scan.ply" for folder in folders), "view3.ply"]
    assert list(json.loads((work / "out" / "poses.json").read_text())) == names
    assert {str(path.relative_to(work / "out" / "transforms")) for path in transforms(work)} == {
        f"{name}.txt" for name in names
    }
    np.testing.assert_array_equal(read_transform(work / "out" / "transforms" / "view1" / "scan.ply.txt"), np.eye(4))
    unclear = call(*folders, "scans/view3.ply", "-o", "again", "--reference", "scan.ply")
    assert unclear.code == 2
    assert "may be view0/scan.ply or view1/scan.ply" in unclear.err


def transforms(work: Path) -> list[Path]:
    return [path for path in (work / "out" / "transforms").rglob("*") if path.is_file()]


@pytest.mark.parametrize("reference", ["view2.ply", "scans/view2.ply", "view2"])
def test_the_reference_may_be_its_path(work: Path, call: Call, calls: list[Any], reference: str) -> None:
    assert call("scans", "-o", "out", "--reference", reference).code == 0
    np.testing.assert_array_equal(read_transform(work / "out" / "transforms" / "view2.ply.txt"), np.eye(4))


def test_files_that_no_merge_wrote_stay(work: Path, call: Call, calls: list[Any]) -> None:
    mine = [work / "out" / "transforms" / "mine.txt", work / "out" / "merged.ply", work / "out" / "notes.txt"]
    mine[0].parent.mkdir(parents=True)
    for path in mine:
        path.write_text("mine")
    (work / "out" / "poses.json").write_text("{")
    call("scans", "-o", "out", "--no-cloud")
    call("scans", "-o", "out", "--no-cloud", "--reference", "view1.ply")
    assert mine[0].read_text() == "mine"
    assert mine[2].read_text() == "mine"


def test_a_file_that_is_not_there_is_named(work: Path, call: Call, calls: list[Any]) -> None:
    run = call("scans", "scans/view9", "-o", "out")
    assert run.code == 1
    assert "no such file" in run.out


def test_fewer_scans_leave_no_transform_of_others(work: Path, call: Call, calls: list[Any]) -> None:
    call("scans", "-o", "out")
    assert (work / "out" / "merged.ply").exists()
    call(*(f"scans/{name}" for name in NAMES[:3]), "-o", "out", "--no-cloud", "--reference", "view2.ply")
    assert {path.name for path in (work / "out" / "transforms").iterdir()} == {f"{name}.txt" for name in NAMES[:3]}
    np.testing.assert_array_equal(read_transform(work / "out" / "transforms" / "view2.ply.txt"), np.eye(4))
    assert not (work / "out" / "merged.ply").exists()  # it would have the poses of the run before


def test_options_reach_the_registration(work: Path, call: Call, calls: list[Any]) -> None:
    call("scans", "-o", "out", "--voxel-size", "0.05")
    assert {each["voxel_size"] for each in calls} == {0.05}
    calls.clear()
    call("scans", "-o", "again", "--poses", "out/poses.json")
    assert all(np.shape(each["init"]) == (4, 4) for each in calls)


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["nowhere.ply", "scans/view0.ply"], "nowhere.ply"),
        (["scans/view0.ply"], "at least 2"),
        (["scans", "--reference", "nobody.ply"], "nobody.ply"),
        (["scans", "--threshold", "2"], "threshold"),
        (["scans", "--reference", "view"], "view0.ply"),
        (["scans", "--poses", "scans/view0.ply"], "holds no poses"),
        (["scans", "--poses", "list.json"], "holds no poses"),
        (["scans", "--poses", "others.json"], "none of the scans"),
        (["scans", "--poses", "stretched.json"], "not a rigid transform"),
        (["scans", "scans"], "have this name"),
        (["scans", "scans/view0.ply"], "have this name"),
        (["none"], "no file of a point cloud"),
        (["one"], "at least 2"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(
    work: Path, call: Call, calls: list[Any], args: list[str], words: str
) -> None:
    (work / "none").mkdir()
    (work / "one").mkdir()
    shutil.copy(work / "scans" / "view0.ply", work / "one")
    (work / "list.json").write_text("[]")
    (work / "others.json").write_text(json.dumps({"nobody.ply": np.eye(4).tolist()}))
    (work / "stretched.json").write_text(json.dumps({"view0.ply": (2 * np.eye(4)).tolist()}))
    run = call(*args, "-o", "out")
    assert run.code == 2, run
    assert words in run.err
    assert run.err.startswith("idam: ")
    assert run.err.count("\n") == 1
    assert calls == []
    assert files_in(work / "out") == set() if (work / "out").exists() else True


@pytest.mark.parametrize("given", ["scans", "scans/view0.ply"])
def test_the_model_never_lies_among_the_scans(work: Path, call: Call, calls: list[Any], given: str) -> None:
    before = files_in(work)
    run = call(given, "scans/view1.ply", "-o", "scans/../scans")
    assert run.code == 2
    assert "folder of its own" in run.err
    assert files_in(work) == before


def test_the_merged_cloud_has_each_place_once(work: Path, call: Call, calls: list[Any]) -> None:
    call("scans", "-o", "out")
    merged = read_point_cloud(work / "out" / "merged.ply")
    assert 100 < len(merged.points) < 2000
    assert "scan" in merged.attributes


def test_it_needs_the_core_alone(work: Path) -> None:
    code = (
        "import sys; from idam.many import merge, files; import idam.report.merge; "
        "sys.exit(any(name in sys.modules for name in ('torch', 'scipy', 'matplotlib', 'h5py')))"
    )
    beside = Path(cli.__file__).parents[2]  # from where the package under test is imported
    assert subprocess.run([sys.executable, "-c", code], cwd=beside, timeout=120, check=False).returncode == 0
