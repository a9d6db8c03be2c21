"""Poses that a pose may be mistaken for."""

from __future__ import annotations

import numpy as np
import pytest

from idam import rigid
from idam.clouds.surfaces import Surface, Surfaces, spacing_of
from idam.search.overlap import shares
from idam.search.slides import FARTHEST, SLIPPABLE, held, slides, slippage
from motions import degrees, move
from motions import rigid as motion
from solids import ball, bumpy

POSE = motion([0.4, -1.1, 0.7], [0.2, -0.3, 0.1])
ALONG = POSE[:3, :3] @ [1.0, 0.0, 0.0]
"""The corridor's direction in the target's frame."""
FAR = motion([0, 0, 0], [50.0, 0, 0])


def lies(surfaces: Surfaces, pose: np.ndarray) -> float:
    """The geometric mean of the shares of both that lie on the other."""
    return float(np.prod(shares(surfaces, pose)) ** 0.5)


def hall(count: int, seed: int, *, box: bool = False) -> np.ndarray:
    """Two walls and a floor along x, about two units long, points all over them; with a box on the floor or without."""
    random = np.random.default_rng(seed)
    x, across = random.uniform(-1, 1, count), random.uniform(-0.3, 0.3, count)
    wall = random.integers(3, size=count)
    y = np.choose(wall, [np.full(count, -0.3), np.full(count, 0.3), across])
    z = np.choose(wall, [across, across, np.full(count, -0.3)])
    points = np.stack([x, y, z], 1)
    if not box:
        return points
    sides = random.uniform(-0.15, 0.15, (count // 4, 3))
    sides[np.arange(len(sides)), random.integers(3, size=len(sides))] = 0.15
    return np.concatenate([points, sides * random.choice([-1, 1], (len(sides), 1)) + [0.1, 0.0, -0.15]])


def pair(source: np.ndarray, target: np.ndarray) -> Surfaces:
    return Surfaces(Surface.of(source), Surface.of(target), spacing_of(source))


@pytest.fixture(scope="module")
def halls() -> Surfaces:
    return pair(hall(900, 1), move(POSE, hall(900, 2)))


@pytest.fixture(scope="module")
def lumps() -> Surfaces:
    return pair(bumpy(900, 1), move(POSE, bumpy(900, 2)))


# --- slippage ------------------------------------------------------------------------------------------------------


def test_a_corridor_slides_along_itself_and_in_no_other_way(halls: Surfaces) -> None:
    share, motions, _ = slippage(halls, POSE)
    assert (np.diff(share) >= 0).all()
    assert share[0] < SLIPPABLE < share[1]
    assert np.linalg.norm(motions[0, :3]) < 0.05 * np.linalg.norm(motions[0, 3:])  # a shift
    direction = motions[0, 3:] / np.linalg.norm(motions[0, 3:])
    assert abs(direction @ ALONG) > 0.999


def test_a_closed_lump_does_not_slide(lumps: Surfaces) -> None:
    share, _, _ = slippage(lumps, POSE)
    assert share[0] > SLIPPABLE


def test_a_box_on_the_floor_holds_a_corridor_more_firmly(halls: Surfaces) -> None:
    boxed = pair(hall(900, 1, box=True), move(POSE, hall(900, 2, box=True)))
    assert slippage(boxed, POSE)[0][0] > 3 * slippage(halls, POSE)[0][0]


def test_a_ball_turns_freely_about_its_centre() -> None:
    share, motions, centre = slippage(pair(ball(900, 1), move(POSE, ball(900, 2))), POSE)
    assert (share[:3] < SLIPPABLE).all()
    assert share[3] > 5 * SLIPPABLE
    np.testing.assert_allclose(centre, POSE[:3, 3], atol=0.1)
    # turns about the centre, all but rounded off by where the samples lie
    assert (np.linalg.norm(motions[:3, 3:], axis=1) < 0.15 * np.linalg.norm(motions[:3, :3], axis=1)).all()


@pytest.mark.parametrize("name", ["halls", "lumps"])
def test_shares_are_measured_by_moving_a_little(name: str, request: pytest.FixtureRequest) -> None:
    surfaces: Surfaces = request.getfixturevalue(name)
    share, motions, centre = slippage(surfaces, POSE)
    mine, theirs = surfaces.alike(POSE)
    points = move(POSE, surfaces.source.points[mine])
    normals = surfaces.target.normals[theirs]
    step = 1e-5
    for n in range(6):
        moved = rigid.apply(rigid.exp(step * motions[n]), points - centre) + centre
        gap = (moved - points) / step
        assert np.mean((gap * normals).sum(1) ** 2) == pytest.approx(share[n], abs=1e-4)
    # and all move the points about as far
    size = [np.mean(np.linalg.norm(rigid.apply(rigid.exp(step * m), points - centre) + centre - points, axis=1) ** 2)
            for m in motions]  # fmt: skip
    assert max(size) < 6 * min(size)


def test_moving_both_clouds_moves_the_motions_along(halls: Surfaces) -> None:
    turn = motion([1.0, 0.2, -0.5], [0.3, 0.0, -0.2])
    moved = pair(halls.source.points, move(turn, halls.target.points))
    (share, motions, centre), (other, carried, there) = slippage(halls, POSE), slippage(moved, turn @ POSE)
    np.testing.assert_allclose(other, share, atol=1e-6)
    np.testing.assert_allclose(there, move(turn, centre[None])[0], atol=1e-9)
    direction, along = turn[:3, :3] @ motions[0, 3:], carried[0, 3:]
    assert abs(direction @ along) == pytest.approx(np.linalg.norm(direction) * np.linalg.norm(along), rel=1e-4)


def test_where_nothing_touches_nothing_is_known(halls: Surfaces) -> None:
    share, motions, centre = slippage(halls, FAR @ POSE)
    assert (share.shape, motions.shape, centre.shape) == ((0,), (0, 6), (3,))
    assert slides(halls, FAR @ POSE).shape == (0, 4, 4)


# --- the poses -----------------------------------------------------------------------------------------------------


def test_a_lump_has_none(lumps: Surfaces) -> None:
    assert slides(lumps, POSE).shape == (0, 4, 4)


def test_slid_poses_leave_the_surface_on_itself(halls: Surfaces) -> None:
    poses = slides(halls, POSE)
    assert len(poses) > 20
    np.testing.assert_allclose(
        poses[:, :3, :3] @ poses[:, :3, :3].swapaxes(1, 2), np.eye(3)[None].repeat(len(poses), 0), atol=1e-9
    )
    straight = poses[[degrees(pose, POSE) < 5 for pose in poses]]
    shift = (straight[:, :3, 3] - POSE[:3, 3]) @ ALONG
    off = np.linalg.norm((straight[:, :3, 3] - POSE[:3, 3]) - shift[:, None] * ALONG, axis=1)
    # either way, as far as the larger cloud is wide, along the corridor
    assert shift.max() == pytest.approx(FARTHEST, abs=0.1)
    assert shift.min() == pytest.approx(-FARTHEST, abs=0.1)
    assert (off < 0.1 * FARTHEST).all()
    # what still lies beside each other touches: the hall is two units long
    for pose, far in zip(straight, np.abs(shift), strict=True):
        assert lies(halls, pose) > 0.6 * (1 - far / 2) * lies(halls, POSE)


def test_half_turns_are_among_them_and_swapping_ends_lays_the_walls_on_each_other(halls: Surfaces) -> None:
    poses = slides(halls, POSE)
    turned = poses[:3]
    for pose in turned:
        assert degrees(pose, POSE) == pytest.approx(180.0, abs=1e-3)
    # about the vertical the two walls change places, and the floor stays
    fits = [lies(halls, pose) for pose in turned]
    assert max(fits) > 0.7 * lies(halls, POSE)
    best = turned[int(np.argmax(fits))]
    assert degrees(best, POSE @ motion([0, 0, np.pi], [0, 0, 0])) < 8
    # and each half turn is slid, too
    others = [pose for pose in poses[3:] if degrees(pose, best) < 5]
    assert len(others) > 10


def test_what_turns_is_turned_all_the_way() -> None:
    random = np.random.default_rng(0)
    angle, height = random.uniform(0, 2 * np.pi, (2, 900)), random.uniform(-0.8, 0.8, (2, 900))
    tubes = [np.stack([0.5 * np.cos(a), 0.5 * np.sin(a), h], 1) for a, h in zip(angle, height, strict=True)]
    poses = slides(pair(tubes[0], move(POSE, tubes[1])), POSE)
    turns = np.array([degrees(pose, POSE) for pose in poses])
    axis = np.array([abs((POSE[:3, :3].T @ pose[:3, :3])[2, 2]) for pose in poses])
    about = turns[axis > 0.99]  # about the tube's own axis
    assert len(about) > 10
    assert about.max() > 175
    assert about[about > 1].min() < 30


def test_none_is_stepped_over_faster_than_the_spacing(halls: Surfaces) -> None:
    sparse = Surfaces(halls.source, halls.target, 0.4)
    assert 3 < len(slides(sparse, POSE)) < len(slides(halls, POSE))


# --- where it is held ----------------------------------------------------------------------------------------------


def along_by(pose: np.ndarray, far: float) -> np.ndarray:
    slid = pose.copy()
    slid[:3, 3] += far * ALONG
    return slid


def posts(seed: int) -> np.ndarray:
    """A corridor with three posts on its floor, unevenly apart: one point in fifty."""
    random = np.random.default_rng(seed)
    place = random.choice([-0.6, -0.1, 0.55], 60)
    points = np.stack([place, np.zeros(60), random.uniform(-0.3, 0.0, 60)], 1) + random.normal(0, 0.004, (60, 3))
    return np.concatenate([hall(3000, seed), points])


@pytest.fixture(scope="module")
def posted() -> Surfaces:
    return pair(posts(1), move(POSE, posts(2)))


@pytest.mark.parametrize("far", [-0.5, -0.2, 0.1, 0.35])
def test_a_slid_pose_goes_back_to_where_the_posts_agree(posted: Surfaces, far: float) -> None:
    back = held(posted, posted, along_by(POSE, far))
    np.testing.assert_allclose(back[:3, :3], POSE[:3, :3], atol=1e-9)
    assert np.linalg.norm(back[:3, 3] - POSE[:3, 3]) < 1.5 * posted.spacing


def test_a_pose_under_which_the_posts_agree_stays(posted: Surfaces) -> None:
    np.testing.assert_array_equal(held(posted, posted, POSE), POSE)


def test_where_nothing_holds_or_nothing_slides_a_pose_stays(halls: Surfaces, lumps: Surfaces) -> None:
    for surfaces in (halls, lumps):
        pose = along_by(POSE, 0.2)
        np.testing.assert_array_equal(held(surfaces, surfaces, pose), pose)
