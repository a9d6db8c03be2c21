"""A page to look at, and to hand in.

`--html look.html` on the command line; here from Python. The page opens offline in any browser. It shows the pair
before and after, lets you measure distances, blends source and target, shows the colours of the scans and the
runners-up. *Print* makes a report of it: date, version, options, files, figures and the picture in view.

`Record` is what the report says of how it came about.
"""

from pathlib import Path

import idam
from idam.demo import scans
from idam.io import read_point_cloud
from idam.report.page import write_report
from idam.report.record import Record

source, target = scans()
clouds = read_point_cloud(source), read_point_cloud(target)
result = idam.register(*clouds, max_angle=90)

record = Record.of(source, target, unit="m", options={"max-angle": 90})
write_report("look.html", *clouds, result, source_name=source.name, target_name=target.name, record=record)
print(f"look at look.html ({Path('look.html').stat().st_size / 1e6:.2f} MB)")
