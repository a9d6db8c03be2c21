"""The network of the paper.

Needs `pip install 'idam[torch]'`. `idam.load_model` gives a `torch.nn.Module` that takes batches of clouds of about
the unit sphere and returns rotations and translations. It is differentiable where the paper is.
"""

import numpy as np
import torch

import idam
from idam.demo import scans
from idam.io import read_point_cloud

source, target = (read_point_cloud(path).points for path in scans())
moved = idam.register(source, target).apply(source)  # so that they nearly fit: the paper's networks turn to 45 degrees

random = np.random.default_rng(0)
centre, scale = target.mean(axis=0), float(np.ptp(target, axis=0).max())
few = [points[random.choice(len(points), 1024, replace=False)] for points in (moved, target)]
batch = [torch.tensor((points - centre) / scale, dtype=torch.float32)[None] for points in few]

model = idam.load_model("gnn-unseen-shapes")
with torch.inference_mode():
    output = model(*batch)
print(output.rotation, output.translation)

assert output.rotation.shape == (1, 3, 3)
