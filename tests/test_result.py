"""What a registration returns, and the package around it."""

from __future__ import annotations

import json
from dataclasses import asdict, fields, replace
from importlib import metadata, resources
from pathlib import Path

import numpy as np
import pytest

import idam
from answers import EVIDENCE, STRENGTH, made_up
from idam import RegistrationResult
from idam.errors import InputError
from idam.io import read_transform
from idam.result import Hypothesis, Matches
from motions import rigid
from solids import distances

SOURCE = np.random.default_rng(0).normal(size=(50, 3))


@pytest.fixture
def result() -> RegistrationResult:
    transformation = rigid([0.1, -2.0, 0.7], [5e5, -5.6e6, 1 / 3])
    target = SOURCE @ transformation[:3, :3].T + transformation[:3, 3]
    return made_up(
        SOURCE,
        target[20:],
        transformation,
        hypotheses=[Hypothesis(np.diag([-1.0, -1, 1, 1]), 0.4), Hypothesis(np.diag([1.0, -1, -1, 1]), 0.3)],
        information=np.diag(np.arange(1.0, 7.0)),
        matches=Matches(np.zeros((4, 3)), np.ones((4, 3)), np.full(4, 0.25)),
    )


@pytest.mark.parametrize("shape", [(3,), (7, 3), (2, 5, 3), (0, 3)])
def test_apply_moves_points_of_any_batch_shape(result: RegistrationResult, shape: tuple[int, ...]) -> None:
    points = np.random.default_rng(0).normal(size=shape)
    moved = result.apply(points)
    assert moved.dtype == np.float64
    homogeneous = np.concatenate([points, np.ones((*shape[:-1], 1))], -1)
    np.testing.assert_allclose(moved, np.einsum("ij,...j->...i", result.transformation, homogeneous)[..., :3])
    np.testing.assert_array_equal(result.apply(points.tolist()) if points.size else moved, moved)


def test_to_dict_is_ready_for_json(result: RegistrationResult) -> None:
    content = json.loads(json.dumps(result.to_dict(), allow_nan=False))
    assert content["transformation"] == result.transformation.tolist()
    assert content["information"] == result.information.tolist()
    assert content["evidence"] == asdict(EVIDENCE)
    assert content["strength"] == {"motions": STRENGTH.motions.tolist(), "fixed": STRENGTH.fixed.tolist()}
    assert content["hypotheses"] == [
        {"transformation": np.diag([-1.0, -1, 1, 1]).tolist(), "score": 0.4},
        {"transformation": np.diag([1.0, -1, -1, 1]).tolist(), "score": 0.3},
    ]
    alike = ("fitness", "inlier_rmse", "confidence", "converged", "reason", "max_correspondence_distance", "model")
    assert {name: content[name] for name in (*alike, "seconds")} == {
        name: getattr(result, name) for name in (*alike, "seconds")
    }


def test_to_dict_names_every_field_but_the_large_ones(result: RegistrationResult) -> None:
    names = {field.name for field in fields(result)} - {"clouds", "matches"}
    assert names <= set(result.to_dict())


@pytest.mark.parametrize("name", ["T.json", "T.txt", "T.TXT", "T.JSON"])
def test_save_and_read_back_to_the_bit(result: RegistrationResult, tmp_path: Path, name: str) -> None:
    result.save(tmp_path / name)
    result.save(str(tmp_path / name))
    np.testing.assert_array_equal(read_transform(tmp_path / name), result.transformation)
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_saved_json_holds_every_field(result: RegistrationResult, tmp_path: Path) -> None:
    result.save(tmp_path / "T.json")
    assert json.loads((tmp_path / "T.json").read_text()) == result.to_dict()


def test_saved_text_is_the_matrix_alone(result: RegistrationResult, tmp_path: Path) -> None:
    result.save(tmp_path / "T.txt")
    np.testing.assert_array_equal(np.loadtxt(tmp_path / "T.txt"), result.transformation)


@pytest.mark.parametrize("name", ["missing/T.json", "missing/T.txt", "."])
def test_save_where_nothing_can_be_written(result: RegistrationResult, tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError) as error:
        result.save(tmp_path / name)
    assert "\n" not in str(error.value)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["T.npy", "T", "T.json.gz", "T.ply"])
