"""Where a scan was taken from, and what it saw through."""

from __future__ import annotations

import numpy as np
import pytest

from idam import rigid
from idam.clouds.surfaces import Surface
from idam.clouds.viewpoint import FEWEST, SLACK, DepthMap, FreeSpace, seen_from
from motions import move
from motions import rigid as motion
from rooms import BALLS, WALLS, Ball, rays, room, to_ball, to_walls
from solids import bracket, noise, potato, shell

ORIGIN = np.zeros(3)
ELSEWHERE = np.array([1.5, 0.6, 0.1])
POSE = motion([0.3, -0.1, 1.2], [4.0, -2.0, 0.5])
COUNT = 12_000


def walls_evenly(count: int, seed: int = 0) -> np.ndarray:
    """Points all over a room's walls, as a model has them."""
    random = np.random.default_rng(seed)
    low, high = np.array(WALLS[0]), np.array(WALLS[1])
    size = high - low
    area = np.repeat([size[1] * size[2], size[2] * size[0], size[0] * size[1]], 2)
    axis, far = np.divmod(random.choice(6, count, p=area / area.sum()), 2)
    points = random.uniform(low, high, (count, 3))
    points[np.arange(count), axis] = np.where(far == 1, high[axis], low[axis])
    return points


@pytest.fixture(scope="module")
def seen() -> DepthMap:
    return DepthMap.of(Surface.of(room(COUNT)), ORIGIN)


def true_depth(eye: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """How far a ray goes until it meets a wall or a ball."""
    balls = [to_ball(eye, direction, np.array(centre), radius) for centre, radius in BALLS]
    return np.min([to_walls(eye, direction), *balls], axis=0)


# --- whether a cloud is what one place sees ------------------------------------------------------------------------


def single(points: np.ndarray, eye: np.ndarray) -> bool:
    """Whether points are what one place sees, thinned as they are registered or not."""
    return seen_from(points, Surface.of(points), eye)


@pytest.mark.parametrize("eye", [ORIGIN, ELSEWHERE], ids=["the origin", "elsewhere"])
@pytest.mark.parametrize("count", [2000, COUNT])
def test_a_scan_is_known_from_where_it_was_taken(eye: np.ndarray, count: int) -> None:
    assert single(room(count, eye), eye)


def test_flat_ground_far_away_is_one_surface() -> None:
    # rings of a spinning LiDAR: next to each other lie points of very different distance
    down, around = np.radians(np.linspace(2.0, 25.0, 24)), np.linspace(0, 2 * np.pi, 720, endpoint=False)
    tilt, turn = (axis.ravel() for axis in np.meshgrid(down, around))
    ray = np.stack([np.cos(tilt) * np.cos(turn), np.cos(tilt) * np.sin(turn), -np.sin(tilt)], 1)
    assert single(1.8 / np.sin(tilt)[:, None] * ray, ORIGIN)


def test_a_room_whose_points_are_spread_evenly_is_a_model() -> None:
    assert not single(walls_evenly(COUNT), ORIGIN)


@pytest.mark.parametrize("model", [shell, potato, bracket, noise])
@pytest.mark.parametrize("eye", [[0.0, 0.0, 0.0], [0.0, 0.0, -4.0]], ids=["within", "without"])
def test_models_are_not_what_one_place_sees(model: object, eye: list[float]) -> None:
    assert not single(model(5000, 1), np.array(eye))  # type: ignore[operator]


def test_scans_from_two_places_in_one_frame_are_not_what_one_place_sees() -> None:
    balls: list[Ball] = [([1.8, -1.0, 0.0], 0.6), ([0.0, -2.0, 0.0], 0.6), ([-1.0, 0.8, 0.0], 0.4)]
    eye = np.array([4.0, -2.5, 0.0])
    one, other = room(COUNT, balls=balls), room(COUNT, eye, seed=1, balls=balls)
    assert single(one, ORIGIN)
    assert single(other, eye)
    for place in (ORIGIN, eye):
        assert not single(np.concatenate([one, other]), place)


def test_a_scan_seen_from_somewhere_else_is_refused() -> None:
    assert not single(room(COUNT), np.array([40.0, 10.0, 3.0]))


@pytest.mark.parametrize("count", [10, 20, 60])
def test_a_few_points_say_nothing(count: int) -> None:
    assert not single(room(count), ORIGIN)


def test_the_eye_itself_is_not_something_seen(seen: DepthMap) -> None:
    with_returns_of_nothing = Surface.of(np.concatenate([np.zeros((1, 3)), room(COUNT)]))
    assert len(DepthMap.of(with_returns_of_nothing, ORIGIN).points) == len(seen.points)
    assert seen.seen_through(np.zeros((5, 3)), 0.01) == (0, 0)


# --- what lies in front --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("share", "in_front"), [(0.2, True), (0.4, True), (1.0, False), (1.2, False), (3.0, False)])
def test_points_in_front_are_counted_and_those_on_and_behind_are_not(
    seen: DepthMap, share: float, in_front: bool
) -> None:
    # along rays to the walls well beside the balls, whose depth is one surface's
    direction = rays(4000, seed=1)
    beside = np.ones(len(direction), bool)
    for centre, radius in BALLS:
        beside &= ~np.isfinite(to_ball(ORIGIN, direction, np.array(centre), 2.5 * radius))
    points = share * true_depth(ORIGIN, direction)[beside, None] * direction[beside]
    front, behind = seen.seen_through(points, 0.05)
    assert front + behind > 0.6 * len(points)  # in the other directions too little was seen
    # in a corner, two or three points take its edge for a surface
    assert (behind if in_front else front) <= 0.001 * len(points)


def test_a_margin_is_left_and_a_share_of_the_distance() -> None:
    # one wall, looked at straight and at a slant
    across = np.stack(np.meshgrid(np.linspace(-3, 3, 121), np.linspace(-3, 3, 121)), -1).reshape(-1, 2)
    wall = DepthMap.of(Surface.of(np.c_[across, np.full(len(across), 2.0)]), ORIGIN)
    for ray in ([0.01, 0.02, 1.0], [0.6, 0.3, 1.0]):
        hit = 2.0 * np.array(ray)
        for margin in (0.2, 0.5):  # off the plane, not along the ray
            for gap, front in ((1.01 * margin, 1), (0.99 * margin, 0)):
                assert wall.seen_through(hit[None] * (2.0 - gap) / 2.0, margin) == (front, 1 - front)
        for share, front in ((0.99 * SLACK, 0), (2 * SLACK, 1)):  # the nearest of some rays is a little shorter
            assert wall.seen_through(hit[None] * (1 - share), 0.0) == (front, 1 - front)


def test_a_low_box_on_the_ground_far_away_is_in_front_of_it() -> None:
    # rays that come down at a slant hit the ground every half metre and more: their lengths alone hide the box
    down, around = np.radians(np.linspace(4.0, 30.0, 60)), np.radians(np.linspace(-40, 40, 400))
    tilt, turn = (axis.ravel() for axis in np.meshgrid(down, around))
    ray = np.stack([np.cos(tilt) * np.cos(turn), np.cos(tilt) * np.sin(turn), -np.sin(tilt)], 1)
    ground = DepthMap.of(Surface.of(1.8 / np.sin(tilt)[:, None] * ray), ORIGIN)
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(10, 11, 11), np.linspace(-0.5, 0.5, 11)))
    box, road = (np.stack([x, y, np.full_like(x, height - 1.8)], 1) for height in (0.4, 0.0))
    assert ground.seen_through(box, 0.2) == (len(box), 0)
    assert ground.seen_through(road, 0.2) == (0, len(road))


