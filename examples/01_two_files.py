"""Two files.

One call takes two scans in any pose to one rigid transform. The first cloud is the *source*, which moves; the second
is the *target*, which stays. No initial guess, no voxel size.

The result prints as rotation, shift, confidence and fitness. `converged` says whether the answer is accepted; where
it is not, `reason` says why. `save` writes the 4x4 alone (`.txt`) or everything (`.json`).

On the command line: `idam register scan1.ply scan2.ply -o aligned.ply --transform T.txt --json result.json`
"""

import idam
from idam.demo import scans
from idam.io import read_point_cloud, write_point_cloud

scan1, scan2 = scans()  # or the paths of your own

result = idam.register(scan1, scan2)
print(result)
print(result.transformation)

assert result.converged, result.reason
result.save("T.txt")
result.save("result.json")
write_point_cloud("aligned.ply", read_point_cloud(scan1).transformed(result.transformation))
