"""``idam.register``, from any two clouds to one transform."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

import idam
from idam import RegistrationResult, registration
from idam import search as searching
from idam.align import METHODS, Surfaces
from idam.clouds.frame import common_frame
from idam.errors import InputError
from idam.io import PointCloud, write_point_cloud
from idam.network.pretrained import find
from idam.registration import as_rigid, in_input_units, smaller_first
from idam.result import Matches
from idam.search.confidence import CLOSE, CONVERGED, Evidence, confidence, doubt
from idam.search.matching import FOR
from idam.search.ranking import alike
from motions import move

UTM = np.array([5e5, 5.6e6, 100.0])
SETTLED = 0.2
"""Degrees, and hundredths of the cloud's size, within which refinement ends up in the same place."""


def rigid(rotation: Rotation, translation: Any) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = rotation.as_matrix()
    matrix[:3, 3] = translation
    return matrix


def degrees(a: np.ndarray, b: np.ndarray) -> float:
    """The angle between the rotations of two transforms."""
    return float(np.degrees(Rotation.from_matrix(a[:3, :3].T @ b[:3, :3]).magnitude()))


def bracket(count: int, seed: int) -> np.ndarray:
    """Points on a part without symmetry, about one unit long."""
    corners = [
        ([0, 0, 0], [1, 0.5, 0.12]),
        ([0, 0, 0.12], [0.15, 0.5, 0.82]),
        ([0.55, 0.1, 0.12], [0.8, 0.3, 0.47]),
        ([0.8, 0.35, 0.12], [0.9, 0.45, 0.27]),
    ]
    mesh = trimesh.util.concatenate([trimesh.creation.box(bounds=bounds) for bounds in corners])
    return np.asarray(trimesh.sample.sample_surface(mesh, count, seed=seed)[0])


def ball(count: int, seed: int) -> np.ndarray:
    points = np.random.default_rng(seed).normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def noise(count: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(count, 3))


TRUTH = rigid(Rotation.from_rotvec([1.0, -1.5, 0.8]), [1.0, 2.0, 3.0])
SOURCE = bracket(400, seed=1)
TARGET = move(TRUTH, bracket(450, seed=2))
CENTRE = SOURCE.mean(0)


def assert_right(result: RegistrationResult, truth: np.ndarray, centre: np.ndarray, size: float = 1.0) -> None:
    assert degrees(result.transformation, truth) < 5.0
    assert np.linalg.norm(result.apply(centre) - move(truth, centre)) < 0.03 * size


def assert_settled(transformation: np.ndarray, expected: np.ndarray, centre: np.ndarray, size: float = 1.0) -> None:
    assert degrees(transformation, expected) < SETTLED
    assert np.linalg.norm(move(transformation, centre) - move(expected, centre)) < SETTLED / 100 * size


def refusal(*data: Any, **options: Any) -> str:
    with pytest.raises(InputError) as error:
        idam.register(*(data or (SOURCE, TARGET)), **options)
    assert isinstance(error.value, ValueError)
    message = str(error.value)
    assert message
    assert "\n" not in message
    return message


@pytest.fixture(scope="session")
def result() -> RegistrationResult:
    """The easy pair, with no option given."""
    return idam.register(SOURCE, TARGET)


# --- the answer ----------------------------------------------------------------------------------------------------


def test_easy_pair(result: RegistrationResult) -> None:
    assert_right(result, TRUTH, CENTRE)


def test_transformation_is_rigid_in_double_precision(result: RegistrationResult) -> None:
    rotation = result.transformation[:3, :3]
    assert result.transformation.shape == (4, 4)
    assert result.transformation.dtype == np.float64
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(rotation) > 0
    np.testing.assert_array_equal(result.transformation[3], [0, 0, 0, 1])


