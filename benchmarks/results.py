"""The page of results from the JSON files of ``idam evaluate``, with the command, machine, date and seed of each.

python benchmarks/results.py docs/results/*.json > docs/results.md
"""

from __future__ import annotations

import argparse
import json
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import merge
import scans

from idam.lab.evaluation.paper import PAPER
from idam.lab.evaluation.runner import Row
from idam.lab.evaluation.table import columns, order, short_name
from idam.lab.figures.timings import growth

TITLES = {
    "unseen-shapes": "Unseen shapes (section 4.1)",
    "unseen-categories": "Unseen categories (section 4.2)",
    "gaussian-noise": "Gaussian noise (section 4.3)",
    "ablation": "Ablation (section 4.6), on unseen categories",
    "practice": "Disjoint points, rotations up to 45 degrees about each axis",
    "practice-any-rotation": "Disjoint points, any rotation",
}
OURS = ("gnn-idam", "fpfh-idam", "register")
"""What the names of this package's rows begin with."""
ENOUGH = 200
"""Pairs that a row needs to stand in the summary; of this package's, in the paper's experiments, all of them."""

INTRODUCTION = """# Results

{summary}

RMSE / MAE of the rotation in degrees, of the row with the least MAE; for the two protocols with disjoint points,
recall / recall with symmetric poses. The paper's own experiments compare like with like in the third and fourth column;
the second adds what this package does beyond the paper. Rows of idam there ran on all pairs, those of others on at
least 200. All rows, and the commands that compute them, are in the tables below.

![Rotation errors of every method](images/errors.png)
"""

ABOUT = """## How to read the tables

RMSE and MAE are taken over the zyx Euler angles, in degrees, and over the coordinates of the translation. Recall is the
share of pairs within 5 degrees and 0.05. The paper's own figures stand in brackets. The commands below each table
compute it. Times are medians for one pair at a time on a machine that was also doing other work; the times to compare
are those under Efficiency, which were measured in turns on an idle machine. A row that ran on fewer pairs than the
others, for time, says on how many.

- `...-paper`: the network with the paper's inference: 3 iterations, N/6 points, no further tries. Models whose names
  end in `-paper` were trained for it.
- `...-tuned`: a method of others with settings chosen on validation pairs, beside its published settings.
- `pointnetlk`, `dcp`, `prnet`: our implementations (`benchmarks/rivals`), trained for 12 minutes of one core for each
  table (753 to 928, 88 to 114 and 66 to 73 steps of 8 pairs; PRNet with noise 26 minutes, sharing its core). Their
  authors trained for hours on a GPU. These rows show what little training gives, not what the methods can do. Their
  weights are not in the package: `python -m benchmarks.rivals.train_all FOLDER --data modelnet40` trains all nine, and
  `idam evaluate unseen-shapes --data modelnet40 --method benchmarks.rivals.methods:dcp --model
  FOLDER/dcp-unseen-shapes.safetensors` measures one (in the commands below they still have short names).
- `ablation-...`: trained alike. All four begin with the features of `gnn-unseen-categories`, which knew every part, and
  go on training them for 3 of the paper's 40 epochs, about 25 minutes of one core each; all else begins at random. So
  the first three may be better than networks that never had more: `python benchmarks/ablation.py FOLDER --data
  modelnet40 --start gnn-unseen-categories --epochs 3 --batch-size 8 --fuse`; without `--start`, features begin at
  random, too.
- `register`: the whole of `idam.register`, with the default model unless another is named. A fifth of that model's
  training data are halves of ModelNet40's training shapes, of all categories, so the unseen categories are not new to
  it. It assumes no limit on the rotation and may find another pose of a symmetric shape.
- `register-90`: the same with `max_angle=90`; the paper's three angles of up to 45 degrees make at most 86. Among poses
  that look alike, the `gnn` model named beside it chooses. It has learnt how pairs are rotated, and may have learnt
  which way up shapes stand, since every source stands as ModelNet's shapes do.
- `gnn-idam-icp`: the network, then the symmetric ICP that `register` ends with on sparse clouds.
- Go-ICP is missing where the clouds share no point: its search had not finished the first pair after 17 minutes."""

PRACTICE = """## Closer to practice

Both clouds are random halves of a shape's points, so that they share no point; each is cropped to 70 % by its own
half-space, with noise. "With symmetric poses" also counts answers within 5 degrees and 0.05 of a pose that puts the
whole shape onto itself (mean distance below 0.02), such as the half turn of a table.

![Recall of every method](images/practice.png)"""

