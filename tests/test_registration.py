"""``idam.register``, from any two clouds to one transform."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import idam
from idam import RegistrationResult, rigid
from idam.align import METHODS
from idam.clouds.prepared import Prepared
from idam.errors import InputError
from idam.io import PointCloud, read_point_cloud, write_point_cloud
from idam.registration import as_rigid
from idam.search.doubt import TIED
from idam.search.judge import CONVERGED, LEAD, confidence
from idam.search.matching import FOR
from motions import any_rotation, degrees, move
from motions import rigid as motion
from rooms import corridor
from solids import ball, box, bracket, distances, noise, torus

UTM = np.array([5e5, 5.6e6, 100.0])
SETTLED = 0.2
"""Degrees, and hundredths of the cloud's size, within which refinement ends up in the same place."""
TRUTH = motion([1.0, -1.5, 0.8], [1.0, 2.0, 3.0])
SOURCE = bracket(400, seed=1)
TARGET = move(TRUTH, bracket(450, seed=2))
CENTRE = SOURCE.mean(0)


def assert_right(result: RegistrationResult, truth: np.ndarray, centre: np.ndarray, size: float = 1.0) -> None:
    assert degrees(result.transformation, truth) < 5.0
    assert np.linalg.norm(result.apply(centre) - move(truth, centre)) < 0.03 * size


def assert_settled(transformation: np.ndarray, expected: np.ndarray, centre: np.ndarray, size: float = 1.0) -> None:
    assert degrees(transformation, expected) < SETTLED
    assert np.linalg.norm(move(transformation, centre) - move(expected, centre)) < SETTLED / 100 * size


