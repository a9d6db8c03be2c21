"""The page of results from the JSON files of ``idam evaluate``, with the command, machine, date and seed of each.

python benchmarks/results.py docs/results/*.json > docs/results.md
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from idam.evaluation.runner import Row
from idam.evaluation.table import columns

TITLES = {
    "unseen-shapes": "Unseen shapes (section 4.1)",
    "unseen-categories": "Unseen categories (section 4.2)",
    "gaussian-noise": "Gaussian noise (section 4.3)",
    "practice": "Closer to practice: disjoint points, crops of their own, turned to 45 degrees",
    "practice-any-rotation": "Closer to practice, turned in any way",
}

INTRODUCTION = """# Results

Every figure here was computed by the command below its table; the paper's own figures stand in brackets. RMSE and MAE
are over the zyx Euler angles, in degrees, and the coordinates of the translation; recall is the share of pairs within
5 degrees and 0.05. Times are medians of one pair at a time on the machine named; rows of one table ran one after the
other, so compare times in [the efficiency benchmark](../benchmarks/speed.py), which interleaves them. A name that ends
in `-paper` is the network with the paper's inference (3 iterations, N/6 points, no further tries); one that ends in
`-tuned` is a rival with settings chosen on validation pairs, beside the published ones. Go-ICP ran on the first pairs
only, as their number says.
"""


def section(record: dict[str, Any]) -> str:
    """One experiment's table, and where it comes from."""
    experiment, machine = record["pairs_from"], record["machine"]
    cells = columns(experiment)
    lines = [f"## {TITLES.get(experiment, experiment)}", "", line(list(cells)), line(["---"] * len(cells))]
    for row in record["rows"]:
        if "missing" in row:
            lines.append(line([row["method"], row["missing"].split(":")[0], *[""] * (len(cells) - 2)]))
        else:
            lines.append(line([cell(Row.from_dict(row)) for cell in cells.values()]))
    lines += [
        "",
        f"`{record['command']}`, {record['date'][:10]}, seed {record['seed']}, pairs {record['checksum']}, on "
        f"{machine['cores']} cores of an {machine['processor']}, PyTorch {machine['torch']}, "
        f"{machine['jobs']} {'process' if machine['jobs'] == 1 else 'processes'}.",
        "",
    ]
    return "\n".join(lines)


def line(cells: list[str]) -> str:
    """One line of a table in Markdown."""
    return "| " + " | ".join(cells) + " |"


def main() -> None:
    """Print the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("records", type=Path, nargs="+")
    records = [json.loads(path.read_text()) for path in parser.parse_args().records]
    order = list(TITLES)
    records.sort(key=lambda record: order.index(record["pairs_from"]) if record["pairs_from"] in order else len(order))
    print(INTRODUCTION)
    print("\n".join(section(record) for record in records), end="")


if __name__ == "__main__":
    main()
