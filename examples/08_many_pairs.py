"""Many pairs.

`idam.register_pairs` registers a table of pairs in several processes and yields a row for each as it is done. A pair
that cannot be read is a row with the reason, not an exception. [Many pairs](many-pairs.md) has the command `idam
batch`, which can be stopped and resumed.
"""

from pathlib import Path

import idam
from idam.demo import scans
from idam.result import chance

if __name__ == "__main__":  # as more than one process asks
    source, target = map(str, scans())
    Path("broken.ply").write_text("not a cloud")
    pairs = [(source, target), (target, source), ("broken.ply", target)]

    rows = list(idam.register_pairs(pairs, jobs=2))
    for row in rows:
        names = Path(row["source"]).name, Path(row["target"]).name
        print(*names, row["status"], row["error"] or f"confidence {chance(row['confidence'])}", row["reason"] or "")

    assert sum(row["status"] == "ok" for row in rows) == 2