def assert_same_bits(one: RegistrationResult, other: RegistrationResult) -> None:
    for name in ("transformation", "information", "correspondence_set"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    np.testing.assert_array_equal(one.matches.weight, other.matches.weight)
    alike = ("fitness", "inlier_rmse", "confidence", "reason", "evidence", "max_correspondence_distance")
    assert [getattr(one, name) for name in alike] == [getattr(other, name) for name in alike]
    assert [each.score for each in one.hypotheses] == [each.score for each in other.hypotheses]


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
    assert result.converged
    assert result.reason == ""


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
    distance = distances(result.apply(SOURCE), TARGET)
    rows = np.flatnonzero(distance.min(1) <= result.max_correspondence_distance)
    assert 0 < len(rows) < len(SOURCE)
    np.testing.assert_array_equal(pairs, np.stack([rows, distance.argmin(1)[rows]], 1))
    assert result.fitness == pytest.approx(len(rows) / len(SOURCE))
    assert result.inlier_rmse == pytest.approx(np.sqrt(np.mean(distance.min(1)[rows] ** 2)))


def test_other_fields(result: RegistrationResult) -> None:
    assert result.confidence == confidence(result.evidence)
    evidence = result.evidence
    shares = (evidence.overlap, evidence.contained, evidence.support, evidence.close, evidence.off, evidence.border)
    assert all(0.0 < share <= 1.0 for share in shares)
    assert evidence.contained >= evidence.overlap
    assert evidence.violation == 0.0
    assert 0.0 < evidence.lead <= LEAD
    assert 0.5 < evidence.likelihood <= FOR
    assert result.model == "general"
    assert 0.0 < result.seconds < 60.0
    assert result.information.shape == (6, 6)
    assert np.linalg.eigvalsh(result.information).min() > 0


def test_matches_are_in_the_input_coordinates(result: RegistrationResult) -> None:
    matches = result.matches
    assert matches.source.shape == matches.target.shape == (*matches.weight.shape, 3)
    assert matches.weight.sum() == pytest.approx(1.0)
    # 400 points are matched as they are
    assert distances(matches.source, SOURCE).min(1).max() < 1e-12
    assert distances(matches.target, TARGET).min(1).max() < 1e-12


def test_matches_weigh_the_more_the_closer_the_answer_brings_them(result: RegistrationResult) -> None:
    matches = result.matches
    miss = np.linalg.norm(result.apply(matches.source) - matches.target, axis=1)
    kept = matches.weight > 0
    assert 0 < kept.sum() < len(kept)
    assert miss[kept].max() < miss[~kept].min()
    assert np.corrcoef(miss[kept], matches.weight[kept])[0, 1] < -0.9


def test_runners_up_are_other_transforms_that_explain_the_clouds_too() -> None:
    source, target = (box((1.2, 0.8, 0.5), 700, seed) for seed in (1, 2))
    result = idam.register(source, move(TRUTH, target))
    assert len(result.hypotheses) >= 3  # the half turns of a box
    assert all(other.score > 0.3 for other in result.hypotheses[:3])
    for other in result.hypotheses:
        rotation = other.transformation[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
        assert degrees(other.transformation, result.transformation) > 8
        # they, too, bring the source to the target
        assert np.linalg.norm(move(other.transformation, source.mean(0)) - move(TRUTH, target.mean(0))) < 0.3


def test_an_answer_turns_no_further_than_it_may() -> None:
    source, target = (box((1.2, 0.8, 0.5), 700, seed) for seed in (1, 2))
    turn, half = motion([0.2, 1.0, -0.3], [0.1, 0.0, 0.2]), motion([0.0, np.pi, 0.0], [0.0, 0.0, 0.0])
    for init, expected in ((None, turn), (turn @ half, turn @ half)):
        result = idam.register(source, move(turn, target), init=init, max_angle=80)
        assert degrees(result.transformation, expected) < 2
        assert result.evidence.lead > TIED  # its other poses are half turns away
    # from a guess that far off, nothing else is within reach
    assert degrees(idam.register(SOURCE, TARGET, max_angle=60).transformation, TRUTH) > 50
    assert degrees(idam.register(TARGET, SOURCE, max_angle=120).transformation, np.linalg.inv(TRUTH)) < 5


def test_max_correspondence_distance_is_what_is_measured_at() -> None:
    near, far = (idam.register(SOURCE, TARGET, max_correspondence_distance=np.float32(d)) for d in (0.01, 0.5))
    assert near.max_correspondence_distance == pytest.approx(0.01)
    assert near.inlier_rmse < 0.01
    assert near.fitness < far.fitness == 1.0
    np.testing.assert_array_equal(near.transformation, far.transformation)
    assert all(isinstance(figure, float) for figure in (far.max_correspondence_distance, far.fitness, far.inlier_rmse))
    distance = distances(near.apply(SOURCE), TARGET).min(1)
    assert near.fitness == (distance <= near.max_correspondence_distance).mean()


def test_clouds_are_left_as_they_were() -> None:
    source, target = SOURCE.copy(), TARGET.copy()
    source.setflags(write=False)
    idam.register(source, target)
    np.testing.assert_array_equal(target, TARGET)


# --- same bits -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [0, 7, -1, np.int64(7)])
def test_any_seed_same_bits(result: RegistrationResult, seed: Any) -> None:
    assert_same_bits(idam.register(SOURCE, TARGET, seed=seed), result)


IN_PROCESS = """
import sys
import numpy as np
import idam
for source, target in zip(*[iter(sys.argv[1:])] * 2):
    result = idam.register(np.load(source), np.load(target))
    print(result.transformation.tobytes().hex(), result.matches.weight.tobytes().hex(), repr(result.evidence))
    print(result.information.tobytes().hex(), [each.score.hex() for each in result.hypotheses], result.fitness.hex())
"""


def test_any_number_of_threads_same_bits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clouds = {
        "easy": (SOURCE, move(TRUTH, SOURCE[40:])),
        "hard": (SOURCE[:150], noise(120, seed=1)),
        "many": (bracket(3000, seed=3), move(TRUTH, torus(3000, seed=4))),  # which goes on to the larger clouds
    }
    names: list[str] = []
    for name, pair in clouds.items():
        for role, points in zip(("source", "target"), pair, strict=True):
            names.append(str(tmp_path / f"{name}-{role}.npy"))
            np.save(names[-1], points)
    printed = []
    for threads in ("1", "2"):
        for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
            monkeypatch.setenv(variable, threads)
        done = subprocess.run(
            [sys.executable, "-c", IN_PROCESS, *names], capture_output=True, text=True, timeout=120, check=True
        )
        printed.append(done.stdout)
    assert printed[0].count("\n") == 2 * len(clouds)
    assert printed[0] == printed[1]


def test_prepared_clouds_same_bits(result: RegistrationResult, tmp_path: Path) -> None:
    source, target = idam.prepare(SOURCE), idam.prepare(TARGET)
    assert isinstance(source, Prepared)
    assert_same_bits(idam.register(source, target), result)
    assert_same_bits(idam.register(source, target), result)  # again, with all of it worked out
    assert_same_bits(idam.register(source, TARGET), result)


def test_prepared_clouds_same_bits_whatever_they_were_registered_with_before() -> None:
    source, target = bracket(3000, seed=1), move(TRUTH, bracket(2500, seed=2))
    expected = idam.register(source, target)
    prepared = idam.prepare(source)
    for other in (0.5 * bracket(1500, seed=5), torus(4000, seed=6), target):
        idam.register(prepared, other)
    assert_same_bits(idam.register(prepared, idam.prepare(target)), expected)


def test_prepare_leaves_little_to_do() -> None:
    source, target = (idam.prepare(bracket(3000, seed=seed)) for seed in (1, 2))
    levels = [{size: id(level) for size, level in cloud.levels.items()} for cloud in (source, target)]
    features = [sum(len(level.features) for level in cloud.levels.values()) for cloud in (source, target)]
    assert features == [1, 1]
    idam.register(source, target)
    # nothing that had been made was made anew
    for cloud, before in zip((source, target), levels, strict=True):
        assert before.items() <= {size: id(level) for size, level in cloud.levels.items()}.items()


# --- what it takes -------------------------------------------------------------------------------------------------


def as_torch(points: np.ndarray) -> Any:
    return pytest.importorskip("torch").tensor(points, requires_grad=True)


def as_trimesh(points: np.ndarray) -> Any:
    return pytest.importorskip("trimesh").PointCloud(points)


def as_open3d(points: np.ndarray) -> Any:
    try:
        import open3d
    except (ImportError, OSError) as error:  # its wheel counts on system libraries
        pytest.skip(f"Open3D cannot be imported ({error})")
    return open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))


