"""Arrays and units.

Clouds may be arrays (N, 3), nested lists, PyTorch tensors, Open3D or trimesh clouds, in any unit that both share.
Results are float64 and in that unit. Column vectors: `target = R @ source + t`.

Coordinates far from the origin, such as UTM, keep their precision: here the same scans in millimetres, hundreds of
kilometres away, end less than a millimetre from where the first answer puts them.

Correspondences are rows of the two arrays. Anything wrong with the input raises `idam.InputError`, a `ValueError`
that says in one line how to mend it.
"""

import numpy as np

import idam
from idam.demo import scans
from idam.io import read_point_cloud

source, target = (read_point_cloud(path).points for path in scans())

result = idam.register(source, target)
moved = result.apply(source)
np.testing.assert_allclose(moved, source @ result.rotation.T + result.translation)

rows, partners = result.correspondence_set.T
gaps = np.linalg.norm(moved[rows] - target[partners], axis=1)
print(f"{len(rows)} of {len(source)} points lie within {result.max_correspondence_distance:.4f} m of the target")
assert gaps.max() <= result.max_correspondence_distance * 1.0001

there = np.array([412_345_678.0, 5_412_345_123.0, 312_500.0])
far = idam.register(source * 1000 + there, target * 1000 + there)
error = np.linalg.norm(far.apply(source * 1000 + there) - (moved * 1000 + there), axis=1)
print(f"in millimetres and far away: at most {error.max():.4f} mm from there")
assert error.max() < 1

try:
    idam.register(np.zeros((100, 2)), target)
except idam.InputError as fault:
    print(fault)
