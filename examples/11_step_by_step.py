"""Every step by hand.

What `idam.register` does, without its shortcuts and second thoughts: prepare both clouds, match points by their
features, find transforms that many matches agree on, take the one that brings most matches together, and refine it on
finer clouds.

These modules are not the public interface: they may change from one version to the next. How the parts work together
is in [architecture.md](architecture.md).
"""

import numpy as np

import idam
from idam import rigid
from idam.align import align
from idam.clouds.prepared import Prepared
from idam.clouds.pyramid import Pyramid
from idam.demo import scans
from idam.io import read_point_cloud
from idam.models import resolve
from idam.search.consensus import agreeing_transforms
from idam.search.matching import Matching

# both clouds, centred and scaled to about the unit sphere, at several voxel sizes
source, target = (Prepared.of(read_point_cloud(path).points, path.name) for path in scans())
clouds = Pyramid(source, target)

# features of about a thousand points of each, and the pairs that are mutually alike
descriptor = resolve("default").descriptor
matching = Matching.of(descriptor, clouds.small)
print(f"{len(matching.matches.source)} matches of {len(clouds.small.source)} and {len(clouds.small.target)} points")

# transforms that sets of matches agree on, and the best of them
candidates = agreeing_transforms(matching.matches, 200)
best = max(candidates, key=matching.matches.support)
print(f"{len(candidates)} transforms, the best brings {matching.matches.support(best):.0%} of the matches together")

# generalised ICP on about ten thousand points, and back to the coordinates of the files
refined = align(clouds.fine.surfaces, best, 2.0, "gicp")
transformation = clouds.leave(refined)

result = idam.register(*scans())
apart = np.degrees(rigid.angle(result.rotation.T @ transformation[:3, :3]))
print(f"{apart:.3f} degrees from what register finds")
assert apart < 1