@pytest.mark.parametrize("kind", [np.ndarray.tolist, PointCloud, np.asfortranarray, as_torch, as_trimesh, as_open3d])
def test_takes(kind: Callable[[np.ndarray], Any], result: RegistrationResult) -> None:
    assert_same_bits(idam.register(kind(SOURCE), kind(TARGET)), result)


def test_takes_paths_of_single_precision(result: RegistrationResult, tmp_path: Path) -> None:
    write_point_cloud(tmp_path / "source.ply", SOURCE)
    found = idam.register(tmp_path / "source.ply", TARGET.astype(np.float32))
    assert_settled(found.transformation, result.transformation, CENTRE)
    found = idam.register(str(tmp_path / "source.ply"), TARGET)
    assert_settled(found.transformation, result.transformation, CENTRE)


@pytest.mark.parametrize("unit", [1e-9, 1e-3, 0.3048, 1000.0, 1e9])
def test_unit_does_not_matter(result: RegistrationResult, unit: float) -> None:
    found = idam.register(unit * SOURCE, unit * TARGET)
    in_our_unit = found.transformation.copy()
    in_our_unit[:3, 3] /= unit
    assert_settled(in_our_unit, result.transformation, CENTRE)
    assert found.max_correspondence_distance == pytest.approx(unit * result.max_correspondence_distance)
    assert found.fitness == pytest.approx(result.fitness, abs=0.01)
    assert found.inlier_rmse == pytest.approx(unit * result.inlier_rmse, rel=0.02)
    assert found.confidence == pytest.approx(result.confidence, abs=0.05)


@pytest.mark.parametrize("unit", [2.0**-20, 0.25, 1024.0])
def test_a_unit_of_a_power_of_two_changes_no_digit(result: RegistrationResult, unit: float) -> None:
    found = idam.register(unit * SOURCE, unit * TARGET)
    np.testing.assert_array_equal(found.transformation[:3, :3], result.transformation[:3, :3])
    np.testing.assert_allclose(found.transformation[:3, 3], unit * result.transformation[:3, 3], rtol=1e-14)
    scale = np.array([1, 1, 1, unit, unit, unit])
    np.testing.assert_allclose(found.information * np.outer(scale, scale), result.information, rtol=1e-9, atol=1e-6)
    assert found.evidence == result.evidence


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


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_turning_the_clouds_turns_the_answer(result: RegistrationResult, seed: int) -> None:
    random = np.random.default_rng(seed)
    turns = [rigid.transform(any_rotation(random), np.zeros(3)) for _ in range(2)]
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


# --- the other way round -------------------------------------------------------------------------------------------

PAIRS = {
    "easy": (SOURCE, TARGET),
    "sizes alike": (SOURCE, move(TRUTH, bracket(400, seed=2))),
    "itself, moved": (SOURCE, move(TRUTH, SOURCE)),
    "dense": (bracket(3000, seed=1), move(TRUTH, bracket(2500, seed=2)) + UTM),
    "nothing in common": (SOURCE, noise(500, 1)),
}