Record = dict[str, Any]


def table(records: list[Record]) -> str:
    """One experiment's table, of all files that hold rows of it, and where they come from."""
    experiment = records[0]["pairs_from"]
    if len({record["checksum"] for record in records}) > 1:
        raise SystemExit(f"{experiment}: the files are of different pairs")
    cells = columns(experiment)
    lines = [f"## {TITLES[experiment]}", "", line(list(cells)), line(["---"] * len(cells))]
    rows = sorted((row for record in records for row in record["rows"]), key=lambda row: order(row["method"]))
    most = max((row["pairs"] for row in rows if "missing" not in row), default=0)
    for row in rows:
        if "missing" in row:
            lines.append(line([row["method"], row["missing"].split(":")[0], *[""] * (len(cells) - 2)]))
            continue
        name, *others = (cell(Row.from_dict(row)) for cell in cells.values())
        lines.append(line([name if row["pairs"] == most else f"{name}, first {row['pairs']} pairs", *others]))
    return "\n".join([*lines, "", *map(origin, records)])


def summary(tables: dict[str, list[Record]]) -> str:
    """The best of this package and of others, here and as the paper reports them, by experiment."""
    heads = ["", "idam", "idam with the paper's inference", "IDAM in the paper"]
    heads += ["best of others, here", "best of others in the paper"]
    lines = [line(heads), line(["---"] * len(heads))]
    for experiment, records in tables.items():
        rows = [row for record in records for row in record["rows"] if "missing" not in row]
        if experiment == "ablation" or not rows:
            continue
        reported = PAPER.get(experiment, {})
        ours = [row for row in rows if row["method"].startswith(OURS)]
        enough = max(row["pairs"] for row in rows) if reported else ENOUGH
        ours = [row for row in ours if row["pairs"] >= enough]
        others = [row for row in rows if not row["method"].startswith(OURS) and row["pairs"] >= ENOUGH]
        show = best_error if reported else best_recall
        lines.append(
            line(
                [
                    TITLES[experiment].split(" (")[0],
                    show([row for row in ours if not row["method"].endswith("-paper")]),
                    show([row for row in ours if row["method"].endswith("-paper")]),
                    best_reported({name: row for name, row in reported.items() if name.endswith("-idam")}),
                    show(others),
                    best_reported({name: row for name, row in reported.items() if not name.endswith("-idam")}),
                ]
            )
        )
    return "\n".join(lines)


def best_error(rows: list[Record]) -> str:
    """The row of least MAE."""
    if not rows:
        return ""
    best = min(rows, key=lambda row: float(row["mae_r"]))
    return f"{best['rmse_r']:.3f} / {best['mae_r']:.3f} ({named(best)})"


def best_recall(rows: list[Record]) -> str:
    """The row of highest recall, with symmetric poses where they were counted."""
    if not rows:
        return ""
    best = max(rows, key=lambda row: (row.get("symmetric_recall", row["recall"]), row["recall"]))
    symmetric = f" / {best['symmetric_recall']:.3f}" if "symmetric_recall" in best else ""
    return f"{best['recall']:.3f}{symmetric} ({named(best)})"


def best_reported(reported: Mapping[str, Sequence[float]]) -> str:
    """The row of least MAE among those that the paper reports."""
    if not reported:
        return ""
    name = min(reported, key=lambda name: reported[name][1])
    return f"{reported[name][0]:g} / {reported[name][1]:g} ({name})"


def named(row: Record) -> str:
    """The method of a row, with the model where the method has a choice."""
    model = f" with {row['model']}" if row["model"] and row["method"].startswith("register") else ""
    return f"{short_name(row['method'])}{model}, {row['pairs']} pairs"


def origin(record: dict[str, Any]) -> str:
    """The command, date, seed and machine of a file of rows."""
    machine = record["machine"]
    return (
        f"- `{record['command']}`: {record['date'][:10]}, seed {record['seed']}, pairs {record['checksum']}, "
        f"{machine['cores']} cores of an {machine['processor']}, PyTorch {machine['torch']}, "
        f"{machine['jobs']} {'process' if machine['jobs'] == 1 else 'processes'}."
    )