def test_save_refuses_other_endings(result: RegistrationResult, tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match=r"unknown ending .*\.json for the whole result, \.txt for the 4x4"):
        result.save(tmp_path / name)
    assert list(tmp_path.iterdir()) == []


# --- what is worked out --------------------------------------------------------------------------------------------


def test_rotation_and_translation_are_those_of_the_transformation(result: RegistrationResult) -> None:
    np.testing.assert_array_equal(result.rotation, result.transformation[:3, :3])
    np.testing.assert_array_equal(result.translation, result.transformation[:3, 3])


def test_correspondences_are_those_of_brute_force_and_worked_out_once(result: RegistrationResult) -> None:
    source, target = result.clouds
    distance = distances(result.apply(source), target)
    rows = np.flatnonzero(distance.min(1) <= result.max_correspondence_distance)
    np.testing.assert_array_equal(result.correspondence_set, np.stack([rows, distance.argmin(1)[rows]], 1))
    assert 30 <= len(rows) < 50
    assert result.correspondence_set is result.correspondence_set


def test_measured_anew_at_another_distance(result: RegistrationResult) -> None:
    measured = result.measured(2.0)
    distance = distances(result.apply(result.clouds[0]), result.clouds[1]).min(1)
    inliers = distance[distance <= 2.0]
    assert measured.max_correspondence_distance == 2.0
    assert measured.fitness == len(inliers) / 50
    assert measured.inlier_rmse == pytest.approx(np.sqrt(np.mean(inliers**2)))
    assert len(measured.correspondence_set) == len(inliers)
    nothing = replace(result, transformation=np.eye(4)).measured(1.0)
    assert (nothing.fitness, nothing.inlier_rmse, len(nothing.correspondence_set)) == (0.0, 0.0, 0)
    # and the first is as it was
    assert (result.fitness, result.max_correspondence_distance) == (0.75, 0.05)


def test_covariance_is_the_inverse_of_the_information(result: RegistrationResult) -> None:
    np.testing.assert_allclose(result.covariance, np.diag(1 / np.arange(1.0, 7.0)), rtol=1e-12, atol=1e-15)
    unknown = replace(result, information=np.zeros((6, 6))).covariance
    assert np.isinf(np.diag(unknown)).all()


def test_results_can_be_compared(result: RegistrationResult) -> None:
    assert result == result  # arrays of it have no one truth
    assert result != replace(result)
    assert result != "something else"
    assert result in [replace(result), result]


def test_repr_says_the_essential_in_a_few_lines(result: RegistrationResult) -> None:
    text = repr(result)
    assert len(text.splitlines()) <= 4
    assert max(map(len, text.splitlines())) <= 120
    for word in ("rotation 121.", "moves 5.622e+06", "confidence 90 %", "fitness 0.750", "RMSE 0.01"):
        assert word in text
    doubted = repr(replace(result, confidence=0.001, converged=False, reason="overlap about 3 %"))
    assert "confidence < 1 %: overlap about 3 %" in doubted
    assert "confidence > 99 %" in repr(replace(result, confidence=0.9999))


def test_html_escapes_what_the_text_holds(result: RegistrationResult) -> None:
    doubted = replace(result, confidence=0.0, reason="a <b> & c")._repr_html_()
    assert "&lt; 1 %" in doubted
    assert "a &lt;b&gt; &amp; c" in doubted


# --- the package ---------------------------------------------------------------------------------------------------


def test_every_public_name_resolves() -> None:
    assert {"register", "prepare", "list_models", "load_model", "RegistrationResult"} <= set(idam.__all__)
    for name in set(idam.__all__) - {"load_model"}:  # which needs torch
        assert getattr(idam, name).__name__ == name
        assert name in dir(idam)
    with pytest.raises(AttributeError, match="nonsense"):
        _ = idam.nonsense


def test_version_is_that_of_the_installed_package() -> None:
    assert idam.__version__ == metadata.version("idam")


def test_package_is_typed_and_holds_its_models() -> None:
    assert (resources.files("idam") / "py.typed").is_file()
    assert {"general", "practice-any-rotation", "gnn-unseen-shapes"} <= set(idam.list_models())