@pytest.mark.parametrize("name", PAIRS)
@pytest.mark.parametrize("options", [{}, {"refine": "point", "max_angle": 130.0}, {"refine": None}], ids=str)
def test_swapping_the_clouds_inverts_the_answer(name: str, options: dict[str, Any]) -> None:
    source, target = PAIRS[name]
    forth, back = idam.register(source, target, **options), idam.register(target, source, **options)
    rotation = forth.transformation[:3, :3]
    np.testing.assert_allclose(back.transformation[:3, :3], rotation.T, rtol=0, atol=1e-9)
    scale = 1 + np.abs(target).max()
    np.testing.assert_allclose(forth.apply(back.apply(target)), target, rtol=0, atol=1e-9 * scale)
    assert back.confidence == forth.confidence
    assert back.evidence == forth.evidence
    assert back.reason == forth.reason
    np.testing.assert_array_equal(back.matches.source, forth.matches.target)
    np.testing.assert_array_equal(back.matches.target, forth.matches.source)
    np.testing.assert_array_equal(back.matches.weight, forth.matches.weight)
    for one, other in zip(back.hypotheses, forth.hypotheses, strict=True):
        np.testing.assert_allclose(rigid.inverse(one.transformation), other.transformation, rtol=0, atol=1e-9 * scale)
        assert one.score == other.score
    assert back.max_correspondence_distance == forth.max_correspondence_distance


def test_a_cloud_on_itself_stays() -> None:
    found = idam.register(SOURCE, SOURCE)
    np.testing.assert_allclose(found.transformation, np.eye(4), atol=1e-9)
    assert found.fitness == 1.0
    assert found.inlier_rmse < 1e-9


def test_swapping_the_clouds_and_the_init_inverts_the_answer() -> None:
    init = motion([0.5, 0.0, 0.0], [1.0, 2.0, 3.0])
    for options in ({"refine": None}, {"max_angle": 20.0}, {}):
        forth = idam.register(SOURCE, TARGET, init=init, **options)
        back = idam.register(TARGET, SOURCE, init=np.linalg.inv(init), **options)
        np.testing.assert_allclose(rigid.inverse(back.transformation), forth.transformation, atol=1e-9)
        assert back.confidence == pytest.approx(forth.confidence, abs=1e-9)


def test_swapped_information_is_that_of_the_inverse() -> None:
    forth, back = idam.register(SOURCE, TARGET), idam.register(TARGET, SOURCE)
    # (T exp(x))^-1 = T^-1 exp(-Ad x): the same change costs the same either way
    for x in np.random.default_rng(0).normal(0, 1e-3, (10, 6)):
        changed = forth.transformation @ rigid.exp(x)
        y = rigid.log(rigid.inverse(back.transformation) @ rigid.inverse(changed))
        assert y @ back.information @ y == pytest.approx(x @ forth.information @ x, rel=1e-6)


def test_moving_the_target_leaves_the_information_and_moving_the_source_carries_it() -> None:
    source, target = bracket(3000, seed=1), move(TRUTH, bracket(2500, seed=2))
    plain = idam.register(source, target, refine="point")
    shift = motion([0.0, 0.0, 0.0], [30.0, -20.0, 10.0])
    moved = idam.register(source, move(shift, target), refine="point")
    np.testing.assert_allclose(moved.information, plain.information, rtol=1e-3, atol=1e-3 * plain.information.max())
    elsewhere = idam.register(move(shift, source), target, refine="point")
    expected = rigid.carried(plain.information, rigid.adjoint(shift))
    np.testing.assert_allclose(elsewhere.information, expected, rtol=1e-3, atol=1e-3 * expected.max())


def test_covariance_is_the_inverse_of_the_information(result: RegistrationResult) -> None:
    np.testing.assert_allclose(result.covariance @ result.information, np.eye(6), atol=1e-6)


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
        (SOURCE, torus(500, 3)),
        (SOURCE, noise(500, 1)),
        (SOURCE, 0.5 * ball(500, 2)),
        (SOURCE, ball(500, 1)),
    ],
    ids=["two spheres", "a torus", "noise", "a small sphere", "a sphere"],
)
def test_not_sure_of_what_turns_freely_or_has_nothing_in_common(source: np.ndarray, target: np.ndarray) -> None:
    found = idam.register(source, target)
    assert found.confidence < CONVERGED
    assert not found.converged
    assert found.reason