def efficiency(record: dict[str, Any]) -> str:
    """Milliseconds of each method at each number of points, how they grow, and those of pairs in a batch."""
    times: dict[str, dict[str, float]] = record["median_ms"]
    spread, batched = record.get("quartiles_ms", {}), record.get("batched", {})
    heads = ["ms, median (quartiles)", *times, "grows with points to the"]
    heads += [f"{batched['pairs']} pairs of {batched['points']} at once, a pair"] if batched else []
    lines = ["## Efficiency (section 4.5)", "", line(heads), line(["---"] * len(heads))]
    for name in next(iter(times.values())):
        cells = [milliseconds(column[name], spread.get(points, {}).get(name)) for points, column in times.items()]
        exponent = growth({int(points): column[name] for points, column in times.items()})
        cells.append("" if exponent is None else f"{exponent:.2f}")
        if batched:
            found = name in batched["median_ms"]
            cells.append(milliseconds(batched["median_ms"][name], batched["quartiles_ms"][name]) if found else "")
        lines.append(line([name, *cells]))
    about = (
        f"- `{record['command']}`: {record['date'][:10]}, {record['processor']}, {record['threads']} threads, no GPU."
    )
    return "\n".join([*lines, "", "![Time of every method by size](images/speed.png)", "", about])


def milliseconds(median: float, quartiles: Sequence[float] | None) -> str:
    """A median, and between which times the middle half was."""
    return f"{median:.0f}" if quartiles is None else f"{median:.0f} ({quartiles[0]:.0f} to {quartiles[1]:.0f})"


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
    """How well the confidence holds: of families that it was not fitted to, or of fresh pairs."""
    heading, whose, rows = "fresh pairs", "The shipped fit saw none of these pairs.", record.get("fresh")
    if rows is None:
        heading, whose = "each family left out of the fit", "Each family's line is of a fit to all the others."
        rows = record["left out"]
    about = (
        f"- `{record['about']}`. {whose} `found` counts pairs with a right answer among those that were found; `sure` "
        "is a confidence of 0.9 or more."
    )
    return "\n".join([f"## Confidence, {heading}", "", families(rows), "", about])


def many(parts: dict[str, Any]) -> str:
    """Where merging many scans puts them: next to Open3D's multiway registration, on ray-cast scans, by confidence."""
    lines = [line(["scans", "method", "right", "worst", "median", "CPU s"]), line(["---"] * 6)]
    for row in parts["objects"]["records"]:
        degrees, shift = ([error[n] for error in row["errors"]] for n in (0, 1))
        worst = f"{max(degrees):.2f} degrees, {1000 * max(shift):.2f} mm"
        cells = [row["set"], row["method"], f"{row['right']} of {len(row['errors'])}", worst]
        lines.append(line([*cells, f"{statistics.median(degrees):.2f} degrees", f"{row['seconds']:.1f}"]))
    about = (
        f"- `{parts['objects']['command']} FOLDER`: {parts['objects']['date'][:10]}. Right is within 2 degrees and "
        "2 mm. The truth is good to 0.5 degrees and 1 mm. Open3D's graph on idam's links takes its time besides that "
        "of the links."
    )
    sites = [part for part in ("views", "rooms", "growth") if part in parts]
    records = [record for part in sites for record in parts[part]["records"]]
    commands = "; ".join(f"`{parts[part]['command']}`, {parts[part]['date'][:10]}" for part in sites)
    explained = (
        f"- Ray-cast scans: {commands}. Right is relative to the first scan of the component. CPU time of all "
        "processes; memory is the most that all have together; there are none where pairs were kept from another run."
    )
    by_confidence = [
        line([f"{low:.2f} to {high:.2f}", f"{row['scans']}", f"{row['said']:.3f}", f"{row['right']:.3f}"])
        for low, high, row in merge.calibration(records)
    ]
    head = [line(["confidence", "scans", "mean confidence", "share right"]), line(["---"] * 4)]
    tables = [[*lines, "", about], [*map(line, sites_table(records)), "", explained], [*head, *by_confidence]]
    last = "- The scans of the table above, by their confidence."
    return "\n\n".join(["## Many scans", *("\n".join(each) for each in tables), last])


