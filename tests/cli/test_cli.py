"""The command line: what it prints, what it writes, and how it says no."""

from __future__ import annotations

import json
import logging
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

import idam
from idam import RegistrationResult, cli, registration
from idam.io import PointCloud, format_transform, read_point_cloud, read_transform, write_point_cloud
from idam.report import view
from idam.result import chance
from idam.weights import provenance
from motions import degrees, rotation


class Run(NamedTuple):
    code: int
    out: str
    err: str


Call = Callable[..., Run]


@pytest.fixture(scope="session")
def scans(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with source.ply, coloured and with normals, and target.xyz, turned."""
    random = np.random.default_rng(0)
    normals = random.normal(size=(300, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = normals * [1.0, 0.6, 0.3] + np.maximum(normals, 0) * 0.4
    cloud = PointCloud(points, random.integers(0, 256, (300, 3), dtype=np.uint8), normals)
    folder = tmp_path_factory.mktemp("scans")
    write_point_cloud(folder / "source.ply", cloud)
    write_point_cloud(folder / "target.xyz", points @ rotation([0.4, 1.1, -0.3]).T + 3.0)
    return folder


@pytest.fixture
def work(scans: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder, with the scans in it."""
    shutil.copytree(scans, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
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


def launch(*args: Any) -> Run:
    """Runs the command line in a process of its own."""
    done = subprocess.run(
        [sys.executable, "-m", "idam", *map(str, args)], capture_output=True, text=True, timeout=120, check=False
    )
    return Run(done.returncode, done.stdout, done.stderr)


@pytest.fixture(scope="session")
def result(scans: Path) -> RegistrationResult:
    return idam.register(scans / "source.ply", scans / "target.xyz")


@pytest.fixture
def calls(result: RegistrationResult, monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """Takes the place of a registration: always the same result, and a record of what it was asked with."""
    record: list[dict[str, Any]] = []

    def register(source: PointCloud, target: PointCloud, **options: Any) -> RegistrationResult:
        record.append({"points": (len(source.points), len(target.points)), **options})
        return result

    monkeypatch.setattr(registration, "register", register)
    return record


def files_in(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def assert_refused(run: Run, *words: str) -> None:
    assert run.code == 2
    assert run.out == ""
    assert run.err.startswith("idam: ")
    assert run.err.count("\n") == 1
    assert run.err.endswith("\n")
    for word in words:
        assert word in run.err


def printed_matrix(out: str) -> np.ndarray:
    return np.array([line.split() for line in out.splitlines()[:4]], np.float64)


# --- register ------------------------------------------------------------------------------------------------------


def test_register_from_end_to_end(work: Path, result: RegistrationResult) -> None:
    before = files_in(work)
    outputs = {"-o": "aligned.ply", "--transform": "T.txt", "--json": "result.json", "--html": "look.html"}
    run = launch("register", "source.ply", "target.xyz", *(word for pair in outputs.items() for word in pair))
    assert run.err == ""
    assert files_in(work).keys() == before.keys() | set(outputs.values())
    assert all((work / name).read_bytes() == content for name, content in before.items())
    content = json.loads((work / "result.json").read_text())
    assert run.code == (0 if result.converged else 1)
    matrix = read_transform(work / "T.txt")
    np.testing.assert_allclose(matrix, result.transformation, atol=1e-6)
    np.testing.assert_array_equal(printed_matrix(run.out), matrix)
    np.testing.assert_array_equal(content["transformation"], matrix)
    for word in (
        f"{content['fitness']:.3f}",
        f"confidence  {chance(content['confidence'])}",
        f"{content['inlier_rmse']:.4g}",
    ):
        assert word in run.out
    source, aligned = read_point_cloud(work / "source.ply"), read_point_cloud(work / "aligned.ply")
    np.testing.assert_allclose(aligned.points, source.points @ matrix[:3, :3].T + matrix[:3, 3], atol=1e-5)
    np.testing.assert_allclose(aligned.normals, source.normals @ matrix[:3, :3].T, atol=1e-5)
    np.testing.assert_array_equal(aligned.colors, source.colors)
    page = (work / "look.html").read_text().lower()
    assert page.startswith("<!doctype html>")
    size = (work / "source.ply").stat().st_size
    assert f"source.ply, {size:,} bytes, " in page  # for a report to hand in
    assert "<th>options</th><td>model default, max-angle 180.0, refine gicp, seed 0</td>" in page
    assert "target.xyz" in page


def test_register_writes_nothing_unasked(work: Path, call: Call, calls: list[Any], result: RegistrationResult) -> None:
    before = files_in(work)
    run = call("register", "source.ply", "target.xyz")
    assert run.out.startswith(format_transform(result.transformation) + "\n")
    assert run.err == ""
    assert files_in(work) == before


@pytest.mark.parametrize(("converged", "code"), [(True, 0), (False, 1)])
@pytest.mark.parametrize("quiet", [[], ["-q"]])
def test_exit_code_says_whether_it_converged(
    work: Path,
    call: Call,
    result: RegistrationResult,
    monkeypatch: pytest.MonkeyPatch,
    converged: bool,
    code: int,
    quiet: list[str],
) -> None:
    monkeypatch.setattr(registration, "register", lambda *_, **__: replace(result, converged=converged))
    run = call("register", "source.ply", "target.xyz", "-o", "aligned.ply", *quiet)
    assert run.code == code
    assert run.err == ""
    np.testing.assert_array_equal(printed_matrix(run.out), result.transformation)
    assert (work / "aligned.ply").exists()


@pytest.mark.parametrize("reason", ["", "two poses explain the data equally well"])
def test_reason_is_printed_where_there_is_one(
    work: Path, call: Call, result: RegistrationResult, monkeypatch: pytest.MonkeyPatch, reason: str
) -> None:
    monkeypatch.setattr(registration, "register", lambda *_, **__: replace(result, reason=reason))
    run = call("register", "source.ply", "target.xyz")
    assert ("reason" in run.out) == bool(reason)
    assert reason in run.out


@pytest.mark.parametrize("option", ["-q", "--quiet"])
def test_quiet_prints_the_matrix_alone(
    work: Path, call: Call, calls: list[Any], result: RegistrationResult, option: str
) -> None:
    run = call("register", "source.ply", "target.xyz", option)
    assert (run.out, run.err) == (format_transform(result.transformation) + "\n", "")


@pytest.mark.parametrize("option", ["-v", "--verbose"])
def test_verbose_tells_the_steps_on_stderr(
    work: Path, call: Call, result: RegistrationResult, monkeypatch: pytest.MonkeyPatch, option: str
) -> None:
    log = logging.getLogger("idam.registration")

    def register(*_: Any, **__: Any) -> RegistrationResult:
        log.info("voxel grids: %d points", 1024)
        log.debug("not this")
        return result

    monkeypatch.setattr(registration, "register", register)
    assert call("register", "source.ply", "target.xyz", "-q").err == ""
    run = call("register", "source.ply", "target.xyz", "-q", option)
    assert run.err == "voxel grids: 1024 points\n"
    assert run.out == format_transform(result.transformation) + "\n"
    assert call("register", "source.ply", "target.xyz", "-q").err == ""  # as before


@pytest.mark.parametrize(("name", "start"), [("look.png", b"\x89PNG"), ("look.SVG", b"<?xml")])
def test_plot_is_saved_by_its_extension(work: Path, call: Call, calls: list[Any], name: str, start: bytes) -> None:
    pytest.importorskip("matplotlib", reason="figures need Matplotlib: pip install 'idam[figures]'")
    before = files_in(work)
    run = call("register", "source.ply", "target.xyz", "--save-plot", name)
    assert run.err == ""
    assert files_in(work).keys() == before.keys() | {name}
    assert (work / name).read_bytes().startswith(start)


@pytest.mark.parametrize("name", ["look.jpg", "look"])
def test_refuses_a_plot_it_cannot_draw(work: Path, call: Call, calls: list[Any], name: str) -> None:
    assert_refused(call("register", "source.ply", "target.xyz", "--save-plot", name), name, ".png, .svg")
    assert calls == []


def test_plot_without_matplotlib_names_the_pip_command(
    work: Path, call: Call, calls: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(view, "find_spec", lambda _: None)
    assert_refused(
        call("register", "source.ply", "target.xyz", "--save-plot", "look.png"), "pip install 'idam[figures]'"
    )
    assert calls == []


def test_options_reach_the_registration(work: Path, call: Call, calls: list[dict[str, Any]]) -> None:
    (work / "init.txt").write_text("0 -1 0 1\n1 0 0 2\n0 0 1 3\n0 0 0 1\n")
    options = {
        "model": "gnn-unseen-shapes",
        "max-angle": 75.0,
        "voxel-size": 0.5,
        "max-correspondence-distance": 0.25,
        "refine": "plane",
        "seed": 7,
        "device": "cpu",
    }
    words = [word for name, value in options.items() for word in (f"--{name}", value)]
    assert call("register", "source.ply", "target.xyz", "--init", "init.txt", *words).err == ""
    call("register", "target.xyz", "source.ply")
    given, left_out = calls
    np.testing.assert_array_equal(given.pop("init"), [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])
    assert given == {"points": (300, 300), **{name.replace("-", "_"): value for name, value in options.items()}}
    assert (left_out["model"], left_out["refine"], left_out["seed"]) == ("default", "gicp", 0)
    assert left_out["max_angle"] == 180.0
    assert left_out["init"] is left_out["voxel_size"] is left_out["max_correspondence_distance"] is None


# --- bad input -----------------------------------------------------------------------------------------------------


def spoil(folder: Path) -> None:
    """Add files that cannot be used."""
    whole = (folder / "source.ply").read_bytes()
    contents = {
        "cut.ply": whole[: len(whole) // 2],
        "header.ply": whole[:60],
        "empty.ply": b"",
        "cloud.foo": whole,
        "words.xyz": b"not a cloud at all\n" * 30,
        "few.xyz": b"0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 1 1\n",
        "line.xyz": b"".join(b"%d %d 0\n" % (n, 2 * n) for n in range(50)),
        "scaled.txt": b"2 0 0 0\n0 2 0 0\n0 0 2 0\n0 0 0 1\n",
        "a.safetensors": b"not a model",
    }
    for name, content in contents.items():
        (folder / name).write_bytes(content)


@pytest.mark.parametrize(
    ("file", "words"),
    [
        ("missing.ply", "missing.ply: no such file"),
        ("cut.ply", "cut.ply: "),
        ("header.ply", "header.ply: "),
        ("empty.ply", "empty.ply: is empty"),
        ("cloud.foo", "cloud.foo: unknown point cloud format"),
        ("words.xyz", "words.xyz: "),
        (".", "is a folder"),
        ("few.xyz", "has 5 points"),
        ("line.xyz", "line"),
    ],
)
def test_refuses_files(work: Path, call: Call, file: str, words: str) -> None:
    spoil(work)
    before = files_in(work)
    assert_refused(call("register", file, "target.xyz", "-o", "out.ply", "--json", "out.json"), words)
    assert_refused(call("register", "source.ply", file, "--html", "out.html"), words)
    assert files_in(work) == before


@pytest.mark.parametrize(
    ("option", "value", "words"),
    [
        ("--model", "nosuch", "gnn-unseen-shapes"),
        ("--model", "a.safetensors", "a.safetensors"),
        ("--init", "missing.txt", "missing.txt"),
        ("--init", "scaled.txt", "scaled.txt"),
        ("--max-angle", "0", "max_angle"),
        ("--max-angle", "far", "--max-angle"),
        ("--voxel-size", "0", "voxel_size"),
        ("--voxel-size", "wide", "--voxel-size"),
        ("--voxel-size", "nan", "voxel_size"),
        ("--max-correspondence-distance", "-1", "max_correspondence_distance"),
        ("--refine", "magic", "gicp, plane, point, symmetric or none"),
        ("--seed", "one", "--seed"),
        ("--seed", "1" * 30, "seed"),
        ("--nonsense", "1", "--nonsense"),
    ],
)
def test_refuses_options(work: Path, call: Call, option: str, value: str, words: str) -> None:
    spoil(work)
    before = files_in(work)
    assert_refused(call("register", "source.ply", "target.xyz", "-o", "out.ply", option, value), words)
    assert files_in(work) == before


@pytest.mark.parametrize("device", ["abacus", "cuda:99"])
def test_refuses_devices_that_a_network_cannot_run_on(work: Path, call: Call, device: str) -> None:
    pytest.importorskip("torch", reason="the paper's networks need PyTorch: pip install 'idam[torch]'")
    model = ("--model", "gnn-unseen-shapes")
    assert_refused(call("register", "source.ply", "target.xyz", "-o", "out.ply", *model, "--device", device), device)
    assert not (work / "out.ply").exists()


OUTPUTS = {"-o": "a.ply", "--transform": "a.txt", "--json": "a.json", "--html": "a.html", "--save-plot": "a.png"}


def all_outputs_but(option: str, value: Any) -> list[Any]:
    return [word for pair in (OUTPUTS | {option: value}).items() for word in pair]


@pytest.mark.parametrize("option", OUTPUTS)
@pytest.mark.parametrize("place", ["missing/a.ply", "folder.ply"])
def test_writes_all_outputs_or_none(work: Path, call: Call, calls: list[Any], option: str, place: str) -> None:
    (work / "folder.ply").mkdir()
    for name in OUTPUTS.values():
        (work / name).write_text("what was there before")
    before = files_in(work)
    assert_refused(call("register", "source.ply", "target.xyz", *all_outputs_but(option, place)), place)
    assert files_in(work) == before
    assert calls == []  # found out before the work, not after it


def test_refuses_a_format_it_cannot_write(work: Path, call: Call, calls: list[Any]) -> None:
    before = files_in(work)
    assert_refused(call("register", "source.ply", "target.xyz", *all_outputs_but("-o", "a.foo")), "a.foo", ".ply")
    assert files_in(work) == before
    assert calls == []


@pytest.mark.skipif(os.name == "posix" and os.geteuid() == 0, reason="nothing is read-only to root")
@pytest.mark.parametrize("option", OUTPUTS)
def test_refuses_read_only_outputs(work: Path, call: Call, calls: list[Any], option: str) -> None:
    locked = work / "locked"
    locked.mkdir()
    (locked / "a.ply").write_text("what was there before")
    (locked / "a.ply").chmod(0o444)
    before = files_in(work)
    assert_refused(call("register", "source.ply", "target.xyz", *all_outputs_but(option, "locked/a.ply")), "a.ply")
    locked.chmod(0o555)
    assert_refused(call("register", "source.ply", "target.xyz", *all_outputs_but(option, "locked/b.ply")), "b.ply")
    locked.chmod(0o755)
    assert files_in(work) == before


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["nonsense"], "nonsense"),
        (["--nonsense"], "--nonsense"),
        (["register"], "source"),
        (["register", "source.ply"], "target"),
        (["register", "source.ply", "target.xyz", "third.ply"], "third.ply"),
        (["register", "source.ply", "target.xyz", "-o"], "-o"),
    ],
)
def test_refuses_wrong_calls(work: Path, call: Call, args: list[str], words: str) -> None:
    assert_refused(call(*args), words, "idam --help")


@pytest.mark.parametrize("file", ["missing.ply", "cut.ply"])
def test_refuses_in_a_process_of_its_own(work: Path, file: str) -> None:
    spoil(work)
    before = files_in(work)
    assert_refused(launch("register", file, "target.xyz", "-o", "out.ply"), file)
    assert files_in(work) == before


@pytest.mark.parametrize(
    "args",
    [
        ["train", "unseen-shapes", "--data", "x"],
        ["evaluate", "--pairs", "x.npz"],
        ["figures", "x", "--data", "x"],
        ["data", "modelnet40", "x"],
    ],
)
def test_the_core_alone_names_what_the_lab_needs(args: list[str]) -> None:
    names = "torch", "scipy", "h5py", "lightning_fabric", "tensorboard", "matplotlib"
    code = f"import sys; sys.modules.update(dict.fromkeys({names})); from idam import cli; cli.main()"
    run = subprocess.run([sys.executable, "-c", code, *args], capture_output=True, text=True)
    assert run.returncode == 2
    assert "pip install 'idam[lab]'" in run.stderr
    assert run.stderr.count("\n") == 1


def test_interruption_leaves_no_traceback(work: Path, call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(registration, "register", interrupted)
    run = call("register", "source.ply", "target.xyz")
    assert (run.code, run.out) == (130, "")
    assert run.err in ("", "idam: interrupted\n")


# --- the other commands --------------------------------------------------------------------------------------------


def test_demo_writes_its_files(tmp_path: Path) -> None:
    folder = tmp_path / "new" / "folder"
    run = launch("demo", "-o", folder)
    assert run.err == ""
    assert run.code == 0
    suffixes = sorted(path.suffix for path in folder.iterdir())
    assert suffixes == [".html", ".ply", ".txt"]
    for path in folder.iterdir():
        assert str(path) in run.out
    matrix = read_transform(next(folder.glob("*.txt")))
    np.testing.assert_array_equal(printed_matrix(run.out), matrix)
    truth = np.loadtxt(str(resources.files("idam.lab.data") / "demo" / "truth.txt"))
    with resources.as_file(resources.files("idam.demo") / "source.ply") as shipped:
        source = read_point_cloud(shipped)
    assert degrees(matrix, truth) < 5.0
    aligned = read_point_cloud(next(folder.glob("*.ply")))
    np.testing.assert_allclose(aligned.points, source.transformed(matrix).points, atol=1e-5)


def test_demo_refuses_a_folder_it_cannot_make(work: Path, call: Call) -> None:
    assert_refused(call("demo", "-o", "source.ply"), "source.ply")
    assert_refused(call("demo", "-o", "source.ply/out"), "source.ply")


@pytest.mark.parametrize("columns", ["80", "200"])
def test_models_lists_every_model_with_its_provenance(
    call: Call, monkeypatch: pytest.MonkeyPatch, columns: str
) -> None:
    monkeypatch.setenv("COLUMNS", columns)
    assert "idam train" not in call("models").out
    run = call("models", "--verbose")
    assert run.code == 0
    assert run.err == ""
    words = " ".join(run.out.split())
    for name in idam.list_models():
        assert name in words
        history = provenance(name)
        assert history["experiment"] in words
        assert " ".join(history["command"].split()) in words
        scores = history["validation"]
        told = ("accuracy", "accuracy") if "accuracy" in scores else ("RMSE(R)", "rmse_r")
        assert f"{told[0]} {scores[told[1]]:.3f}" in words


def test_version(call: Call) -> None:
    assert call("--version") == (0, f"idam {idam.__version__}\n", "")


def test_help_names_every_command_and_option(call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "120")
    run = call("--help")
    assert (run.code, run.err) == (0, "")
    assert {"register", "train", "evaluate", "demo", "models"} <= set(run.out.split())
    run = call("register", "--help")
    assert (run.code, run.err) == (0, "")
    options = "--output -o --transform --json --html --model --init --voxel-size --max-correspondence-distance --refine"
    options += " --save-plot --quiet -q --verbose -v"
    assert set(options.split()) <= set(run.out.replace(",", " ").split())
    assert "idam register scan1.ply scan2.ply" in run.out


def test_without_arguments_it_helps(call: Call) -> None:
    run = call()
    assert run.code == 2
    assert "register" in run.out
    assert run.err.count("\n") <= 1
