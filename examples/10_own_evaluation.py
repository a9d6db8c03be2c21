"""Your own evaluation.

Where you know the truth, count three numbers: how many answers are right, how many are accepted, and how many of the
accepted ones are wrong. The last one should be near zero: that is what the confidence is for.

An answer is right here within 5 degrees and 5 % of the object's size. `idam evaluate --pairs` (with `idam[lab]`) does
this for a file of pairs, with other methods beside.
"""

import numpy as np

import idam
from idam import rigid
from idam.demo import scans
from idam.io import read_point_cloud
from idam.result import chance

random = np.random.default_rng(0)
part = read_point_cloud(scans()[0]).points
size = float(np.linalg.norm(np.ptp(part, axis=0)))

right, accepted, wrong = 0, 0, 0
for _ in range(6):
    # two crops of the part that share about half, sampled and turned apart
    towards = random.normal(size=3)
    along = (part - part.mean(axis=0)) @ towards
    low, high = np.quantile(along, [0.3, 0.7])
    truth = rigid.exp(random.normal(scale=[2.0] * 3 + [0.5] * 3))
    source = rigid.apply(rigid.inverse(truth), random.permutation(part[along < high])[:4000])
    target = random.permutation(part[along > low])[:4000]

    result = idam.register(source, target)
    turned = np.degrees(rigid.angle(truth[:3, :3].T @ result.rotation))
    moved = np.linalg.norm(result.apply(source.mean(axis=0)) - rigid.apply(truth, source.mean(axis=0)[None])[0])
    good = bool(turned < 5 and moved < 0.05 * size)
    right += good
    accepted += result.converged
    wrong += result.converged and not good
    print(f"{turned:6.2f} degrees, {1000 * moved:6.1f} mm, confidence {chance(result.confidence)}")

print(f"{right} of 6 right, {accepted} accepted, {wrong} of these wrong")
assert right >= 4
assert wrong == 0
