"""What a registration returns, and the package around it."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import fields, replace
from importlib import metadata, resources
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import idam
from idam import RegistrationResult
from idam.errors import InputError
from idam.io import read_transform
from idam.result import Hypothesis, Matches
from idam.search.confidence import Evidence

SLOW = {"torch", "scipy", "small_gicp", "trimesh"}


@pytest.fixture
def result() -> RegistrationResult:
    transformation = np.eye(4)
    transformation[:3, :3] = Rotation.from_rotvec([0.1, -2.0, 0.7]).as_matrix()
    transformation[:3, 3] = [5e5, -5.6e6, 1 / 3]
    return RegistrationResult(
        transformation=transformation,
        fitness=0.75,
        inlier_rmse=0.01,
        correspondence_set=np.array([[0, 2], [1, 1], [5, 0]]),
        confidence=0.9,
        converged=True,
        reason="",
        evidence=Evidence(overlap=0.6, support=0.8, likelihood=2.5, margin=0.2),
        hypotheses=[Hypothesis(np.diag([-1.0, -1, 1, 1]), 0.4), Hypothesis(np.diag([1.0, -1, -1, 1]), 0.3)],
        max_correspondence_distance=0.05,
        information=np.diag(np.arange(6.0)),
        matches=Matches(np.zeros((4, 3)), np.ones((4, 3)), np.full(4, 0.25)),
        model="gnn-unseen-shapes",
        seconds=0.1,
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
    assert content["correspondences"] == 3
    assert content["evidence"] == {"overlap": 0.6, "support": 0.8, "likelihood": 2.5, "margin": 0.2}
    assert content["hypotheses"] == [
        {"transformation": np.diag([-1.0, -1, 1, 1]).tolist(), "score": 0.4},
        {"transformation": np.diag([1.0, -1, -1, 1]).tolist(), "score": 0.3},
    ]
    alike = ("fitness", "inlier_rmse", "confidence", "converged", "reason", "max_correspondence_distance", "model")
    assert {name: content[name] for name in (*alike, "seconds")} == {
        name: getattr(result, name) for name in (*alike, "seconds")
    }


def test_to_dict_names_every_field_but_the_large_ones(result: RegistrationResult) -> None:
    names = {field.name for field in fields(result)} - {"correspondence_set", "matches"}
    assert set(result.to_dict()) == names | {"correspondences"}


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


def test_repr_is_short(result: RegistrationResult) -> None:
    many = replace(result, correspondence_set=np.zeros((10_000, 2), np.int64))
    assert len(repr(many)) < 2000
    assert "fitness=0.75" in repr(many)


# --- the package ---------------------------------------------------------------------------------------------------


def loaded_by(code: str) -> set[str]:
    """Which of the slow packages a fresh interpreter has imported after running the code."""
    code += "\nimport sys\nprint(*sys.modules, file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    loaded = set(done.stderr.split())
    assert "idam" in loaded
    return SLOW & loaded


def test_import_is_light() -> None:
    assert loaded_by("import idam; idam.InputError; idam.RegistrationResult; dir(idam)") == set()


def test_help_is_light() -> None:
    code = (
        "import sys, idam.cli; sys.argv = ['idam', {}]\ntry: idam.cli.main()\nexcept SystemExit as e: assert not e.code"
    )
    assert loaded_by(code.format("'--help'")) == set()
    assert loaded_by(code.format("'register', '--help'")) == set()


def test_every_public_name_resolves() -> None:
    assert {"register", "load_model", "list_models", "RegistrationResult"} <= set(idam.__all__)
    for name in idam.__all__:
        assert getattr(idam, name).__name__ == name
        assert name in dir(idam)
    with pytest.raises(AttributeError, match="nonsense"):
        _ = idam.nonsense


def test_version_is_that_of_the_installed_package() -> None:
    assert idam.__version__ == metadata.version("idam")


def test_package_is_typed_and_holds_its_models() -> None:
    assert (resources.files("idam") / "py.typed").is_file()
    assert "gnn-unseen-shapes" in idam.list_models()
    for name in idam.list_models():
        assert not idam.load_model(name).training
