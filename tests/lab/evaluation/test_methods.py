"""The rows of the tables by name, and the rows of the network."""

from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from idam.errors import InputError
from idam.lab.evaluation.methods import METHODS, build_method, network, pipeline
from idam.network.config import Config
from idam.network.model import IDAM
from idam.network.pretrained import load_model, save_model

NETWORKS = {"gnn-idam": "gnn", "fpfh-idam": "fpfh"}


@pytest.fixture
def model(seasoned) -> IDAM:
    return seasoned(IDAM(Config(neighbours=5, channels=8, keep=1 / 2)), torch.float32)


@pytest.fixture
def weights(tmp_path: Path, model: IDAM) -> str:
    path = tmp_path / "small.safetensors"
    save_model(path, model, {})
    return str(path)


@pytest.fixture
def clouds() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    return tuple(rng.standard_normal((count, 3)).astype(np.float32) for count in (40, 50))


@pytest.mark.parametrize("name", ["gnn_idam", "", "GNN-IDAM", "sift"])
def test_an_unknown_method_is_answered_with_the_known_ones(name):
    with pytest.raises(InputError) as caught:
        build_method(name)
    assert repr(name) in str(caught.value)
    assert ", ".join(METHODS) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("place", [place for place, _ in METHODS.values()], ids=METHODS)
def test_every_name_leads_to_a_function(place):
    module, function = place.split(":")
    assert callable(getattr(import_module(f"idam.lab.evaluation.methods.{module}"), function))


def test_the_network_s_own_rows_and_the_whole_of_register_are_there():
    assert {*NETWORKS, "register"} <= METHODS.keys()


def test_the_network_s_row_is_its_output_as_one_matrix(model, weights, clouds):
    found = build_method("gnn-idam", weights)(*clouds)
    output = model(*(torch.from_numpy(cloud)[None] for cloud in clouds))
    assert found.shape == (4, 4)
    assert found.dtype == np.float64
    np.testing.assert_allclose(found[:3, :3], output.rotation[0].detach(), atol=1e-6)
    np.testing.assert_allclose(found[:3, 3], output.translation[0].detach(), atol=1e-6)
    np.testing.assert_array_equal(found[3], [0, 0, 0, 1])


def test_the_weights_are_read_once_and_not_for_every_pair(weights, clouds):
    method = build_method("gnn-idam", weights)
    Path(weights).unlink()
    np.testing.assert_array_equal(method(*clouds), method(*clouds))


@pytest.mark.parametrize("name", NETWORKS)
def test_without_a_model_the_network_has_the_weights_for_unseen_shapes(name, monkeypatch):
    asked = []
    monkeypatch.setattr(network, "load_model", lambda model, _: (asked.append(model), IDAM(Config(NETWORKS[name])))[1])
    build_method(name)
    build_method(name, "another")
    assert asked == [f"{NETWORKS[name]}-unseen-shapes", "another"]


def test_clouds_too_small_for_the_network_are_refused(weights, clouds):
    with pytest.raises(InputError, match="5 points"):
        build_method("gnn-idam", weights)(clouds[0][:5], clouds[1])


@pytest.mark.parametrize("name", NETWORKS)
def test_an_unknown_model_is_refused_before_any_pair(name):
    with pytest.raises(InputError, match="unknown model 'sift'"):
        build_method(name, "sift")


@pytest.mark.parametrize(("model", "expected"), [(None, "default"), ("another", "another")])
@pytest.mark.parametrize(("row", "angle"), [("register", 180), ("register-90", 90)])
def test_register_s_rows_set_nothing_but_the_model_and_the_largest_angle(
    row, angle, model, expected, clouds, monkeypatch
):
    calls, answer = [], np.diag([1.0, -1.0, -1.0, 1.0])

    def register(*args: object, **options: object) -> SimpleNamespace:
        calls.append((args, options))
        return SimpleNamespace(transformation=answer)

    monkeypatch.setattr(pipeline, "register", register)
    assert build_method(row, model)(*clouds) is answer
    ((args, options),) = calls
    assert [a is b for a, b in zip(args, clouds, strict=True)] == [True, True]
    assert options == {"model": expected, "max_angle": angle}


def test_the_paper_s_inference_is_a_row_whatever_the_model_s_own(tmp_path, seasoned, clouds, monkeypatch):
    used = []
    config = Config(neighbours=5, channels=8, keep=1 / 2, iterations=7, keep_again=(1.0,), soft_matches=True)
    save_model(tmp_path / "own.safetensors", seasoned(IDAM(config), torch.float32), {})
    monkeypatch.setattr(network, "load_model", lambda *given: (used.append(load_model(*given)), used[-1])[1])
    build_method("gnn-idam-paper", str(tmp_path / "own.safetensors"))
    paper = Config(neighbours=5, channels=8)
    assert used[0].config == paper
    assert (paper.iterations, paper.keep, paper.keep_again, paper.soft_matches) == (3, 1 / 6, (), False)


@pytest.mark.parametrize("setting", ["convolution=false", "neighbours=5", "features=fpfh", "channels=8"])
def test_settings_that_would_change_nothing_of_a_trained_network_are_refused(setting, weights):
    with pytest.raises(InputError, match=f"'{setting}': give NAME=VALUE with one of iterations, keep"):
        build_method("gnn-idam", weights, [setting])


@pytest.mark.parametrize(("name", "model"), [("gnn-idam", "fpfh-unseen-shapes"), ("fpfh-idam", "gnn-unseen-shapes")])
def test_a_model_of_other_features_is_refused(name, model):
    with pytest.raises(InputError, match=rf"{model} has \w+ features.*--model.*--method register"):
        build_method(name, model)


def test_the_register_row_takes_no_other_settings():
    with pytest.raises(InputError, match="voxel_size=1"):
        build_method("register", None, ["voxel_size=1"])


def test_only_the_network_s_rows_have_weights_of_their_own():
    assert network.weights_for("gnn-idam", "unseen-shapes") == "gnn-unseen-shapes"
    assert network.weights_for("gnn-idam", "no such experiment") is None
    assert network.weights_for("icp", "unseen-shapes") is None
    assert network.weights_for("register", "unseen-shapes") is None


def test_the_paper_s_rows_prefer_weights_trained_for_its_inference(monkeypatch):
    monkeypatch.setattr(network, "list_models", lambda: ["gnn-a", "gnn-a-paper", "gnn-b"])
    assert network.weights_for("gnn-idam-paper", "a") == "gnn-a-paper"
    assert network.weights_for("gnn-idam-paper", "b") == "gnn-b"
    assert network.weights_for("gnn-idam", "a") == "gnn-a"


def test_icp_after_the_network_brings_copies_of_a_cloud_together(weights):
    source = np.random.default_rng(0).standard_normal((200, 3)).astype(np.float32)
    found = build_method("gnn-idam-icp", weights)(source, source)
    np.testing.assert_allclose(found[:3, :3] @ found[:3, :3].T, np.eye(3), atol=1e-6)
    alone = build_method("gnn-idam", weights)(source, source)

    def miss(transform: np.ndarray) -> float:
        moved = source @ transform[:3, :3].T + transform[:3, 3]
        return float(np.linalg.norm(moved[:, None] - source, axis=-1).min(1).mean())

    assert miss(found) <= miss(alone)
