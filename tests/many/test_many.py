"""Merging from end to end: real registrations of few scans, and made-up ones where these would take long."""

from __future__ import annotations

import json
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

import idam
from idam import rigid
from idam.errors import InputError
from idam.io import PointCloud, write_point_cloud
from idam.many.merge import merge
from many.worlds import Registers, World, world


@pytest.fixture
def object_(monkeypatch: pytest.MonkeyPatch) -> tuple[World, Registers]:
    """Six scans of an object, registered right."""
    made = world(6, points=800)
    return made, replaced(monkeypatch, Registers(made))


def replaced(monkeypatch: pytest.MonkeyPatch, registers: Registers) -> Registers:
    monkeypatch.setattr("idam.registration.register", registers)
    return registers


def test_scans_of_one_object_come_together() -> None:
    made = world(4, seed=3)
    result = idam.merge(made.scans)
    assert result.components == [[0, 1, 2, 3]]
    assert made.errors(result.poses, [0, 1, 2, 3]).max() < 0.05
    np.testing.assert_array_equal(result.poses[0], np.eye(4))
    assert (result.confidence >= 0.9).all()


def test_scans_of_two_objects_are_two_components() -> None:
    one, other = (world(2, seed=seed, points=900, seen=0.8) for seed in (3, 4))
    result = idam.merge([*one.scans, *other.scans])
    assert sorted(sorted(scans) for scans in result.components) == [[0, 1], [2, 3]]
    assert one.errors(result.poses, [0, 1]).max() < 0.05
    assert other.errors(result.poses[2:], [0, 1]).max() < 0.05
    assert not result.complete


def test_a_scan_given_twice_lies_on_itself() -> None:
    made = world(2, seed=3)
    copy = rigid.exp(np.array([0.3, -0.2, 1.0, 2.0, 0, 1]))
    result = idam.merge([*made.scans, rigid.apply(copy, made.scans[0])])
    assert len(result.components[0]) == 3
    np.testing.assert_allclose(result.poses[2] @ copy, np.eye(4), atol=0.02)


def test_the_joint_refinement_undoes_noise(object_: tuple[World, Registers], monkeypatch: pytest.MonkeyPatch) -> None:
    made = world(6, points=3000)
    replaced(monkeypatch, Registers(made, noise=0.02))
    refined = merge(made.scans)
    monkeypatch.setattr("idam.many.joint.refine", lambda poses, *_: poses)
    rough = merge(made.scans)
    scans = list(range(6))
    assert made.errors(refined.poses, scans).max() < 0.4 * made.errors(rough.poses, scans).max()


def test_units_and_far_coordinates_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    made = world(5, points=800)
    replaced(monkeypatch, Registers(made))
    near = merge(made.scans)
    shift = rigid.transform(np.eye(3), [5e5, 4e6, 100.0])
    far = World([rigid.apply(shift, scan) for scan in made.scans], made.poses @ rigid.inverse(shift))
    replaced(monkeypatch, Shifted(made, far, shift))
    away = merge(far.scans)
    assert away.components == near.components
    for one, other in zip(near.poses, away.poses, strict=True):
        moved = rigid.apply(shift @ one @ rigid.inverse(shift), far.scans[0][:10])
        np.testing.assert_allclose(rigid.apply(other, far.scans[0][:10]), moved, atol=1e-4)


class Shifted(Registers):
    """The registrations of scans that were moved: each frame by the same shift."""

    def __init__(self, made: World, far: World, shift: np.ndarray):
        super().__init__(made)
        self._numbers = {scan[0].tobytes(): number for number, scan in enumerate(far.scans)}
        self._shift = shift

    def __call__(self, source, target, **options):
        result = super().__call__(source, target, **options)
        result.transformation = self._shift @ result.transformation @ rigid.inverse(self._shift)
        there = rigid.adjoint(rigid.inverse(self._shift))
        result.information = there.T @ result.information @ there
        return result


def test_every_pair_of_few_scans_is_registered_once(object_: tuple[World, Registers]) -> None:
    made, registers = object_
    result = merge(made.scans)
    assert sorted(registers.calls) == list(combinations(range(6), 2))
    assert [(link.source, link.target) for link in result.links] == list(combinations(range(6), 2))
    assert all(link.used for link in result.links)
    assert result.complete


