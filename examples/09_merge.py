"""Many scans, one model.

`idam.merge` takes scans in any pose and order to one model. Each scan has a pose, a confidence and, where its place
is doubtful, the reason. [Many scans](merge.md) has the command `idam merge`.

Here four views of a lumpy object, made up, each turned at random.
"""

import numpy as np

import idam
from idam import rigid
from idam.result import chance
from idam.rigid import Array


def views(count: int, points: int) -> tuple[list[Array], Array]:
    """Scans of an object from around it, and their true poses (count, 4, 4)."""
    random = np.random.default_rng(3)
    axes = random.normal(size=(25, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    heights, widths = random.uniform(-0.15, 0.4, 25), random.uniform(6, 60, 25)
    scans, poses = [], []
    for view in range(count):
        direction = random.normal(size=(points, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        surface = direction * (0.6 + (heights * np.exp(widths * (direction @ axes.T - 1))).sum(1))[:, None]
        angle = np.pi / 5 * view
        seen = surface[surface @ [np.cos(angle), np.sin(angle), 0.0] > 0]
        pose = rigid.exp(random.normal(scale=[1.5] * 3 + [0.5] * 3))
        scans.append(rigid.apply(rigid.inverse(pose), seen + random.normal(scale=0.002, size=seen.shape)))
        poses.append(pose)
    return scans, np.stack(poses)


scans, truth = views(4, 6000)
merged = idam.merge(scans)

for name, pose, confidence, reason in zip(merged.names, merged.poses, merged.confidence, merged.reason, strict=True):
    print(name, "not placed" if pose is None else chance(confidence), reason)

assert len(merged.components[0]) == 4
first = merged.components[0][0]
for scan, pose in enumerate(merged.poses):
    assert pose is not None
    error = np.degrees(rigid.angle(truth[scan][:3, :3].T @ truth[first][:3, :3] @ pose[:3, :3]))
    assert error < 1, error
print(f"one cloud of {len(merged.merged().points):,} points")