@pytest.mark.parametrize("refine", ["gicp", None])
def test_not_sure_of_the_only_answer_in_reach_where_it_is_wrong(refine: Any) -> None:
    found = idam.register(SOURCE, TARGET, init=motion([0.0, 0.0, 0.0], [9.0, 0.0, 0.0]), max_angle=5, refine=refine)
    assert degrees(found.transformation, TRUTH) > 50
    assert found.confidence < CONVERGED


@pytest.fixture(scope="module")
def corridors() -> RegistrationResult:
    """Two scans without noise, three units apart in a corridor that has nothing to tell one place from another."""
    return idam.register(corridor(0.0, 3000, seed=1), corridor(3.0, 3000, seed=2))


def test_not_sure_where_the_scans_slide(corridors: RegistrationResult) -> None:
    assert corridors.confidence < CONVERGED
    assert corridors.reason
    # by what it says, no axis but the corridor's is free
    fixed, along = corridors.strength.fixed, corridors.strength.motions[0]
    assert fixed[0] < 0.03 < fixed[1]
    assert np.abs(along[3:] / np.linalg.norm(along[3:])).argmax() == 0


def test_where_the_scans_slide_runners_up_are_other_places(corridors: RegistrationResult) -> None:
    assert corridors.hypotheses
    apart = [
        (degrees(other.transformation, corridors.transformation), abs(slid(other.transformation, corridors)))
        for other in corridors.hypotheses
    ]
    assert max(angle for angle, _ in apart) > 175  # the other way round
    for angle, shift in apart:
        assert angle > 5 or shift > 2 * corridors.max_correspondence_distance


def slid(transformation: np.ndarray, result: RegistrationResult) -> float:
    """How far along x a transform puts the source's centroid from where the answer does."""
    centroid = result.clouds[0].mean(0)
    return float((move(transformation, centroid) - result.apply(centroid))[0])


@pytest.mark.parametrize("name", ["dense", "nothing in common"])
def test_one_pose_is_not_called_two(name: str) -> None:
    source, target = PAIRS[name]
    found = idam.register(source, target)
    size = Prepared.of(source, "source").radius
    poses = [found.transformation, *(other.transformation for other in found.hypotheses)]
    for n, one in enumerate(poses):
        for other in poses[:n]:
            shift = np.linalg.norm(move(one, source.mean(0)) - move(other, source.mean(0)))
            assert degrees(one, other) > 5 or shift > 0.04 * size


# --- awkward clouds ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("copies", [2, 20])
def test_points_given_more_than_once(result: RegistrationResult, copies: int) -> None:
    found = idam.register(np.repeat(SOURCE, copies, axis=0), np.repeat(TARGET, copies, axis=0))
    assert_right(found, TRUTH, CENTRE)
    assert found.fitness == pytest.approx(result.fitness, abs=0.05)
    assert found.max_correspondence_distance == pytest.approx(result.max_correspondence_distance, rel=0.05)


@pytest.mark.parametrize(("count", "distance"), [(400, 1e3), (400, 1e9), (3000, 1e7)])
@pytest.mark.parametrize("strays", [1, 10])
def test_stray_points_do_no_harm(count: int, distance: float, strays: int, capfd: pytest.CaptureFixture[str]) -> None:
    source = np.vstack([bracket(count, seed=1), distance * ball(strays, seed=3)])
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
    # where in the plane it lies may be anybody's guess, but in the plane it lies
    assert np.abs(move(np.linalg.inv(TRUTH), found.apply(plane))[:, 2]).max() < 0.05


def test_clouds_in_millimetres_and_in_metres_are_told_so() -> None:
    millimetres, metres = 1000 * bracket(3000, seed=1), bracket(3000, seed=3)
    assert re.match(r"source: \d+ times the size of target; if their units differ, scale", refusal(millimetres, metres))
    assert re.match(r"target: \d+ times the size of source; if their units differ, scale", refusal(metres, millimetres))
    assert re.match(r"source: \d+ times the size of target; if their units differ", refusal(1000 * SOURCE, metres))


def test_few_places_many_points() -> None:
    message = refusal(np.repeat(SOURCE[:5], 30, axis=0), TARGET)
    assert message.startswith("source: 5 points are left")


# --- options -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("refine", METHODS)
def test_refinements(refine: Any) -> None:
    found = idam.register(SOURCE, TARGET, refine=refine)
    assert_right(found, TRUTH, CENTRE)
    assert found.information.any()


