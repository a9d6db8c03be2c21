"""The commands that train, measure and list models, on a small ModelNet40 of our own."""

import dataclasses
import json
import math
import os
import re
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch

from idam import cli, weights
from idam.cli.shared import tell
from idam.lab import training
from idam.lab.data.modelnet40 import experiment_shapes
from idam.lab.data.pairs import Pairs
from idam.lab.evaluation import experiments
from idam.lab.evaluation.experiments import TestSet
from idam.lab.evaluation.runner import Task, run
from idam.lab.training import Recipe, loop, task
from idam.lab.training.batches import batch_at, split_validation
from idam.lab.training.checkpoint import initial_model
from idam.lab.training.step import SupervisedStep
from idam.network.pretrained import load_model
from idam.weights import list_models, provenance


class Outcome(NamedTuple):
    """What a command left."""

    code: int
    out: str
    err: str


@pytest.fixture
def idam(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., Outcome]:
    """Runs a command in this process."""
    monkeypatch.setattr(loop, "keep_freed_memory", lambda: True)  # it would hold for all tests after this one

    def run(*words: object) -> Outcome:
        monkeypatch.setattr(sys, "argv", ["idam", *map(str, words)])
        with pytest.raises(SystemExit) as exit:
            cli.main()
        return Outcome(exit.value.code, *capsys.readouterr())

    return run


def process(*words: object, module: tuple[str, ...] = ()) -> Outcome:
    """Runs a command in a process of its own."""
    command = [sys.executable, "-m", *module, *map(str, words)]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "GLOO_SOCKET_IFNAME": "lo", "COLUMNS": "200"}
    done = subprocess.run(command, capture_output=True, text=True, timeout=200, env=environment, check=False)
    return Outcome(done.returncode, done.stdout, done.stderr)


def assert_refused(outcome: Outcome, message: str) -> None:
    assert outcome.code == 2
    assert outcome.out == ""
    assert re.fullmatch(r"idam: [^\n]+\n", outcome.err)
    assert re.search(message, outcome.err)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """22 boxes to train on, half of them of the first 20 categories, and 5 to test on."""
    h5py = pytest.importorskip("h5py", reason="ModelNet40 is read with h5py")
    folder, rng = tmp_path_factory.mktemp("data") / "modelnet40_ply_hdf5_2048", np.random.default_rng(0)
    folder.mkdir()
    for split, count in (("train", 22), ("test", 5)):
        points = rng.uniform(-1, 1, (count, 1024, 3))
        side = rng.integers(0, 3, (count, 1024, 1))
        np.put_along_axis(points, side, np.sign(np.take_along_axis(points, side, -1)), -1)
        points *= rng.uniform(0.3, 1, (count, 1, 3))
        points /= np.linalg.norm(points, axis=-1).max(-1)[:, None, None]
        with h5py.File(folder / f"{split}0.h5", "w") as file:
            file["data"] = points.astype(np.float32)
            file["label"] = np.linspace(0, 39, count).astype(np.uint8)[:, None]
        (folder / f"{split}_files.txt").write_text(f"data/modelnet40_ply_hdf5_2048/{split}0.h5\n")
    return folder.parent


@pytest.fixture
def trainable(data: Path) -> Path:
    """The folder, where there is what training needs."""
    pytest.importorskip("lightning_fabric", reason="training needs Lightning Fabric")
    pytest.importorskip("tensorboard", reason="training needs TensorBoard")
    return data


# idam train

FEW_STEPS = ("--epochs", 0.25, "--batch-size", 4, "--device", "cpu")


def test_train_passes_every_option_on(idam, trainable, tmp_path, monkeypatch):
    asked = {}

    def train(recipe: Recipe, data: Path, output: Path, **options: Any) -> Path:
        asked.update(recipe=recipe, data=data, output=output, **options)
        return Path("best")

    monkeypatch.setattr(training, "train", train)
    options = {"features": "fpfh", "epochs": 2.5, "batch-size": 8, "schedule": "one-cycle", "learning-rate": 0.002}
    options |= {"seed": 7, "device": "cpu", "precision": "bf16", "validate-every": 11, "data": trainable}
    words = [str(word) for name, value in options.items() for word in (f"--{name}", value)]
    words = ["train", "gaussian-noise", "--resume", "--fuse", *words, "--output", str(tmp_path / "a folder")]
    outcome = idam(*words)
    assert outcome.code == 0
    assert "best" in outcome.out
    recipe = asked.pop("recipe")
    assert recipe.config.features == "fpfh"
    changes = {"experiment": "gaussian-noise", "epochs": 2.5, "batch_size": 8, "schedule": "one-cycle", "seed": 7}
    assert recipe == Recipe(config=recipe.config, learning_rate=0.002, **changes)
    assert asked.pop("command") == f"idam {' '.join(words[:-1])} '{tmp_path / 'a folder'}'"
    assert asked == {
        "data": trainable,
        "output": tmp_path / "a folder",
        "resume": True,
        "device": "cpu",
        "precision": "bf16",
        "fuse": True,
        "validate_every": 11,
    }