def sites_table(records: list[dict[str, Any]]) -> list[list[str]]:
    """A line for each merge of ray-cast scans."""
    columns = ["scans", "pairs", "components", "right", "sure", "sure and wrong", "worst", "CPU s", "GB"]
    rows = [columns, ["---"] * len(columns)]
    for record in records:
        parts = ", ".join(str(size) for size in record["components"] if size > 1) or "none"
        right = f"{sum(record['right']) + sum(size > 1 for size in record['components'])} of {record['scans']}"
        worst = f"{record['worst'][0]:.2f} degrees, {record['worst'][1]:.3f}"
        cpu, memory = ("" if value is None else f"{value:.3g}" for value in (record["cpu"], record["memory"]))
        counts = [record["sure"], record["sure_and_wrong"]]
        rows.append([record["name"], str(record["pairs"]), parts, right, *map(str, counts), worst, cpu, memory])
    return rows


def trust(record: dict[str, Any]) -> str:
    """How often register is right, sure, and sure and wrong, by family."""
    about = (
        f"- `benchmarks/trust.py FOLDER... --pairs {record['pairs']} --seed {record['seed']}`: "
        f"{record['date'][:10]}, {record['processor']}. `known` counts pairs whose place something in the scene fixes; "
        "a sure answer to one of the others counts as wrong."
    )
    picture = (
        "![Risk against coverage](images/risk.png)\n\nOf the pairs, the surest first, the share that is wrong; the "
        "dots are at a confidence of 0.9."
    )
    return "\n".join(["## Trust", "", picture, "", families(record["families"]), "", about])


def precision(record: dict[str, Any]) -> str:
    """How well the covariance tells the error, by shape, points and noise."""
    rows = record["rows"]
    noises = sorted({row["noise"] for row in rows if row["noise"] is not None})
    lines = [line(["shape", "points", *(f"noise {noise:g}" for noise in noises)]), line(["---"] * (2 + len(noises)))]
    groups: dict[tuple[str, int], list[str]] = {}
    for row in rows:
        if row["points"] is not None:
            groups.setdefault((row["shape"], row["points"]), []).append(nees(row["nees"]))
    lines += [line([shape, f"{points:,}", *cells]) for (shape, points), cells in groups.items()]
    loops = [row for row in rows if row["noise"] is None]
    told = [f"{row['shape'].capitalize()}: {nees(row['nees'])}, {len(row['nees'])} loops. " for row in loops]
    about = (
        f"- `benchmarks/precision.py`: {record['date'][:10]}, {record['processor']}. Mean (median) NEES of "
        f"{len(rows[0]['nees'])} registrations each; 6 is right. Noise is the standard deviation of each coordinate of "
        f"shapes about as large as the unit sphere. {''.join(told)}"
    )
    return "\n".join(["## Precision", "", *lines, "", about.rstrip()])


def nees(found: list[float | None]) -> str:
    """Mean and median of those that are right."""
    right = [x for x in found if x is not None]
    return f"{statistics.mean(right):.1f} ({statistics.median(right):.1f})"


def families(rows: dict[str, dict[str, float]]) -> str:
    """A table with a line a family."""
    columns = list(next(iter(rows.values())))
    lines = [line(["family", *columns]), line(["---"] * (len(columns) + 1))]
    lines += [line([name, *(f"{row[column]:.3g}" for column in columns)]) for name, row in rows.items()]
    return "\n".join(lines)


def line(cells: list[str]) -> str:
    """One line of a table in Markdown."""
    return "| " + " | ".join(cells) + " |"


def main() -> None:
    """Print the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("records", type=Path, nargs="+")
    files = [json.loads(path.read_text()) for path in parser.parse_args().records]
    records = [content for content in files if isinstance(content, dict)]
    tables = {name: [r for r in records if r.get("pairs_from") == name] for name in TITLES}
    tables = {name: group for name, group in tables.items() if group}
    sections = [INTRODUCTION.format(summary=summary(tables)).rstrip(), ABOUT]
    sections += [table(group) for name, group in tables.items() if not name.startswith("practice")]
    sections += [PRACTICE]
    sections += [table(group) for name, group in tables.items() if name.startswith("practice")]
    sections += [efficiency(record) for record in records if "median_ms" in record]
    sections += [scale(content) for content in files if isinstance(content, list)]
    sections += [real_scans(record) for record in records if "overlap" in record.get("records", [{}])[0]]
    sections += [many(record) for record in records if "objects" in record]
    sections += [precision(record) for record in records if "nees" in record.get("rows", [{}])[0]]
    sections += [trust(record) for record in records if "families" in record]
    sections += [confidences(record) for record in records if "left out" in record or "fresh" in record]
    print("\n\n".join(sections))


if __name__ == "__main__":
    main()
