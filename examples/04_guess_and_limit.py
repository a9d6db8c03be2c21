"""A guess, and a limit of the rotation.

`init` is a guess of the transform (4, 4): from a turntable, a GPS, an older result. It is refined and competes with
the other answers; it need not be good.

`max_angle` is the largest rotation of the answer in degrees, from the guess where there is one. A box looks the same
after half a turn, and nothing in two scans of it tells the poses apart. If you know that it turned by less, say so.

On the command line: `idam register scan1.ply scan2.ply --init T.txt --max-angle 60`
"""

import numpy as np

import idam
from idam import rigid
from idam.demo import scans
from idam.rigid import Array

scan1, scan2 = scans()
free = idam.register(scan1, scan2)

guess = free.transformation @ rigid.exp(np.array([0.2, 0.0, 0.1, 0.03, 0.0, 0.02]))  # 13 degrees and 4 cm off
guided = idam.register(scan1, scan2, init=guess, max_angle=30)
away = np.degrees(rigid.angle(free.rotation.T @ guided.rotation))
print(f"from a guess 13 degrees off: {away:.3f} degrees from the answer without one")
assert away < 0.5


def points_on_a_box(seed: int, sides: tuple[float, float, float] = (1.2, 0.8, 0.5), count: int = 700) -> Array:
    """Random points (N, 3) on the surface of a box."""
    random = np.random.default_rng(seed)
    half = np.array(sides) / 2
    areas = np.repeat([half[1] * half[2], half[0] * half[2], half[0] * half[1]], 2)
    face = random.choice(6, count, p=areas / areas.sum())
    points = random.uniform(-half, half, (count, 3))
    points[np.arange(count), face // 2] = np.where(face % 2, 1, -1) * half[face // 2]
    return points


turn = rigid.rotation_exp(np.radians([0.0, 0.0, 37.0]))
box, turned = points_on_a_box(1), points_on_a_box(2) @ turn.T

either = idam.register(box, turned)
print(either)

known = idam.register(box, turned, max_angle=80)
print(known)
assert np.degrees(rigid.angle(turn.T @ known.rotation)) < 5
assert known.confidence > either.confidence