def test_train_without_options_is_the_paper_s_recipe(idam, trainable, monkeypatch):
    asked = []
    monkeypatch.setattr(training, "train", lambda *args, **_: (asked.extend(args), Path("best"))[1])
    assert idam("train", "unseen-shapes", "--data", trainable).code == 0
    assert asked == [Recipe(), trainable, Path("runs/gnn-unseen-shapes")]


@pytest.mark.parametrize("features", ["gnn", "fpfh"])
def test_train_leaves_a_model_that_can_be_used(features, idam, trainable, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    outcome = idam("train", "unseen-shapes", "--data", trainable, "--features", features, *FEW_STEPS)
    folder = Path("runs") / f"{features}-unseen-shapes"
    assert outcome.code == 0
    assert str(folder / "best.safetensors") in outcome.out
    assert load_model(folder / "best.safetensors").config.features == features
    told = provenance(folder / "best.safetensors")
    assert told["command"].startswith("idam train unseen-shapes --data")
    assert told["steps"] == 1


def test_unseen_categories_are_not_trained_on(idam, trainable, tmp_path, monkeypatch):
    labels, split = [], task.split_validation
    monkeypatch.setattr(
        task, "split_validation", lambda shapes, *args: (labels.extend(shapes.labels), split(shapes, *args))[1]
    )
    assert idam("train", "unseen-categories", "--data", trainable, "-o", tmp_path / "run", *FEW_STEPS).code == 0
    assert len(labels) == 11
    assert max(labels) < 20


def test_train_resumes(idam, trainable, tmp_path):
    words = ("train", "unseen-shapes", "--data", trainable, "-o", tmp_path, *FEW_STEPS)
    assert idam(*words).code == 0
    before = (tmp_path / "last.ckpt").stat().st_mtime_ns
    assert idam(*words, "--resume").code == 0  # and finds nothing left to do
    assert (tmp_path / "last.ckpt").stat().st_mtime_ns == before
    assert_refused(idam(*words, "--resume", "--seed", 1), r"last\.ckpt: was trained with other options")


BAD_TRAININGS = {
    "an unknown experiment": (["--batch-size", 4], "unknown experiment 'nonsense'"),
    "an unknown schedule": (["--schedule", "cosine"], "unknown schedule"),
    "unknown features": (["--features", "sift"], "unknown features"),
    "an unknown device": (["--device", "abacus"], "unknown device"),
    "an unknown precision": (["--precision", "16"], "unknown precision"),
    "no epochs": (["--epochs", 0], "epochs"),
    "epochs in words": (["--epochs", "many"], "--epochs"),
    "a batch of one": (["--batch-size", 1], "at least 2 pairs"),
    "no validation": (["--validate-every", 0], "validate"),
    "an unknown option": (["--colour", "red"], "--colour"),
}


@pytest.mark.parametrize(("words", "message"), BAD_TRAININGS.values(), ids=BAD_TRAININGS)
def test_train_refuses_wrong_options_in_one_line(words, message, idam, trainable, tmp_path):
    experiment = "nonsense" if "experiment" in message else "unseen-shapes"
    outcome = idam("train", experiment, "--data", trainable, "-o", tmp_path / "run", *words)
    assert_refused(outcome, message)


def test_train_refuses_a_folder_without_modelnet40(idam, trainable, tmp_path):
    outcome = idam("train", "unseen-shapes", "--data", tmp_path, "-o", tmp_path / "run", *FEW_STEPS)
    assert_refused(outcome, "train_files")


def test_a_wrong_training_ends_its_process_with_code_2_and_one_line(trainable, tmp_path):
    outcome = process("train", "nonsense", "--data", trainable, "-o", tmp_path / "run", module=("idam",))
    assert_refused(outcome, "unknown experiment 'nonsense'")


# two processes

TORCHRUN = ("torch.distributed.run", "--nproc-per-node=2", "--rdzv-backend=c10d", "--rdzv-endpoint=127.0.0.1:0")
TORCHRUN = (*TORCHRUN, "--local-addr=127.0.0.1", "-m", "idam")


def on_averaged_gradients(recipe: Recipe, data: Path, steps: int) -> dict[str, torch.Tensor]:
    """Weights after some steps with the mean of the gradients that two processes see."""
    torch.manual_seed(recipe.seed)
    shapes, _ = split_validation(experiment_shapes(recipe.experiment, data, "train"), recipe)
    module = SupervisedStep(initial_model(recipe), recipe, "32")
    optimizer = torch.optim.Adam(module.parameters(), lr=recipe.learning_rate, weight_decay=recipe.weight_decay)
    for step in range(steps):
        for rank in range(2):
            (module(batch_at(shapes, recipe, step, rank, 2)).total / 2).backward()
        optimizer.step()
        optimizer.zero_grad()
    return dict(module.model.named_parameters())


@pytest.mark.skipif(not torch.distributed.is_available(), reason="this PyTorch has no distributed training")
@pytest.mark.skipif(sys.platform != "linux", reason="the loopback has another name")
@pytest.mark.usefixtures("one_thread")
def test_two_processes_train_one_model_on_the_mean_of_their_gradients(trainable, tmp_path):
    recipe = Recipe(epochs=0.4, batch_size=4)
    words = ("train", "unseen-shapes", "--data", trainable, "-o", tmp_path, "--epochs", 0.4, "--batch-size", 4)
    outcome = process(*words, "--device", "cpu", module=TORCHRUN)
    assert outcome.code == 0, outcome.err
    assert "Traceback" not in outcome.err
    files = sorted(path.name.split(".")[0] for path in tmp_path.iterdir())
    assert files == ["best", "events", "last"]  # one process writes
    assert outcome.out.count("step 2: ") == 1
    state = torch.load(tmp_path / "last.ckpt", weights_only=True)
    assert state["progress"]["step"] == 2
    for name, expected in on_averaged_gradients(recipe, trainable, 2).items():
        # Adam turns any gradient into a step of the rate, so that those that are nearly nothing differ by rounding
        difference = (state["model"][name] - expected).abs() / recipe.learning_rate
        assert difference.mean() < 0.05, name


# idam evaluate

FIGURES = ("rmse_r", "mae_r", "rmse_t", "mae_t", "recall", "angle", "distance")


@pytest.fixture
def pairs(randn, generator) -> Pairs:
    """Three pairs of small clouds."""
    clouds = (randn(3, count, 3, dtype=torch.float32) for count in (40, 50))
    rotation = torch.linalg.qr(randn(3, 3, 3, dtype=torch.float32)).Q
    return Pairs(*clouds, rotation * torch.linalg.det(rotation)[:, None, None], randn(3, 3, dtype=torch.float32))


@pytest.fixture
def file(tmp_path: Path, pairs: Pairs) -> Path:
    keys = ("source", "target", "R", "t")
    arrays = (getattr(pairs, field.name).numpy() for field in dataclasses.fields(Pairs))
    np.savez(tmp_path / "pairs.npz", **dict(zip(keys, arrays, strict=True)))
    return tmp_path / "pairs.npz"


def measured(pairs: Pairs, experiment: str = "unseen-shapes") -> dict[str, float]:
    """What the shipped network for an experiment does on pairs."""
    task = Task("gnn-idam", f"gnn-{experiment}")
    figures = run(task, TestSet("", pairs, ""), lambda: None).metrics.to_dict()
    return {name: pytest.approx(value, rel=1e-5) for name, value in figures.items()}


def test_anyone_s_pairs_are_measured_into_a_json_file(idam, file, pairs, tmp_path):
    words = ("evaluate", "--pairs", file, "--method", "gnn-idam", "--model", "gnn-unseen-shapes")
    outcome = idam(*words, "--json", tmp_path / "out.json")
    assert outcome.code == 0
    found = json.loads((tmp_path / "out.json").read_text())
    (row,) = found.pop("rows")
    about = {"pairs_from": str(file), "seed": experiments.TEST_SEED, "checksum": experiments.read_pairs(file).checksum}
    assert found.items() >= (row | about).items()
    assert found["command"].startswith("idam evaluate --pairs")
    assert found["machine"]["torch"] == torch.__version__
    assert {name: row[name] for name in FIGURES} == measured(pairs)
    assert row["method"] == "gnn-idam"
    assert row["model"] == "gnn-unseen-shapes"
    assert row["pairs"] == 3
    assert 0 < row["seconds_per_pair"] < 60
    for figure in (row["rmse_r"], row["mae_r"]):
        assert f"{figure:.3f}" in outcome.out


def test_every_method_asked_for_has_a_row(idam, file, tmp_path):
    outcome = idam(
        "evaluate",
        "--pairs",
        file,
        "--method",
        "register",
        "--method",
        "gnn-idam",
        "--limit",
        1,
        "--json",
        tmp_path / "out.json",
    )
    assert outcome.code == 0
    found = json.loads((tmp_path / "out.json").read_text())
    assert [row["method"] for row in found["rows"]] == ["register", "gnn-idam"]
    for row in found["rows"]:
        assert all(math.isfinite(row[name]) for name in FIGURES)
        assert row["method"] in outcome.out


@pytest.mark.parametrize("limit", [1, 2, 99])
def test_a_limit_takes_the_first_pairs(limit, idam, file, pairs, tmp_path):
    idam("evaluate", "--pairs", file, "--method", "gnn-idam", "--limit", limit, "--json", tmp_path / "out.json")
    found = json.loads((tmp_path / "out.json").read_text())
    assert found["pairs"] == min(limit, 3)
    assert {name: found[name] for name in FIGURES} == measured(pairs[:limit])


@pytest.mark.parametrize(("experiment", "count"), [("unseen-shapes", 5), ("unseen-categories", 2)])
def test_an_experiment_is_measured_on_its_test_pairs(experiment, count, idam, data, tmp_path):
    words = ("evaluate", experiment, "--data", data, "--method", "gnn-idam", "--json", tmp_path / "out.json")
    assert idam(*words).code == 0
    found = json.loads((tmp_path / "out.json").read_text())
    assert found["pairs_from"] == experiment
    assert found["pairs"] == count
    assert {name: found[name] for name in FIGURES} == measured(experiments.test_set(experiment, data).pairs, experiment)


def test_one_s_own_method_and_bounds(idam, file, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("my_method.py").write_text("import numpy as np\ndef align(source, target):\n    return np.eye(4)\n")
    words = ("evaluate", "--pairs", file, "--method", "my_method:align", "--within", 180, 100, "--json", "out.json")
    outcome = idam(*words)
    assert outcome.code == 0
    found = json.loads(Path("out.json").read_text())
    assert (found["method"], found["recall"], found["recall_within"]) == ("my_method:align", 1.0, [180, 100])
    assert "align" in outcome.out


def not_pairs(path: Path) -> None:
    path.write_text("0 0 0\n")


def too_small(path: Path) -> None:
    np.savez(path, source=np.zeros((1, 4, 3)), target=np.zeros((1, 4, 3)), R=np.eye(3)[None], t=np.zeros((1, 3)))


BAD_EVALUATIONS = {
    "nothing to measure on": (["evaluate"], "--pairs"),
    "two things to measure on": (["evaluate", "unseen-shapes", "--pairs", "FILE"], "either"),
    "an experiment without data": (["evaluate", "unseen-shapes"], "--data"),
    "an unknown experiment": (["evaluate", "nonsense", "--data", "DATA"], "unknown experiment 'nonsense'"),
    "a missing folder": (["evaluate", "unseen-shapes", "--data", "nowhere"], "nowhere"),
    "a missing file": (["evaluate", "--pairs", "nowhere.npz"], "nowhere.npz"),
    "an unknown method": (["evaluate", "--pairs", "FILE", "--method", "sift"], "unknown method 'sift'"),
    "an unknown model": (["evaluate", "--pairs", "FILE", "--method", "gnn-idam", "--model", "sift"], "unknown model"),
    "no pairs": (["evaluate", "--pairs", "FILE", "--method", "gnn-idam", "--limit", 0], "limit"),
    "a negative limit": (["evaluate", "--pairs", "FILE", "--method", "gnn-idam", "--limit", -1], "limit"),
    "a model that is no network of the paper": (
        ["evaluate", "--pairs", "FILE", "--method", "gnn-idam", "--model", "general"],
        "general",
    ),
    "bounds of an experiment": (["evaluate", "unseen-shapes", "--data", "DATA", "--within", 1, 1], "--within"),
    "one bound": (["evaluate", "--pairs", "FILE", "--within", 1], "--within"),
    "a method that is nowhere": (["evaluate", "--pairs", "FILE", "--method", "nowhere:align"], "nowhere:align"),
    "an output that cannot be": (["evaluate", "--pairs", "FILE", "--method", "gnn-idam", "--json", "no/x"], "no/x"),
}


@pytest.mark.parametrize(("words", "message"), BAD_EVALUATIONS.values(), ids=BAD_EVALUATIONS)
def test_evaluate_refuses_wrong_options_in_one_line(words, message, idam, file, data, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert_refused(idam(*({"FILE": file, "DATA": data}.get(word, word) for word in words)), message)


@pytest.mark.parametrize(("spoil", "message"), [(not_pairs, "cannot be read"), (too_small, "points")])
def test_evaluate_refuses_a_file_it_cannot_use_in_one_line(spoil, message, idam, file):
    spoil(file)
    assert_refused(idam("evaluate", "--pairs", file, "--method", "gnn-idam"), message)


def test_a_wrong_evaluation_ends_its_process_with_code_2_and_one_line(tmp_path):
    outcome = process("evaluate", "--pairs", tmp_path / "no.npz", module=("idam",))
    assert_refused(outcome, r"no\.npz: no such file")


# idam data and idam figures


def test_a_folder_that_holds_modelnet40_is_checked(idam, trainable):
    outcome = idam("data", "modelnet40", trainable)
    assert outcome.code == 0
    assert outcome.out == f"ModelNet40 is in {trainable}\n"


def test_modelnet40_is_fetched_from_an_archive(idam, trainable, tmp_path):
    archive = tmp_path / "copy.zip"
    with zipfile.ZipFile(archive, "w") as packed:
        for file in (path for path in trainable.rglob("*") if path.is_file()):
            packed.write(file, f"modelnet40_ply_hdf5_2048/{file.name}")
    wrong = idam("data", "modelnet40", tmp_path / "new", "--url", archive.as_uri(), "--sha256", "0" * 64)
    assert_refused(wrong, "checksum|SHA-256")
    assert idam("data", "modelnet40", tmp_path / "new", "--url", archive.as_uri()).code == 0
    assert len(experiment_shapes("unseen-shapes", tmp_path / "new", "test")) == len(
        experiment_shapes("unseen-shapes", trainable, "test")
    )


def test_an_address_that_is_none_is_refused_in_one_line(idam, tmp_path):
    assert_refused(idam("data", "modelnet40", tmp_path / "new", "--url", "nonsense"), "http")
    assert not (tmp_path / "new").exists()


def test_figures_are_drawn_with_the_options_given(idam, trainable, tmp_path, monkeypatch):
    figures = pytest.importorskip("idam.lab.figures", reason="figures need Matplotlib")
    asked = []
    monkeypatch.setattr(
        figures, "draw_figures", lambda *args, **options: (asked.append((args, options)), [Path("a")])[1]
    )
    words = ["figures", tmp_path, "--data", trainable, "--scan", "a.ply", "--scan", "b.ply", "--speed", "s.json"]
    outcome = idam(*words, "--model", "mine")
    assert (outcome.code, outcome.out) == (0, "a\n")
    ((args, options),) = asked
    assert args == (tmp_path, trainable)
    assert options.pop("progress") is tell
    assert options == {"scans": [Path("a.ply"), Path("b.ply")], "speed": Path("s.json"), "model": "mine"}


def test_figures_refuse_an_odd_number_of_scans(idam, trainable, tmp_path):
    outcome = idam("figures", tmp_path / "out", "--data", trainable, "--scan", "a.ply")
    assert_refused(outcome, "scan|pip install")


# idam models


@pytest.mark.parametrize("columns", [40, 80, 300])
def test_models_shows_every_model_and_where_it_comes_from_at_any_width(columns, idam, monkeypatch):
    monkeypatch.setenv("COLUMNS", str(columns))
    outcome = idam("models", "-v")
    assert outcome.code == 0
    for name in list_models():
        told = provenance(name)
        assert name in outcome.out
        for shown in (told["experiment"], told["steps"], told["recipe"]["seed"], told["commit"], told["command"]):
            assert str(shown) in outcome.out
        shown = told["validation"].keys() & {"rmse_r", "mae_r", "matching", "accuracy"}
        assert len(shown) == 2
        for score in shown:
            assert f"{told['validation'][score]:.3f}" in outcome.out


def test_models_shows_how_well_features_match_where_that_is_what_was_validated(idam, monkeypatch):
    scores = {"matching": 2.34567, "accuracy": 0.41234}
    told = {"config": {"features": "invariant", "iterations": 1}, "experiment": "general", "validation": scores}
    monkeypatch.setattr(weights, "list_models", lambda: ["mine"])
    monkeypatch.setattr(weights, "provenance", lambda _: told)
    outcome = idam("models")
    assert outcome.code == 0
    assert "accuracy 0.412, matching loss 2.346" in outcome.out
    assert "nan" not in outcome.out
    assert "RMSE(R)" not in outcome.out
