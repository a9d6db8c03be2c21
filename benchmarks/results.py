"""The page of results from the JSON files of ``idam evaluate``, with the command, machine, date and seed of each.

python benchmarks/results.py docs/results/*.json > docs/results.md
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import scans

from idam.lab.evaluation.methods import METHODS
from idam.lab.evaluation.runner import Row
from idam.lab.evaluation.table import columns

TITLES = {
    "unseen-shapes": "Unseen shapes (section 4.1)",
    "unseen-categories": "Unseen categories (section 4.2)",
    "gaussian-noise": "Gaussian noise (section 4.3)",
    "ablation": "Ablation (section 4.6), on unseen categories",
    "practice": "Closer to practice: disjoint points, crops of their own, turned to 45 degrees",
    "practice-any-rotation": "Closer to practice, turned in any way",
}

INTRODUCTION = """# Results

Every figure here was computed by the command below its table; the paper's own figures stand in brackets. RMSE and MAE
are over the zyx Euler angles, in degrees, and the coordinates of the translation; recall is the share of pairs within
5 degrees and 0.05. Rows of fewer pairs than others ran on the first so many, for time. Times in these tables are
medians of one pair at a time on a busy machine: compare those under Efficiency, which were interleaved on an idle one.

- A name that ends in `-paper` is the network with the paper's inference (3 iterations, N/6 points, no further tries).
- One that ends in `-tuned` is a rival with settings chosen on validation pairs, beside the published ones.
- `pointnetlk`, `dcp` and `prnet` are our implementations, trained for 12 minutes of one core for each table (753 to
  928, 88 to 114 and 66 to 73 steps of 8 pairs), where their authors trained for hours on a GPU: read them as a
  beginning, not as those methods' worth. PRNet with noise had 26 minutes, since other work took half of its core.
- `register` is the whole of `idam.register`, with the default model unless another is named. A fifth of what that
  learnt from are halves of ModelNet40's training shapes, of all categories: to it, the unseen categories are not new.
  It knows of no limit to the rotation, and may find a symmetric shape's other pose; `register-90` is told that nothing
  turns by more than 90 degrees (`max_angle=90`): the paper's three angles of up to 45 make no more than 86. Of poses
  that look alike, a `gnn` model named beside it chooses: it learnt how pairs are turned, and may have learnt how shapes
  stand, since every source stands as ModelNet's shapes do.
- `gnn-idam-icp` is the network, and the symmetric ICP that `register` ends sparse clouds with.
- Go-ICP is in neither table closer to practice: with no point in common, its search had not ended on the first pair
  after 17 minutes.

![Errors of each row](images/errors.png)

![Recall on pairs closer to practice](images/practice.png)
"""


def table(records: list[dict[str, Any]]) -> str:
    """One experiment's table, of all files that hold rows of it, and where they come from."""
    experiment = records[0]["pairs_from"]
    if len({record["checksum"] for record in records}) > 1:
        raise SystemExit(f"{experiment}: the files are of different pairs")
    cells = columns(experiment)
    lines = [f"## {TITLES[experiment]}", "", line(list(cells)), line(["---"] * len(cells))]
    rows = [row for record in records for row in record["rows"]]
    for row in sorted(rows, key=lambda row: list(METHODS).index(row["method"])):
        if "missing" in row:
            lines.append(line([row["method"], row["missing"].split(":")[0], *[""] * (len(cells) - 2)]))
        else:
            lines.append(line([cell(Row.from_dict(row)) for cell in cells.values()]))
    return "\n".join([*lines, "", *map(origin, records)])


def origin(record: dict[str, Any]) -> str:
    """The command, date, seed and machine of a file of rows."""
    machine = record["machine"]
    return (
        f"- `{record['command']}`: {record['date'][:10]}, seed {record['seed']}, pairs {record['checksum']}, "
        f"{machine['cores']} cores of an {machine['processor']}, PyTorch {machine['torch']}, "
        f"{machine['jobs']} {'process' if machine['jobs'] == 1 else 'processes'}."
    )


def efficiency(record: dict[str, Any]) -> str:
    """Milliseconds of each method at each number of points."""
    times: dict[str, dict[str, float]] = record["median_ms"]
    lines = ["## Efficiency (section 4.5)", "", line(["ms, median", *times]), line(["---"] * (len(times) + 1))]
    lines += [
        line([name, *(f"{column[name]:.0f}" for column in times.values())]) for name in next(iter(times.values()))
    ]
    return "\n".join([*lines, "", f"- `{record['command']}`: {record['date'][:10]}, {record['processor']}."])


def real_scans(record: dict[str, Any]) -> str:
    """Success over pairs of real scans."""
    pairs = record["records"]
    about = f"- `benchmarks/scans.py`: {record['date'][:10]}, {record['processor']}. {scans.claim(pairs)}"
    return "\n".join(["## Real scans", "", scans.table(pairs), "", about])


def scale(sizes: list[dict[str, float]]) -> str:
    """Time and memory of ``register`` as the clouds grow."""
    cells = ["points of each cloud", "seconds", "peak GB", "error, degrees"]
    lines = ["## Scale", "", line(cells), line(["---"] * len(cells))]
    for size in sizes:
        figures = f"{size['seconds']:.2f}", f"{size['peak_gigabytes']:.2f}", f"{size['degrees']:.3f}"
        lines.append(line([f"{size['points']:,.0f}", *figures]))
    return "\n".join([*lines, "", "- `python benchmarks/scale.py`, on the machine of the table above."])


def confidences(record: dict[str, Any]) -> str:
    """What the confidence was fitted to, and how well."""
    return "\n".join(
        [
            "## Confidence",
            "",
            "![Reliability, and risk against coverage](images/confidence.png)",
            "",
            f"- `python {record['about']}`: calibration error {record['calibration_error']:.3f} on the "
            f"{len(record['pairs']) // 2} pairs held back.",
        ]
    )


def line(cells: list[str]) -> str:
    """One line of a table in Markdown."""
    return "| " + " | ".join(cells) + " |"


def main() -> None:
    """Print the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("records", type=Path, nargs="+")
    files = [json.loads(path.read_text()) for path in parser.parse_args().records]
    records = [content for content in files if isinstance(content, dict)]
    tables = [[r for r in records if r.get("pairs_from") == experiment] for experiment in TITLES]
    sections = [table(group) for group in tables if group]
    sections += [efficiency(record) for record in records if "median_ms" in record]
    sections += [scale(content) for content in files if isinstance(content, list)]
    sections += [real_scans(record) for record in records if "records" in record]
    sections += [confidences(record) for record in records if "calibration_error" in record]
    print(INTRODUCTION)
    print("\n\n".join(sections))


if __name__ == "__main__":
    main()
