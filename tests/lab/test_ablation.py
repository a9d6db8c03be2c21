"""benchmarks/ablation.py: four networks with equal budgets, which the evaluation finds."""

import importlib
from types import ModuleType

import numpy as np
import pytest

from idam.lab.evaluation.methods import ABLATION, build_method
from idam.lab.evaluation.methods.network import find_ablation_weights
from idam.lab.training import loop
from idam.network.pretrained import load_model
from idam.weights import provenance


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    for package in ("lightning_fabric", "tensorboard", "h5py"):
        pytest.importorskip(package, reason=f"training needs {package}")
    monkeypatch.setattr(loop, "keep_freed_memory", lambda: True)  # it would hold for all tests after this one
    return importlib.import_module("benchmarks.ablation")


@pytest.fixture
def data(tmp_path):
    import h5py

    rng = np.random.default_rng(0)
    folder = tmp_path / "data"
    folder.mkdir()
    with h5py.File(folder / "train0.h5", "w") as file:
        file["data"] = rng.uniform(-1, 1, (8, 1024, 3)).astype(np.float32)
        file["label"] = np.arange(8, dtype=np.uint8)[:, None]
    (folder / "train_files.txt").write_text("train0.h5\n")
    return folder


def test_four_networks_are_trained_alike_but_for_their_parts(script, data, tmp_path, capsys):
    folder = tmp_path / "ablation"
    words = [str(folder), "--data", str(data), "--epochs", "0.5", "--batch-size", "2", "--device", "cpu"]
    script.main(words)
    told = []
    for method in ABLATION:
        path = find_ablation_weights(method, str(folder))
        told.append(provenance(path))
        assert build_method(method, path)(*np.random.default_rng(0).random((2, 40, 3), np.float32)).shape == (4, 4)
    parts = [
        tuple(
            getattr(load_model(find_ablation_weights(method, str(folder))).config, part)
            for part in ("convolution", "hard_elimination", "hybrid_elimination")
        )
        for method in ABLATION
    ]
    assert parts == [(False, False, False), (True, False, False), (True, True, False), (True, True, True)]
    assert len({(one["steps"], one["recipe"]["epochs"], one["command"]) for one in told}) == 1
    script.main(words)  # goes on, and finds nothing left to do
    with pytest.raises(SystemExit):
        script.main([*words, "--precision", "32", "--batch-size", "1"])
    assert "batch" in capsys.readouterr().err


def test_all_four_can_begin_with_the_features_of_one_model(script, tmp_path):
    trained = load_model("gnn-unseen-categories")
    for method in ABLATION:
        folder = tmp_path / method
        folder.mkdir()
        network = load_model(script.begin_with_features("gnn-unseen-categories", method, folder))
        assert network.config == script.CONFIGS[method]
        for name, value in trained.features.state_dict().items():
            assert network.features.state_dict()[name].equal(value)
        for name, value in network.similarity.state_dict().items():
            if name.endswith("linear.weight"):
                assert not trained.similarity.state_dict()[name].equal(value)