def test_figures_are_those_of_brute_force(result: RegistrationResult) -> None:
    pairs = result.correspondence_set
    assert pairs.ndim == 2
    assert pairs.shape[1] == 2
    assert pairs.dtype.kind == "i"
    distance = cdist(result.apply(SOURCE), TARGET)
    rows = np.flatnonzero(distance.min(1) < result.max_correspondence_distance)
    assert 0 < len(rows) < len(SOURCE)
    np.testing.assert_array_equal(pairs, np.stack([rows, distance.argmin(1)[rows]], 1))
    assert result.fitness == len(rows) / len(SOURCE)
    assert result.inlier_rmse == pytest.approx(np.sqrt(np.mean(distance.min(1)[rows] ** 2)))


def test_other_fields(result: RegistrationResult) -> None:
    assert result.confidence == confidence(result.evidence)
    evidence = result.evidence
    assert all(0.0 < share <= 1.0 for share in (evidence.overlap, evidence.support, evidence.margin))
    assert 0.5 < evidence.likelihood <= FOR
    assert result.model == "default"
    assert 0.0 < result.seconds < 60.0
    assert result.information.shape == (6, 6)
    assert np.linalg.eigvalsh(result.information).min() > 0


def test_matches_are_in_the_input_coordinates(result: RegistrationResult) -> None:
    matches = result.matches
    assert matches.source.shape == matches.target.shape == (*matches.weight.shape, 3)
    assert matches.weight.sum() == pytest.approx(1.0)
    # 400 points are matched as they are
    assert cdist(matches.source, SOURCE).min(1).max() < 1e-5
    assert cdist(matches.target, TARGET).min(1).max() < 1e-5


def test_matches_weigh_the_more_the_closer_the_answer_brings_them(result: RegistrationResult) -> None:
    matches = result.matches
    miss = np.linalg.norm(result.apply(matches.source) - matches.target, axis=1)
    kept = matches.weight > 0
    assert 0 < kept.sum() < len(kept)
    # the last refinement still moves them a little
    assert miss[kept].max() < miss[~kept].min() + 0.02
    assert np.corrcoef(miss[kept], matches.weight[kept])[0, 1] < -0.9


