"""Register one scan many times.

`idam.prepare` computes once what depends on one cloud alone: levels of voxel sizes, normals, descriptors. The result
goes wherever a cloud goes, and into a file. The answer is the same to the last bit.
"""

import time

import idam
from idam.demo import scans

scan1, scan2 = scans()

plain = idam.register(scan1, scan2)

ready = [idam.prepare(scan1), idam.prepare(scan2)]
started = time.perf_counter()
quick = idam.register(*ready)
print(f"{plain.seconds:.2f} s from the files, {time.perf_counter() - started:.2f} s prepared")

ready[1].save("scan2.idam")
again = idam.register(scan1, "scan2.idam")

assert (quick.transformation == plain.transformation).all()
assert (again.transformation == plain.transformation).all()