def test_a_wrong_link_is_rejected_and_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    made = world(6, points=800)
    replaced(monkeypatch, Registers(made, wrong={(0, 3): 0.8, (1, 4): 0.2}))
    result = merge(made.scans)
    rejected = {(link.source, link.target): link for link in result.links if not link.used}
    assert set(rejected) == {(0, 3), (1, 4)}
    assert all("off by" in link.reason for link in rejected.values())
    assert rejected[0, 3].loop_error is not None
    assert rejected[0, 3].loop_error[0] > 5
    assert made.errors(result.poses, list(range(6))).max() < 0.02


def test_many_scans_get_likely_partners_in_linear_number(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("idam.many.choice.ALL_PAIRS", 8)
    monkeypatch.setattr("idam.many.choice.PARTNERS", 3)
    for count in (8, 9, 18):
        made = world(count, points=160)
        registers = replaced(monkeypatch, Registers(made))
        result = merge(made.scans)
        assert len(registers.calls) == len(set(registers.calls)) == len(result.links)
        most = count * (count - 1) / 2 if count == 8 else 3 * count
        assert count - 1 <= len(registers.calls) <= most


def test_unsure_scans_look_for_more_partners(monkeypatch: pytest.MonkeyPatch) -> None:
    made = world(8, points=160)
    wrong = {pair: 0.1 for pair in combinations(range(8), 2) if 7 in pair}
    registers = replaced(monkeypatch, Registers(made, wrong=wrong))
    merge(made.scans, partners=1)
    assert sum(7 in pair for pair in registers.calls) > sum(0 in pair for pair in registers.calls) - 2
    assert sum(7 in pair for pair in registers.calls) >= 3


def test_broken_scans_cost_the_others_nothing(object_: tuple[World, Registers], tmp_path: Path) -> None:
    made, _ = object_
    empty = tmp_path / "empty.ply"
    empty.write_bytes(b"")
    broken = np.full((100, 3), np.nan)
    result = merge([made.scans[0], empty, *made.scans[1:], broken])
    assert result.names[1] == "empty.ply"
    assert "empty" in result.reason[1]
    assert result.poses[1] is None
    assert result.poses[7] is None
    assert result.component_of(1) == -1
    assert len(result.components[0]) == 6
    assert not result.complete
    with pytest.raises(InputError, match="empty"):
        merge([*made.scans, empty], strict=True)


def test_one_broken_file_among_twenty_scans_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    made = world(20, points=200)
    replaced(monkeypatch, Registers(made))
    without = merge(made.scans)
    broken = tmp_path / "broken.ply"
    broken.write_text("ply\nformat ascii 1.0\nelement vertex 9\n")
    result = merge([*made.scans[:7], broken, *made.scans[7:]])
    assert "broken.ply" in result.reason[7]
    assert result.poses[7] is None
    assert len(result.components[0]) == 20
    for one, other in zip(without.poses, result.poses[:7] + result.poses[8:], strict=True):
        np.testing.assert_array_equal(one, other)
    with pytest.raises(InputError, match=r"broken\.ply"):
        merge([*made.scans, broken], strict=True)


def test_a_registration_that_fails_costs_the_others_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    made = world(5, points=800)
    good = Registers(made)

    def register(source, target, **options):
        result = good(source, target, **options)
        if 2 in good.calls[-1]:
            raise ValueError("no answer")
        return result

    monkeypatch.setattr("idam.registration.register", register)
    result = merge(made.scans)
    assert sorted(result.components[0]) == [0, 1, 3, 4]
    assert result.poses[2] is None
    assert "no answer" in result.reason[2]


def test_reference_gives_the_frame(object_: tuple[World, Registers]) -> None:
    made, _ = object_
    for reference in (3, "scan003"):
        result = merge(made.scans, reference=reference)
        np.testing.assert_array_equal(result.poses[3], np.eye(4))
        assert result.components[0][0] == 3
        np.testing.assert_allclose(result.poses[0], made.truth(0, 3), atol=0.02)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"reference": "nobody"}, "nobody"),
        ({"reference": 17}, "scans 0 to 5"),
        ({"partners": 0}, "partners"),
        ({"jobs": 0}, "jobs"),
        ({"jobs": 1.5}, "jobs"),
        ({"threshold": 1.0}, "threshold"),
        ({"voxel_size": -1.0}, "voxel_size"),
        ({"poses": {"scan000": 2 * np.eye(4)}}, "rigid"),
    ],
)
def test_bad_options_are_refused(object_: tuple[World, Registers], options: dict, words: str) -> None:
    made, registers = object_
    with pytest.raises(InputError, match=words):
        merge(made.scans, **options)
    assert registers.calls == []