def test_runners_up_are_other_transforms_that_score_less() -> None:
    box = trimesh.creation.box((1.2, 0.8, 0.5))
    source, target = (np.asarray(trimesh.sample.sample_surface(box, 700, seed=seed)[0]) for seed in (1, 2))
    result = idam.register(source, move(TRUTH, target))
    assert len(result.hypotheses) >= 3  # the half turns of a box
    scores = [other.score for other in result.hypotheses]
    assert scores == sorted(scores, reverse=True)
    for other in result.hypotheses:
        rotation = other.transformation[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
        assert not alike(other.transformation, result.transformation)
        # they, too, bring the source to the target
        assert np.linalg.norm(move(other.transformation, source.mean(0)) - move(TRUTH, target.mean(0))) < 0.3


def test_an_answer_turns_no_further_than_it_may() -> None:
    box = trimesh.creation.box((1.2, 0.8, 0.5))
    source, target = (np.asarray(trimesh.sample.sample_surface(box, 700, seed=seed)[0]) for seed in (1, 2))
    turn = rigid(Rotation.from_rotvec([0.2, 1.0, -0.3]), [0.1, 0.0, 0.2])
    half = rigid(Rotation.from_rotvec([0.0, np.pi, 0.0]), [0.0, 0.0, 0.0])
    for init, expected in ((None, turn), (turn @ half, turn @ half)):
        result = idam.register(source, move(turn, target), init=init, max_angle=80)
        assert degrees(result.transformation, expected) < 2
        assert result.evidence.margin > CLOSE  # its other poses are half turns away
    # from a guess that far off, nothing else is within reach
    assert degrees(idam.register(SOURCE, TARGET, max_angle=60).transformation, TRUTH) > 50
    assert degrees(idam.register(TARGET, SOURCE, max_angle=120).transformation, np.linalg.inv(TRUTH)) < 2


@pytest.mark.parametrize(
    "evidence", [Evidence(0.9, 0.8, 3.0, 0.9), Evidence(0.1, 0.01, 0.1, 0.01), Evidence(0.0, 0.0, 0.0, 0.0)]
)
def test_reason_is_given_where_the_answer_is_not_to_count_on(
    evidence: Evidence, monkeypatch: pytest.MonkeyPatch
) -> None:
    search = registration.search
    monkeypatch.setattr(registration, "search", lambda *args: replace(search(*args), evidence=evidence))
    result = idam.register(SOURCE, move(TRUTH, SOURCE))
    assert result.confidence == confidence(evidence)
    assert result.converged is (result.confidence >= CONVERGED)
    assert result.reason == ("" if result.converged else doubt(evidence))


def test_max_correspondence_distance_is_what_is_measured_at() -> None:
    near, far = (idam.register(SOURCE, TARGET, max_correspondence_distance=np.float32(d)) for d in (0.01, 0.5))
    assert near.max_correspondence_distance == pytest.approx(0.01)
    assert near.inlier_rmse < 0.01
    assert near.fitness < far.fitness == 1.0
    np.testing.assert_array_equal(near.transformation, far.transformation)
    assert all(isinstance(figure, float) for figure in (far.max_correspondence_distance, far.fitness, far.inlier_rmse))


def test_same_seed_same_bits(result: RegistrationResult) -> None:
    torch.rand(3)
    state = torch.get_rng_state()
    again = idam.register(SOURCE, TARGET)
    np.testing.assert_array_equal(again.transformation, result.transformation)
    np.testing.assert_array_equal(again.information, result.information)
    assert again.confidence == result.confidence
    assert (torch.get_rng_state() == state).all()


@pytest.fixture
def threads() -> Iterator[Callable[[int], None]]:
    """Sets the number of threads, for the test."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@pytest.mark.parametrize(
    ("source", "target", "model"),
    [(SOURCE, move(TRUTH, SOURCE[40:]), "default"), (SOURCE[:150], noise(120, seed=1), "gnn-unseen-shapes")],
    ids=["easy", "hard"],
)
def test_any_number_of_threads_same_bits(
    source: np.ndarray,
    target: np.ndarray,
    model: str,
    threads: Callable[[int], None],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(searching, "STARTS", 4)
    found = []
    for count in (1, 2):
        threads(count)
        found.append(idam.register(source, target, model=model))
    one, two = found
    np.testing.assert_array_equal(one.transformation, two.transformation)
    np.testing.assert_array_equal(one.matches.weight, two.matches.weight)
    assert one.confidence == two.confidence
    assert [other.score for other in one.hypotheses] == [other.score for other in two.hypotheses]


@pytest.mark.parametrize("seed", [7, -1, np.int64(7)])
def test_any_seed_finds_the_easy_pair(result: RegistrationResult, seed: Any) -> None:
    other = idam.register(SOURCE, TARGET, seed=seed)
    assert_settled(other.transformation, result.transformation, CENTRE)


def test_clouds_are_left_as_they_were() -> None:
    source, target = SOURCE.copy(), TARGET.copy()
    source.setflags(write=False)
    idam.register(source, target)
    np.testing.assert_array_equal(target, TARGET)


# --- what it takes -------------------------------------------------------------------------------------------------


def as_trimesh(points: np.ndarray) -> Any:
    return trimesh.PointCloud(points)


def as_open3d(points: np.ndarray) -> Any:
    try:
        import open3d
    except (ImportError, OSError) as error:  # its wheel counts on system libraries
        pytest.skip(f"Open3D cannot be imported ({error})")
    return open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))


@pytest.mark.parametrize(
    "kind", [torch.tensor, np.ndarray.tolist, PointCloud, np.asfortranarray, as_trimesh, as_open3d]
)
def test_takes(kind: Callable[[np.ndarray], Any], result: RegistrationResult) -> None:
    found = idam.register(kind(SOURCE), kind(TARGET))
    assert_settled(found.transformation, result.transformation, CENTRE)
    np.testing.assert_array_equal(found.correspondence_set, result.correspondence_set)


def test_takes_paths_of_single_precision(result: RegistrationResult, tmp_path: Path) -> None:
    write_point_cloud(tmp_path / "source.ply", SOURCE)
    found = idam.register(tmp_path / "source.ply", torch.tensor(TARGET, dtype=torch.float32, requires_grad=True))
    assert_settled(found.transformation, result.transformation, CENTRE)
    found = idam.register(str(tmp_path / "source.ply"), TARGET)
    assert_settled(found.transformation, result.transformation, CENTRE)


@pytest.mark.parametrize("unit", [1e-3, 0.3048, 1000.0])
def test_unit_does_not_matter(result: RegistrationResult, unit: float) -> None:
    found = idam.register(unit * SOURCE, unit * TARGET)
    in_our_unit = found.transformation.copy()
    in_our_unit[:3, 3] /= unit
    assert_settled(in_our_unit, result.transformation, CENTRE)
    assert found.max_correspondence_distance == pytest.approx(unit * result.max_correspondence_distance)
    assert found.fitness == pytest.approx(result.fitness, abs=0.01)
    assert found.inlier_rmse == pytest.approx(unit * result.inlier_rmse, rel=0.02)
    assert found.confidence == pytest.approx(result.confidence, abs=0.05)


@pytest.mark.parametrize(("source_at", "target_at"), [(UTM, UTM), (UTM, 0 * UTM), (-UTM, UTM[::-1])])
def test_place_does_not_matter(result: RegistrationResult, source_at: np.ndarray, target_at: np.ndarray) -> None:
    found = idam.register(SOURCE + source_at, TARGET + target_at)
    assert degrees(found.transformation, result.transformation) < SETTLED
    shift = found.apply(SOURCE + source_at) - (result.apply(SOURCE) + target_at)
    assert np.abs(shift).max() < SETTLED / 100
    # millimetres in a national grid: the product of a rotation and 5.6e6 must not lose them
    np.testing.assert_allclose(
        found.transformation[:3, :3] @ found.transformation[:3, :3].T, np.eye(3), rtol=0, atol=1e-12
    )


@pytest.mark.parametrize("seed", [1, 2])
def test_turning_the_clouds_turns_the_answer(result: RegistrationResult, seed: int) -> None:
    turns = [rigid(rotation, 0.0) for rotation in Rotation.random(2, rng=np.random.default_rng(seed))]
    source, target = move(turns[0], SOURCE), move(turns[1], TARGET)
    found = turns[1].T @ idam.register(source, target).transformation @ turns[0]
    # the search starts elsewhere, but what the clouds say is the same
    assert degrees(found, result.transformation) < 0.5
    assert np.linalg.norm(move(found, CENTRE) - result.apply(CENTRE)) < 0.005


def test_order_of_points_does_not_matter(result: RegistrationResult) -> None:
    rows = np.random.default_rng(0).permutation(len(SOURCE))
    found = idam.register(SOURCE[rows], TARGET[::-1])
    assert_settled(found.transformation, result.transformation, CENTRE)
    np.testing.assert_array_equal(np.sort(rows[found.correspondence_set[:, 0]]), result.correspondence_set[:, 0])


@pytest.mark.parametrize("unlike", [SOURCE, TARGET, move(TRUTH, bracket(300, seed=4)[:200])])
def test_which_cloud_counts_as_the_smaller_depends_on_the_clouds_alone(unlike: np.ndarray) -> None:
    other = 1.1 * bracket(450, seed=3)
    turn = rigid(Rotation.from_rotvec([0.3, 2.0, -1.0]), [1.0, 0.0, -2.0])
    assert smaller_first(unlike, other) is not smaller_first(other, unlike)
    assert smaller_first(move(turn, unlike), other) is smaller_first(unlike, other)


def test_swapping_the_clouds_inverts_the_answer(result: RegistrationResult) -> None:
    back = idam.register(TARGET, SOURCE)
    inverse = np.linalg.inv(back.transformation)
    # found in the same direction, but the last refinement takes the other
    assert degrees(inverse, result.transformation) < 2.0
    assert np.linalg.norm(move(inverse, CENTRE) - result.apply(CENTRE)) < 0.02
    assert back.confidence == result.confidence
    assert back.evidence == result.evidence
    assert back.reason == result.reason
    np.testing.assert_array_equal(back.matches.source, result.matches.target)
    np.testing.assert_array_equal(back.matches.target, result.matches.source)
    np.testing.assert_array_equal(back.matches.weight, result.matches.weight)
    for one, other in zip(back.hypotheses, result.hypotheses, strict=True):
        np.testing.assert_allclose(np.linalg.inv(one.transformation), other.transformation, atol=1e-9)
        assert one.score == other.score


def test_swapping_the_clouds_and_the_init_inverts_what_is_not_refined() -> None:
    init = rigid(Rotation.from_rotvec([0.5, 0.0, 0.0]), [1.0, 2.0, 3.0])
    forth = idam.register(SOURCE, TARGET, refine=None, init=init)
    back = idam.register(TARGET, SOURCE, refine=None, init=np.linalg.inv(init))
    np.testing.assert_allclose(np.linalg.inv(back.transformation), forth.transformation, atol=1e-9)
    assert back.confidence == pytest.approx(forth.confidence, abs=1e-9)


def test_a_cloud_on_itself_is_its_own_inverse() -> None:
    moved = move(TRUTH, SOURCE)
    forth, back = idam.register(SOURCE, moved), idam.register(moved, SOURCE)
    for found, truth in ((forth, TRUTH), (back, np.linalg.inv(TRUTH))):
        np.testing.assert_allclose(found.transformation, truth, atol=1e-4)
    assert forth.confidence == pytest.approx(back.confidence, abs=1e-4)


# --- how sure it is ------------------------------------------------------------------------------------------------


def test_sure_of_a_clean_pair_with_much_overlap() -> None:
    source = bracket(600, seed=1)
    blurred = source[60:] + np.random.default_rng(0).normal(0, 0.002, (540, 3))
    found = idam.register(source, move(TRUTH, blurred))
    assert_right(found, TRUTH, CENTRE)
    assert found.confidence > 0.9
    assert found.converged
    assert found.reason == ""


@pytest.mark.parametrize(
    ("source", "target"),
    [
        (ball(500, 1), ball(500, 2)),
        (
            bracket(400, seed=1),
            np.asarray(trimesh.sample.sample_surface(trimesh.creation.torus(1, 0.4), 500, seed=3)[0]),
        ),
        (bracket(400, seed=1), noise(500, 1)),
        (bracket(400, seed=1), 0.5 * ball(500, 2)),
        (bracket(400, seed=1), ball(500, 1)),
    ],
    ids=["two spheres", "a torus", "noise", "a small sphere", "a sphere"],
)
def test_not_sure_of_what_turns_freely_or_has_nothing_in_common(source: np.ndarray, target: np.ndarray) -> None:
    found = idam.register(source, target)
    assert found.confidence < CONVERGED
    assert not found.converged
    assert found.reason


# --- awkward clouds ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("copies", [2, 20])
def test_points_given_more_than_once(result: RegistrationResult, copies: int) -> None:
    found = idam.register(np.repeat(SOURCE, copies, axis=0), np.repeat(TARGET, copies, axis=0))
    assert_right(found, TRUTH, CENTRE)
    assert found.fitness == pytest.approx(result.fitness, abs=0.05)
    assert found.max_correspondence_distance == pytest.approx(result.max_correspondence_distance, rel=0.05)


@pytest.mark.parametrize(("count", "distance"), [(400, 1e3), (400, 1e9), (3000, 1e7)])
def test_a_stray_point_does_no_harm(count: int, distance: float, capfd: pytest.CaptureFixture[str]) -> None:
    source = np.vstack([bracket(count, seed=1), [[distance, 0, 0]]])
    found = idam.register(source, move(TRUTH, bracket(count, seed=2)))
    assert_right(found, TRUTH, CENTRE)
    assert np.isfinite(found.inlier_rmse)
    assert capfd.readouterr() == ("", "")


def test_smallest_clouds() -> None:
    found = idam.register(SOURCE[:20], move(TRUTH, SOURCE[:20]))
    assert found.transformation.shape == (4, 4)
    assert np.isfinite(found.transformation).all()


def test_plane_on_plane() -> None:
    plane = SOURCE * [1, 1, 0]
    found = idam.register(plane, move(TRUTH, plane))
    # which way it lies in the plane may be anybody's guess, but on the plane it lies
    assert np.abs(move(np.linalg.inv(TRUTH), found.apply(plane))[:, 2]).max() < 0.05


def test_source_too_small_beside_the_target() -> None:
    message = refusal(0.01 * SOURCE, bracket(3000, seed=3))
    assert message.startswith("source")
    assert refusal(bracket(3000, seed=3), 0.01 * SOURCE).startswith("target")


def test_few_places_many_points() -> None:
    assert refusal(np.repeat(SOURCE[:5], 30, axis=0), TARGET).startswith("source")


# --- options -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("refine", METHODS)
def test_refinements(refine: str) -> None:
    found = idam.register(SOURCE, TARGET, refine=refine)
    assert_right(found, TRUTH, CENTRE)
    assert found.information.any()


@pytest.mark.parametrize(("refine", "method"), [("gicp", "symmetric"), ("plane", "plane")])
def test_last_refinement_takes_the_fine_clouds(refine: str, method: str, monkeypatch: pytest.MonkeyPatch) -> None:
    taken = []

    def noted(surfaces: Surfaces, start: np.ndarray, *rest: Any) -> tuple[np.ndarray, np.ndarray]:
        taken.append((len(surfaces.source.points), len(surfaces.target.points), rest[-1]))
        return start, np.zeros((6, 6))

    monkeypatch.setattr("idam.registration.align", noted)
    idam.register(SOURCE, TARGET, refine=refine)
    assert taken == [(len(SOURCE), len(TARGET), method)]


def test_no_refinement(result: RegistrationResult) -> None:
    with_none, with_word = (idam.register(SOURCE, TARGET, refine=refine) for refine in (None, "none"))
    np.testing.assert_array_equal(with_none.transformation, with_word.transformation)
    np.testing.assert_array_equal(with_none.information, np.zeros((6, 6)))
    assert degrees(result.transformation, TRUTH) < degrees(with_none.transformation, TRUTH) < 10.0
    rotation = with_none.transformation[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)


def test_model_by_name_and_by_file(tmp_path: Path) -> None:
    name = "gnn-unseen-shapes"
    copy = tmp_path / "mine.safetensors"
    copy.write_bytes(find(name).read_bytes())
    by_name = idam.register(SOURCE, TARGET, model=name)
    assert by_name.model == name
    for model in (copy, str(copy)):
        by_file = idam.register(SOURCE, TARGET, model=model)
        np.testing.assert_array_equal(by_file.transformation, by_name.transformation)
        assert by_file.model == "mine"


def test_init_is_tried_as_it_is() -> None:
    # with nothing refined and the truth to try, the truth is the best there is
    found = idam.register(SOURCE, TARGET, refine="none", init=TRUTH)
    np.testing.assert_allclose(found.transformation, TRUTH, atol=1e-9)


def test_init_is_taken_as_the_rotation_nearest_to_it() -> None:
    rounded = TRUTH.round(4)
    found = idam.register(SOURCE, TARGET, refine=None, init=rounded).transformation
    np.testing.assert_allclose(found, TRUTH, atol=1e-3)
    np.testing.assert_allclose(found[:3, :3] @ found[:3, :3].T, np.eye(3), atol=1e-9)


@pytest.mark.parametrize("rotation", [[0.0, 0.0, 0.0], [1.0, -1.5, 0.8]])
def test_as_rigid_keeps_what_is_rigid(rotation: list[float]) -> None:
    matrix = rigid(Rotation.from_rotvec(rotation), [1, 2, 3])
    np.testing.assert_allclose(as_rigid(matrix.tolist()), matrix, atol=1e-12)


def test_init_may_be_far_off(result: RegistrationResult) -> None:
    far = rigid(Rotation.from_rotvec([3.0, 0.0, 0.0]), [50.0, 0.0, -9.0])
    for init in (far, far.tolist(), torch.tensor(far)):
        found = idam.register(SOURCE, TARGET, init=init)
        assert_settled(found.transformation, result.transformation, CENTRE)


def test_init_of_clouds_far_from_the_origin() -> None:
    there, back = rigid(Rotation.identity(), UTM), rigid(Rotation.identity(), -UTM)
    found = idam.register(SOURCE + UTM, TARGET + UTM, refine=None, init=there @ TRUTH @ back)
    np.testing.assert_allclose(found.apply(SOURCE + UTM), move(TRUTH, SOURCE) + UTM, rtol=0, atol=1e-6)


def test_voxel_size_sets_where_matches_are_sought() -> None:
    source, target = bracket(2000, seed=1), move(TRUTH, bracket(2000, seed=2))
    coarse, fine = (idam.register(1000 * source, 1000 * target, voxel_size=size) for size in (150.0, 60.0))
    assert len(coarse.matches.weight) < len(fine.matches.weight) < 2000
    assert_right(fine, rigid(Rotation.from_matrix(TRUTH[:3, :3]), 1000 * TRUTH[:3, 3]), 1000 * CENTRE, 1000.0)


def test_voxel_size_below_the_spacing_changes_nothing(
    result: RegistrationResult, capfd: pytest.CaptureFixture[str]
) -> None:
    for voxel_size in (1e-3, 1e-12):
        found = idam.register(SOURCE, TARGET, voxel_size=voxel_size)
        assert_settled(found.transformation, result.transformation, CENTRE)
    assert capfd.readouterr() == ("", "")


# --- what it refuses -----------------------------------------------------------------------------------------------


NAN = np.where(SOURCE > 0.9, np.nan, SOURCE)


@pytest.mark.parametrize(
    ("cloud", "message"),
    [
        (SOURCE[:10], "has 10 points"),
        (np.zeros((0, 3)), "has 0 points"),
        (np.zeros((50, 3)), "equal"),
        (np.full((50, 3), np.nan), "50 of 50 points are NaN"),
        (NAN, "NaN or infinite"),
        (SOURCE[:, :1] * [1.0, 2.0, 3.0] + UTM, "line"),
        (SOURCE[:, :2], r"\(N, 3\), got shape \(400, 2\)"),
        (SOURCE.T, "transpose"),
        (SOURCE > 0, "real numbers"),
        (SOURCE * 1j, "real numbers"),
        ([], "shape"),
        (None, "NoneType"),
        (1e200 * SOURCE, "infinite"),
    ],
)
def test_refuses_clouds_by_name(cloud: Any, message: str) -> None:
    assert refusal(cloud, TARGET).startswith("source: ")
    with pytest.raises(InputError, match=rf"^target: .*{message}"):
        idam.register(SOURCE, cloud)


def test_refuses_files_by_path(tmp_path: Path) -> None:
    missing = tmp_path / "missing.ply"
    assert refusal(missing, TARGET).startswith(f"{missing}: no such file")
    few = tmp_path / "few.xyz"
    np.savetxt(few, SOURCE[:10])
    assert refusal(SOURCE, str(few)).startswith(f"{few}: has 10 points")


@pytest.mark.parametrize("value", [0, 0.0, -1.0, np.nan, np.inf, "wide"])
@pytest.mark.parametrize("option", ["voxel_size", "max_correspondence_distance"])
def test_refuses_sizes(option: str, value: Any) -> None:
    assert option in refusal(**{option: value})


def test_refuses_a_voxel_size_that_leaves_nothing() -> None:
    message = refusal(1000 * SOURCE, 1000 * TARGET, voxel_size=3000.0)
    assert re.search(r"voxel.size", message)
    assert "smaller" in message
    figures = [float(figure) for figure in re.findall(r"\d+\.\d+|\d{3,}", message)]
    assert set(figures) <= {3000.0}  # in the caller's unit, if at all


def test_refuses_a_voxel_size_that_leaves_more_than_memory_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registration, "search", lambda *_: pytest.fail("all of them were searched"))
    assert "larger" in refusal(bracket(6000, seed=1), bracket(6000, seed=2), voxel_size=1e-4)


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("model", "nosuch", "gnn-unseen-shapes"),
        ("model", "", "unknown model"),
        ("model", "nosuch.safetensors", "nosuch.safetensors"),
        ("max_angle", 0, "max_angle"),
        ("max_angle", -5.0, "max_angle"),
        ("max_angle", 181, "max_angle"),
        ("max_angle", np.nan, "max_angle"),
        ("max_angle", "any", "max_angle"),
        ("refine", "magic", "gicp, plane, point, symmetric or none"),
        ("refine", ["gicp"], "gicp, plane, point, symmetric or none"),
        ("device", "abacus", "abacus"),
        ("device", "cuda:99", "cuda:99"),
        ("seed", 2**70, "seed"),
        ("seed", 1.5, "seed"),
        ("seed", "one", "seed"),
    ],
)
def test_refuses_options(option: str, value: Any, message: str) -> None:
    assert message in refusal(**{option: value})


def test_refuses_a_file_that_is_no_model(tmp_path: Path) -> None:
    path = tmp_path / "a.safetensors"
    path.write_bytes(b"nothing of the kind")
    assert str(path) in refusal(model=path)


@pytest.mark.parametrize(
    "init",
    [
        np.eye(3),
        np.zeros((4, 4)),
        np.diag([2.0, 2, 2, 1]),
        np.diag([1.0, 1, -1, 1]),
        np.full((4, 4), np.nan),
        np.full((4, 4), np.inf),
        rigid(Rotation.identity(), [np.inf, 0, 0]),
        rigid(Rotation.identity(), [1, 2, 3]).T,
        [[1, 2], [3]],
        "identity",
    ],
)
def test_refuses_what_is_not_rigid(init: Any) -> None:
    assert refusal(init=init).startswith("init ")


# --- coordinates ---------------------------------------------------------------------------------------------------


def test_matches_in_input_units_keep_their_weights() -> None:
    frame = common_frame(SOURCE + UTM, 2 * TARGET)
    weight = np.linspace(0, 1, len(SOURCE))
    working = Matches(frame.source(SOURCE + UTM), frame.target(2 * TARGET[: len(SOURCE)]), weight)
    matches = in_input_units(working, frame)
    np.testing.assert_allclose(matches.source, SOURCE + UTM, atol=1e-6)
    np.testing.assert_allclose(matches.target, 2 * TARGET[: len(SOURCE)], atol=1e-9)
    assert matches.weight is weight


# --- the shipped scans ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "turn", [Rotation.identity(), Rotation.from_rotvec([2.0, -1.0, 1.5])], ids=["as shipped", "turned"]
)
def test_shipped_scans(turn: Rotation) -> None:
    with resources.as_file(resources.files("idam") / "data" / "demo") as folder:
        source, target = (np.asarray(trimesh.load(folder / name).vertices) for name in ("source.ply", "target.ply"))
        truth = np.loadtxt(folder / "truth.txt") @ rigid(turn, 0.0).T
    source = turn.apply(source)
    found = idam.register(source, target)
    assert degrees(found.transformation, truth) < 5.0
    assert np.linalg.norm(found.apply(source.mean(0)) - move(truth, source.mean(0))) < 0.01
    assert found.fitness > 0.5
    assert found.confidence > 0.5
