"""The shipped files: every one readable without torch, without denormal numbers, read again where it has changed."""

import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save_file

from idam.describe.invariant import surroundings
from idam.errors import InputError
from idam.weights import find, list_models, load_descriptor, provenance, read_weights, without_denormals
from shapes import blob

DESCRIPTORS = [name for name in list_models() if provenance(name)["config"]["features"] == "invariant"]


@pytest.mark.parametrize("name", list_models())
def test_no_shipped_weight_is_denormal(name: str) -> None:
    for key, value in read_weights(find(name))[1].items():
        assert np.isfinite(value).all(), key
        assert not ((value != 0) & (np.abs(value) < 1e-12)).any(), key


def test_only_weights_without_effect_become_zero() -> None:
    weights = {"a": np.array([1e-40, -1e-13, 1e-11, -1.0, 0.0], np.float32), "count": np.array(3)}
    found = without_denormals(weights)
    assert found["a"].tolist() == np.array([0, 0, 1e-11, -1.0, 0], np.float32).tolist()
    assert found["a"].dtype == np.float32
    assert found["count"] == 3
    assert found["count"].dtype == weights["count"].dtype


def test_the_default_is_a_descriptor() -> None:
    assert "general" in DESCRIPTORS
    assert load_descriptor("default") is load_descriptor("general")


@pytest.mark.parametrize("name", sorted(set(list_models()) - set(DESCRIPTORS)))
def test_features_that_turn_with_the_cloud_are_no_descriptor(name: str) -> None:
    with pytest.raises(InputError, match="name a model such as general"):
        load_descriptor(name)


def test_a_file_that_has_changed_is_read_again(tmp_path: Path) -> None:
    path, around = tmp_path / "mine.safetensors", surroundings(blob(100))
    shutil.copy(find("general"), path)
    before = load_descriptor(path)
    assert load_descriptor(str(path)) is before
    shutil.copy(find("practice-any-rotation"), path)
    os.utime(path, ns=(1, 1))  # whatever the clock's resolution
    after = load_descriptor(path).describe(around)
    np.testing.assert_array_equal(after, load_descriptor("practice-any-rotation").describe(around))
    assert not np.allclose(after, before.describe(around))


@pytest.mark.parametrize(
    ("weights", "config"),
    [
        ({"features.length": np.ones(1)}, '{"features": "invariant"}'),
        ({"x": np.ones(2)}, "nonsense"),
        ({"x": np.ones(2)}, "[1, 2]"),
        ({"x": np.ones(2)}, None),
    ],
)
def test_a_file_that_is_no_model_is_refused_with_a_reason(
    weights: dict[str, np.ndarray], config: str | None, tmp_path: Path
) -> None:
    path = tmp_path / "mine.safetensors"
    save_file(weights, path, None if config is None else {"config": config})
    with pytest.raises(InputError, match=r"mine\.safetensors: not a model .*default, ") as caught:
        load_descriptor(path)
    assert "\n" not in str(caught.value)


def test_an_unknown_name_is_answered_with_the_known_ones() -> None:
    with pytest.raises(InputError, match=r"unknown model 'sift': use one of default, .*general"):
        load_descriptor("sift")