def test_gicp_is_symmetric_on_few_points_and_not_on_many() -> None:
    few, many = (SOURCE, TARGET), (bracket(1500, seed=1), move(TRUTH, bracket(1500, seed=2)))
    for clouds, alike in ((few, True), (many, False)):
        found, symmetric = (idam.register(*clouds, refine=refine).transformation for refine in ("gicp", "symmetric"))
        assert (found == symmetric).all() == alike


def test_no_refinement(result: RegistrationResult) -> None:
    with_none, with_word = (idam.register(SOURCE, TARGET, refine=refine) for refine in (None, "none"))
    assert_same_bits(with_none, with_word)
    assert degrees(result.transformation, TRUTH) < degrees(with_none.transformation, TRUTH) < 10.0
    rotation = with_none.transformation[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)


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
    matrix = motion(rotation, [1, 2, 3])
    np.testing.assert_allclose(as_rigid(matrix.tolist()), matrix, atol=1e-12)


def test_init_may_be_far_off(result: RegistrationResult) -> None:
    far = motion([3.0, 0.0, 0.0], [50.0, 0.0, -9.0])
    for init in (far, far.tolist()):
        found = idam.register(SOURCE, TARGET, init=init)
        assert_settled(found.transformation, result.transformation, CENTRE)


def test_init_of_clouds_far_from_the_origin() -> None:
    there, back = motion([0, 0, 0], UTM), motion([0, 0, 0], -UTM)
    found = idam.register(SOURCE + UTM, TARGET + UTM, refine=None, init=there @ TRUTH @ back)
    np.testing.assert_allclose(found.apply(SOURCE + UTM), move(TRUTH, SOURCE) + UTM, rtol=0, atol=1e-6)


def test_voxel_size_sets_where_matches_are_sought() -> None:
    source, target = bracket(2000, seed=1), move(TRUTH, bracket(2000, seed=2))
    coarse, fine = (idam.register(1000 * source, 1000 * target, voxel_size=size) for size in (150.0, 60.0))
    assert len(coarse.matches.weight) < len(fine.matches.weight) < 2000
    truth = rigid.transform(TRUTH[:3, :3], 1000 * TRUTH[:3, 3])
    assert_right(fine, truth, 1000 * CENTRE, 1000.0)


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
    figures = [float(figure) for figure in re.findall(r"\d+\.\d+|\d{3,}|\d+e[+-]\d+", message)]
    assert set(figures) <= {3000.0}  # in the caller's unit, if at all


def test_refuses_a_voxel_size_that_leaves_more_than_memory_holds() -> None:
    assert "larger" in refusal(bracket(6000, seed=1), bracket(6000, seed=2), voxel_size=1e-4)


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("model", "nosuch", "gnn-unseen-shapes"),
        ("model", "", "unknown model"),
        ("model", "nosuch.safetensors", "nosuch.safetensors"),
        ("model", 7, "model must be a name or a path, not of the type int"),
        ("max_angle", 0, "max_angle"),
        ("max_angle", -5.0, "max_angle"),
        ("max_angle", 181, "max_angle"),
        ("max_angle", np.nan, "max_angle"),
        ("max_angle", "any", "max_angle"),
        ("refine", "magic", "gicp, plane, point, symmetric or none"),
        ("refine", ["gicp"], "gicp, plane, point, symmetric or none"),
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
        motion([0, 0, 0], [np.inf, 0, 0]),
        motion([0, 0, 0], [1, 2, 3]).T,
        [[1, 2], [3]],
        "identity",
    ],
)
def test_refuses_what_is_not_rigid(init: Any) -> None:
    assert refusal(init=init).startswith("init ")


# --- the shipped scans ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("turn", [[0.0, 0.0, 0.0], [2.0, -1.0, 1.5]], ids=["as shipped", "turned"])
def test_shipped_scans(turn: list[float]) -> None:
    folder = resources.files("idam.demo")
    with resources.as_file(folder / "source.ply") as source, resources.as_file(folder / "target.ply") as target:
        clouds = [read_point_cloud(path).points for path in (source, target)]
    matrix = motion(turn, [0.0, 0.0, 0.0])
    truth = np.loadtxt(str(resources.files("idam.lab.data") / "demo" / "truth.txt")) @ matrix.T
    source_points = move(matrix, clouds[0])
    found = idam.register(source_points, clouds[1])
    assert degrees(found.transformation, truth) < 5.0
    centre = source_points.mean(0)
    assert np.linalg.norm(found.apply(centre) - move(truth, centre)) < 0.01
    assert found.fitness > 0.4
    assert found.confidence > 0.5