def test_fewer_than_two_scans_or_one_given_twice_are_refused(tmp_path: Path, object_: tuple[World, Registers]) -> None:
    made, _ = object_
    with pytest.raises(InputError, match="at least 2"):
        merge(made.scans[:1])
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        write_point_cloud(tmp_path / folder / "scan.ply", made.scans[0])
    result = merge([tmp_path / "a" / "scan.ply", tmp_path / "b" / "scan.ply"])
    assert result.names == ["a/scan.ply", "b/scan.ply"]
    with pytest.raises(InputError, match="2 scans have this name"):
        merge([tmp_path / "a" / "scan.ply", tmp_path / "b" / ".." / "a" / "scan.ply"])
    (tmp_path / "none").mkdir()
    with pytest.raises(InputError, match="no file of a point cloud"):
        merge(tmp_path / "none")


def guessed(registers: Registers) -> dict[tuple[int, int], np.ndarray]:
    """The pairs that were registered from a starting pose, and from which."""
    asked = zip(registers.calls, registers.options, strict=True)
    return {pair: np.array(options["init"]) for pair, options in asked if "init" in options}


def test_what_starting_poses_put_on_each_other_is_registered_first_and_may_be_enough(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made = world(12, points=800, seen=0.35)
    registers = replaced(monkeypatch, Registers(made))
    anywhere = rigid.exp(np.array([0.3, 1.0, -2.0, 5.0, 6.0, 7.0]))
    result = merge(made.scans, poses={f"scan{i:03d}": anywhere @ pose for i, pose in enumerate(made.poses)})
    assert len(registers.calls) < 45  # of 66
    assert result.complete
    assert set(guessed(registers)) == set(registers.calls)
    for pair, init in guessed(registers).items():
        np.testing.assert_allclose(init, made.truth(*pair), atol=1e-9)


def test_pairs_without_two_starting_poses_have_no_guess(object_: tuple[World, Registers]) -> None:
    made, registers = object_
    merge(made.scans, poses={f"scan{i:03d}": made.poses[i] for i in (1, 2, 4)})
    assert set(guessed(registers)) <= {(1, 2), (1, 4), (2, 4)}
    assert len(guessed(registers)) >= 2
    assert set(registers.calls) == set(combinations(range(6), 2))


def test_starting_poses_that_are_not_borne_out_cost_no_pair(object_: tuple[World, Registers]) -> None:
    made, registers = object_
    without = merge(made.scans)
    registers.calls.clear()
    poses = {f"scan{i:03d}": pose for i, pose in enumerate(made.poses)}
    poses["scan002"], poses["scan003"] = poses["scan003"], poses["scan002"]
    result = merge(made.scans, poses=poses)
    assert {pair for pair in combinations(range(6), 2) if {2, 3} & set(pair)} <= set(registers.calls)
    scans = list(range(6))
    assert len(result.components) == 1
    assert made.errors(result.poses, scans).max() < 2 * made.errors(without.poses, scans).max() + 1e-3


def test_a_wrong_starting_pose_costs_nothing() -> None:
    made = world(4, seed=3)
    poses = {f"scan{i:03d}": pose for i, pose in enumerate(made.poses)}
    poses["scan001"] = poses["scan001"] @ rigid.exp(np.array([0, 0.4, 1.0, 0.2, 0, 0]))
    result = idam.merge(made.scans, poses=poses)
    assert result.components == [[0, 1, 2, 3]]
    assert made.errors(result.poses, [0, 1, 2, 3]).max() < 0.05
    assert (result.confidence >= 0.9).all()


def ptx(scans: list[np.ndarray], poses: np.ndarray) -> str:
    """Scans with their poses as a PTX file."""
    lines = []
    for scan, pose in zip(scans, poses, strict=True):
        lines += [str(len(scan)), "1", "0 0 0", "1 0 0", "0 1 0", "0 0 1"]
        lines += [" ".join(map(repr, row)) for row in pose.T.tolist()]
        lines += [" ".join(map(repr, [*point, 0.5])) for point in scan.tolist()]
    return "\n".join(lines) + "\n"


def test_poses_in_a_file_are_starting_poses(object_: tuple[World, Registers], tmp_path: Path) -> None:
    made, registers = object_
    file = tmp_path / "site.ptx"
    file.write_text(ptx(made.scans, made.poses))
    result = merge(file)
    assert result.names == [f"site.ptx#{i}" for i in range(1, 7)]
    assert result.complete
    assert set(guessed(registers)) == set(registers.calls)
    for pair, init in guessed(registers).items():
        np.testing.assert_allclose(init, made.truth(*pair), atol=1e-9)
    registers.calls.clear()
    registers.options.clear()
    merge(file, poses={})  # what is given counts instead
    assert guessed(registers) == {}
    registers.calls.clear()
    registers.options.clear()
    file.write_text(ptx(made.scans, np.tile(np.eye(4), (6, 1, 1))))  # never registered
    merge(file)
    assert guessed(registers) == {}
    assert len(registers.calls) == 15


def test_a_stopped_run_goes_on_from_the_pairs_it_has(object_: tuple[World, Registers], tmp_path: Path) -> None:
    made, registers = object_
    kept = tmp_path / "pairs.jsonl"
    first = merge(made.scans, keep=kept)
    lines = kept.read_text().splitlines(keepends=True)
    assert len(lines) == 15
    kept.write_text("".join(lines[:9]) + lines[9][: len(lines[9]) // 2])  # killed while it wrote
    registers.calls.clear()
    again = merge(made.scans, keep=kept)
    assert len(registers.calls) == 6
    np.testing.assert_array_equal(np.stack(first.poses), np.stack(again.poses))
    registers.calls.clear()
    merge(made.scans[::-1], keep=kept, voxel_size=0.1)  # other options: nothing to go on from
    assert len(registers.calls) == 15


def test_pairs_in_other_processes_are_the_same() -> None:
    made = world(2, seed=3, points=600, seen=0.8)
    one, other = (merge(made.scans, jobs=jobs) for jobs in (1, 2))
    np.testing.assert_array_equal(np.stack(one.poses), np.stack(other.poses))


def test_merged_has_each_place_once(object_: tuple[World, Registers]) -> None:
    made, _ = object_
    random = np.random.default_rng(0)
    clouds = [PointCloud(scan, random.integers(0, 256, scan.shape, dtype=np.uint8), scan) for scan in made.scans]
    result = merge(clouds)
    cloud = result.merged(0.1)
    cells = np.floor((cloud.points - cloud.points.min(0)) / 0.1 + 1e-9)
    assert len(np.unique(cells, axis=0)) > 0.8 * len(cloud.points)  # means near a border may round across it
    assert len(cloud.points) < sum(map(len, made.scans)) / 2
    assert cloud.colors is not None
    np.testing.assert_allclose(np.linalg.norm(cloud.normals, axis=1), 1, atol=1e-6)
    assert set(cloud.attributes["scan"].tolist()) <= set(range(6))
    assert merge([*clouds[:5], made.scans[5]]).merged().colors is None


def test_starting_values_of_the_result_are_plain(object_: tuple[World, Registers]) -> None:
    made, _ = object_
    result = merge(made.scans)
    json.dumps([float(value) for value in result.confidence])
    assert result.names == [f"scan{i:03d}" for i in range(6)]
    assert all(pose.shape == (4, 4) and pose.dtype == np.float64 for pose in result.poses)


SHARED = Path(__file__).resolve().parents[3] / "shared" / "scans" / "bunny"
"""Beside the project."""


@pytest.mark.skipif(not SHARED.is_dir(), reason="the bunny's scans are not there: shared/scans/bunny")
def test_the_bunny_comes_together_in_any_pose() -> None:
    from idam.io import read_point_cloud

    names = ["bun000.ply", "bun045.ply", "bun090.ply", "top3.ply"]
    random = np.random.default_rng(0)
    turns = rigid.exp(np.concatenate([random.normal(scale=1.5, size=(4, 3)), random.normal(scale=0.1, size=(4, 3))], 1))
    clouds = [
        rigid.apply(turn, read_point_cloud(SHARED / name).points) for turn, name in zip(turns, names, strict=True)
    ]
    result = merge(clouds)
    assert result.complete
    checked = 0
    for pair in json.loads((SHARED / "pairs.json").read_text())["pairs"]:
        if {pair["source"], pair["target"]} <= set(names):
            i, j = names.index(pair["source"]), names.index(pair["target"])
            truth = turns[j] @ np.array(pair["transformation"]) @ rigid.inverse(turns[i])
            centre = clouds[i].mean(0)[None]
            relative = rigid.inverse(result.poses[j]) @ result.poses[i]
            assert np.degrees(rigid.angle(rigid.inverse(truth) @ relative)) < 2
            assert np.linalg.norm(rigid.apply(truth, centre) - rigid.apply(relative, centre)) < 0.002
            checked += 1
    assert checked