def test_what_no_ray_comes_near_is_not_seen(seen: DepthMap) -> None:
    half = Surface.of(room(COUNT)[room(COUNT)[:, 0] > 0.2])
    behind = 0.3 * room(500, seed=2)
    behind = behind[behind[:, 0] < -0.1]
    assert DepthMap.of(half, ORIGIN).seen_through(behind, 0.01) == (0, 0)
    assert seen.seen_through(behind, 0.01)[0] > 0.9 * len(behind)


# --- two scans -----------------------------------------------------------------------------------------------------


def pair(balls: list[Ball] | None = None) -> FreeSpace:
    """One room from two places, each in its scanner's frame; its balls may have moved before the second scan."""
    source = room(COUNT, ORIGIN)
    target = move(POSE, room(COUNT, ELSEWHERE, seed=1, balls=balls))
    eye = move(POSE, ELSEWHERE[None])[0]
    return FreeSpace.of(Surface.of(source), Surface.of(target), (ORIGIN, eye), 0.05)


@pytest.fixture(scope="module")
def space() -> FreeSpace:
    return pair()


def test_the_truth_puts_nothing_where_a_scan_saw_through(space: FreeSpace) -> None:
    assert space.source_depth is not None
    assert space.target_depth is not None
    assert space.violation(POSE) == 0.0


def test_objects_that_have_moved_and_wrong_poses_show(space: FreeSpace) -> None:
    moved = pair([([2.5, -0.2, -0.2], 0.5), BALLS[1]])
    shares = [moved.violation(POSE)]
    for shift in (0.2, 0.6, 1.5):
        shares.append(space.violation(POSE @ motion([0, 0, 0], [shift, 0.0, 0.0])))
    assert shares[0] > 0.002
    assert 0.0 < shares[1] < shares[2] < shares[3] < 1.0


def test_it_is_the_share_of_both_clouds_points_in_seen_directions(space: FreeSpace) -> None:
    pose = POSE @ motion([0.1, 0.0, 0.3], [0.5, 0.2, 0.0])
    assert space.source_depth is not None
    assert space.target_depth is not None
    there = space.target_depth.seen_through(move(pose, space.source), space.margin)
    back = space.source_depth.seen_through(move(np.linalg.inv(pose), space.target), space.margin)
    counts = np.array(there) + np.array(back)
    assert space.violation(pose) == counts[0] / counts.sum()
    assert counts[0] > 100


def test_swapping_source_and_target_changes_nothing(space: FreeSpace) -> None:
    swapped = FreeSpace(space.target, space.source, space.target_depth, space.source_depth, space.margin)
    for pose in (POSE, POSE @ motion([0.0, 0.4, 0.0], [0.3, 0.0, 0.2])):
        assert swapped.violation(rigid.inverse(pose)) == space.violation(pose)


def test_what_only_one_scan_s_place_tells_is_told(space: FreeSpace) -> None:
    wrong = POSE @ motion([0, 0, 0], [1.0, 0.0, 0.0])
    for source_depth, target_depth in ((space.source_depth, None), (None, space.target_depth)):
        one = FreeSpace(space.source, space.target, source_depth, target_depth, space.margin)
        assert one.violation(POSE) == 0.0
        assert one.violation(wrong) > 0.01


def test_where_nothing_is_known_nothing_is_violated(space: FreeSpace) -> None:
    wrong = POSE @ motion([0, 0, 0], [1.0, 0.0, 0.0])
    assert FreeSpace(space.source, space.target, None, None, space.margin).violation(wrong) == 0.0
    few = FreeSpace(0.1 * room(FEWEST - 1), space.target[:0], None, space.source_depth, 0.0)
    assert few.violation(np.eye(4)) == 0.0
    enough = FreeSpace(0.1 * room(3 * FEWEST), space.target[:0], None, space.source_depth, 0.0)
    assert enough.violation(np.eye(4)) == 1.0
