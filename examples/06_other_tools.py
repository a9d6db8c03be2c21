"""Into CloudCompare, Open3D, ROS and SLAM tools.

`format_transform` writes a transform in the forms that people paste, with all the digits of its doubles, and
`read_transform` reads them. On the command line, `idam info T.txt` prints all of them.

**CloudCompare.** The 4x4 pastes into *Edit > Apply transformation*. If CloudCompare shifted the cloud when it opened
it (it asks for a *global shift* where coordinates are large), the matrix does not fit the shifted coordinates: write
the moved cloud with `-o` and open that.

**Open3D.** `cloud.transform(result.transformation)` moves an Open3D cloud, and Open3D clouds go into `idam.register`
as they are.

**Pose graphs.** `information` has GTSAM's convention: T exp(x), rotation before translation.
"""

from pathlib import Path

import numpy as np

import idam
from idam.demo import scans
from idam.io import format_transform, read_transform
from idam.io.notations import FORMS

result = idam.register(*scans())

for form in FORMS:
    print(f"{form}:\n{format_transform(result.transformation, form)}\n")

Path("T.txt").write_text(format_transform(result.transformation, "quaternion"))
np.testing.assert_allclose(read_transform("T.txt"), result.transformation, atol=1e-12)

back = np.linalg.inv(result.transformation)  # moves the target onto the source
np.testing.assert_allclose(back @ result.transformation, np.eye(4), atol=1e-12)
