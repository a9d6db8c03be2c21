"""Model files: written whole or not at all, read back to the bit, refused with a reason."""

import os
import stat
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from idam import weights
from idam.errors import InputError
from idam.network.config import Config
from idam.network.model import IDAM
from idam.network.pretrained import load_model, save_model
from idam.weights import list_models, provenance, read_weights

CONFIG = Config(neighbours=5, channels=8, blocks=2, iterations=4, keep=0.3, soft_matches=True)
HISTORY = {"experiment": "unseen-shapes", "steps": 1000, "validation": {"mae_r": 0.1}}


@pytest.fixture
def model(seasoned) -> IDAM:
    return seasoned(IDAM(CONFIG), torch.float32)


@pytest.fixture
def path(tmp_path: Path, model: IDAM) -> Path:
    path = tmp_path / "small.safetensors"
    save_model(path, model, HISTORY)
    return path


@pytest.fixture
def shipped(path: Path, model: IDAM, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of shipped models with two in it."""
    save_model(path.with_name("another.safetensors"), model, {})
    path.with_name("notes.txt").touch()
    monkeypatch.setattr(weights, "FOLDER", path.parent)
    monkeypatch.setattr(weights, "DEFAULT", "small")
    return path.parent


def test_a_saved_model_comes_back_to_the_bit(path, model, randn):
    loaded = load_model(path)
    assert loaded.config == CONFIG
    assert loaded.state_dict().keys() == model.state_dict().keys()
    assert all(torch.equal(loaded.state_dict()[name], value) for name, value in model.state_dict().items())
    clouds = randn(1, 30, 3, dtype=torch.float32), randn(1, 40, 3, dtype=torch.float32)
    with torch.inference_mode():
        assert torch.equal(loaded(*clouds).rotation, model(*clouds).rotation)


def test_a_loaded_model_is_ready_for_use(path):
    loaded = load_model(str(path), device="cpu")
    assert not any(module.training for module in loaded.modules())
    assert not any(p.requires_grad for p in loaded.parameters())


def test_a_loaded_model_learns_only_where_it_is_to(path):
    assert not any(parameter.requires_grad for parameter in load_model(path).parameters())
    assert all(parameter.requires_grad for parameter in load_model(path, trainable=True).parameters())


def test_loading_leaves_the_random_state_alone(path):
    before = torch.get_rng_state()
    load_model(path)
    assert torch.equal(torch.get_rng_state(), before)


@pytest.mark.parametrize("name", ["general", "gnn-unseen-shapes", "fpfh-unseen-shapes"])
def test_the_default_dtype_does_not_matter(name, randn):
    clouds = randn(1, 100, 3, dtype=torch.float32), randn(1, 90, 3, dtype=torch.float32)
    expected = load_model(name)(*clouds).rotation
    torch.set_default_dtype(torch.float64)
    try:
        found = load_model(name)(*clouds).rotation
    finally:
        torch.set_default_dtype(torch.float32)
    assert torch.equal(found, expected)


def test_weights_without_effect_are_saved_as_zeros(path, model):
    weight = model.validity[0].mlp[1].weight
    with torch.no_grad():
        weight[0, :3] = torch.tensor([1e-40, -1e-13, 1e-6])
    save_model(path, model, {})
    saved = read_weights(path)[1]["validity.0.mlp.1.weight"]
    assert saved[0, :3].tolist() == [0, 0, np.float32(1e-6)]
    assert saved[0, 3:].tolist() == weight[0, 3:].tolist()


def test_the_provenance_tells_the_history_and_the_configuration(path):
    told = provenance(path)
    assert Config(**told.pop("config")) == CONFIG
    assert told == HISTORY


def test_saving_leaves_one_file(path):
    assert os.listdir(path.parent) == [path.name]  # noqa: PTH208 - only names are of interest


def test_saving_again_replaces_the_model(path, model):
    save_model(path, model, {"steps": 2000})
    assert provenance(path)["steps"] == 2000
    assert list(path.parent.iterdir()) == [path]


def test_a_save_that_fails_leaves_the_old_model_and_nothing_else(path, model, monkeypatch):
    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    before = path.read_bytes()
    monkeypatch.setattr(Path, "replace", fail)
    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(InputError, match="No space left"):
        save_model(path, model, {"steps": 2000})
    assert path.read_bytes() == before
    assert list(path.parent.iterdir()) == [path]


def test_a_model_file_is_as_readable_as_any_other_file(path):
    other = path.with_name("other")
    other.touch()
    assert stat.S_IMODE(path.stat().st_mode) == stat.S_IMODE(other.stat().st_mode)


def test_saving_into_a_missing_folder_says_so(tmp_path, model):
    with pytest.raises(InputError, match=r"there is no folder .*nowhere"):
        save_model(tmp_path / "nowhere" / "small.safetensors", model, {})


def test_models_are_listed_and_loaded_by_name(shipped):
    assert list_models() == ["another", "small"]
    assert load_model("another").config == CONFIG
    assert provenance("default")["steps"] == 1000
    assert load_model().config == CONFIG


@pytest.mark.parametrize("name", ["sift", "sift.safetensors", "", "../small"])
def test_an_unknown_name_is_answered_with_the_known_ones(name, shipped):
    for ask in (load_model, provenance):
        with pytest.raises(InputError, match=r"unknown model .*default, another, small"):
            ask(name)


def cut_short(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-100])


def without_metadata(path: Path) -> None:
    save_file({"x": torch.zeros(2)}, path)


def with_metadata(config: str):
    return lambda path: save_file({"x": torch.zeros(2)}, path, {"config": config})


SPOILED = {
    "no safetensors": lambda path: path.write_bytes(b"not a model at all"),
    "empty": lambda path: path.write_bytes(b""),
    "cut short": cut_short,
    "no metadata": without_metadata,
    "no configuration": with_metadata("nonsense"),
}
OF_ANOTHER_MODEL = {
    "a list for a configuration": with_metadata("[1, 2]"),
    "other weights": with_metadata("{}"),
    "an unknown setting": with_metadata('{"colour": "red"}'),
    "unknown features": with_metadata('{"features": "sift"}'),
}


@pytest.mark.parametrize("spoil", (SPOILED | OF_ANOTHER_MODEL).values(), ids=SPOILED | OF_ANOTHER_MODEL)
def test_a_file_that_is_no_model_is_refused_with_a_reason(spoil, shipped):
    spoil(shipped / "small.safetensors")
    with pytest.raises(InputError, match=r"small\.safetensors: not a model .*default, another, small") as caught:
        load_model("small")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("spoil", SPOILED.values(), ids=SPOILED)
def test_a_file_that_is_no_model_has_no_provenance(spoil, shipped):
    spoil(shipped / "small.safetensors")
    with pytest.raises(InputError, match=r"small\.safetensors"):
        provenance("small")


@pytest.mark.parametrize("name", list_models())
def test_every_shipped_model_loads_and_says_where_it_comes_from(name):
    assert sum(p.numel() for p in load_model(name).parameters()) > 0
    assert {"config", "experiment", "command", "recipe", "steps", "validation"} <= provenance(name).keys()
