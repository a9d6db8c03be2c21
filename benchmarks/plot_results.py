"""Pictures of the tables: errors in the paper's experiments, recall on pairs closer to practice, times, and risk.

python benchmarks/plot_results.py docs/images docs/results/*.json
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from idam.lab.evaluation.paper import PAPER
from idam.lab.evaluation.table import order, short_name
from idam.lab.figures.plot_curves import draw_timings
from idam.lab.figures.timings import read_timings
from idam.report.palette import BLUE, GREY, ORANGE, VERMILLION
from idam.report.style import look, save

ERRORS = {
    "unseen-shapes": "unseen shapes",
    "unseen-categories": "unseen categories",
    "gaussian-noise": "Gaussian noise",
}
RECALLS = {"practice": "rotations up to 45 degrees", "practice-any-rotation": "any rotation"}

SURE = 0.9

SECOND = {"symmetric_recall": "with symmetric poses", "observable_recall": "without axisymmetric shapes"}
COLOURS = {"symmetric_recall": ORANGE, "observable_recall": GREY}

Rows = dict[str, dict[str, Any]]


def read_rows(paths: list[Path]) -> dict[str, Rows]:
    """The rows of each experiment by label, of all files."""
    rows: dict[str, Rows] = {}
    for record in (json.loads(path.read_text()) for path in paths):
        if "pairs_from" in record:
            found = {label(row): row for row in record["rows"] if "missing" not in row}
            rows[record["pairs_from"]] = rows.get(record["pairs_from"], {}) | found
    return rows


def label(row: dict[str, Any]) -> str:
    """The method's name, with the model where it is not the method's own choice."""
    name = short_name(str(row["method"]))
    return f"{name} ({row['model']})" if name.startswith("register") and row["model"] else name


def panels(rows: dict[str, Rows], titles: dict[str, str]) -> tuple[Figure, list[tuple[str, Any, list[str]]]]:
    """A figure with a panel for each experiment, and the methods that all panels list, in the tables' order."""
    places = {name: row["method"] for experiment in titles for name, row in rows[experiment].items()}
    known = sorted(places, key=lambda name: order(places[name]))
    figure = Figure((4.2 * len(titles), 0.32 * len(known) + 1.2), layout="constrained")
    axes = figure.subplots(1, len(titles), sharey=True, squeeze=False)[0]
    for experiment, panel in zip(titles, axes, strict=True):
        panel.set_title(titles[experiment])
        panel.set_yticks(range(len(known)), known)
        panel.grid(axis="x", alpha=0.3)
    axes[0].invert_yaxis()
    return figure, [(experiment, panel, known) for experiment, panel in zip(titles, axes, strict=True)]


def draw_errors(rows: dict[str, Rows]) -> Figure:
    """MAE and RMSE of the rotation, and what the paper reports."""
    figure, parts = panels(rows, ERRORS)
    for experiment, panel, known in parts:
        for place, name in enumerate(known):
            if row := rows[experiment].get(name):
                panel.plot([row["mae_r"], row["rmse_r"]], [place, place], color=BLUE, linewidth=1)
                panel.plot(row["mae_r"], place, "o", color=BLUE, label="MAE")
                panel.plot(row["rmse_r"], place, "o", color=BLUE, fillstyle="none", label="RMSE")
            if reported := PAPER[experiment].get(name):
                panel.plot(reported[1], place, "x", color=VERMILLION, label="MAE in the paper")
        panel.set_xscale("log")
        panel.set_xlabel("degrees")
    handles = {label: handle for handle, label in zip(*parts[0][1].get_legend_handles_labels(), strict=True)}
    figure.legend(handles.values(), handles, loc="outside lower center", ncols=3)
    return figure


def draw_recalls(rows: dict[str, Rows]) -> Figure:
    """Share of pairs within 5 degrees and 0.05, and with the poses of symmetric shapes that look the same."""
    figure, parts = panels(rows, RECALLS)
    for experiment, panel, known in parts:
        for place, name in enumerate(known):
            if row := rows[experiment].get(name):
                # records from before symmetric poses were counted have the shapes without an axis instead
                other = "symmetric_recall" if "symmetric_recall" in row else "observable_recall"
                panel.barh(place - 0.2, row["recall"], 0.38, color=BLUE, label="all shapes")
                panel.barh(place + 0.2, row[other], 0.38, color=COLOURS[other], label=SECOND[other])
        panel.set_xlim(0, 1)
        panel.set_xlabel("share within 5 degrees and 0.05")
    handles = {label: handle for handle, label in zip(*parts[0][1].get_legend_handles_labels(), strict=True)}
    figure.legend(handles.values(), handles, loc="outside lower center", ncols=2)
    return figure


def kind(family: str) -> str:
    """What a family's pairs are."""
    if family in ("part", "flange", "parts"):
        return "parts and their models"
    return "real scans" if family.startswith(("scans/", "real/")) else "ray-cast scenes"


def draw_risk(records: list[dict[str, Any]]) -> Figure:
    """The share of wrong answers among the surest pairs, by how many are taken; a dot where confidence falls to 0.9."""
    figure = Figure((6.4, 4.0), layout="constrained")
    axes = figure.subplots()
    kinds: dict[str, list[dict[str, Any]]] = {"all": records}
    for record in records:
        kinds.setdefault(kind(record["family"]), []).append(record)
    for (name, some), colour in zip(kinds.items(), (GREY, BLUE, ORANGE, VERMILLION), strict=True):
        ordered = sorted(some, key=lambda record: -record["confidence"])
        wrong = [not (record["right"] and record["known"]) for record in ordered]
        share = [(n + 1) / len(ordered) for n in range(len(ordered))]
        risk = [sum(wrong[: n + 1]) / (n + 1) for n in range(len(ordered))]
        axes.plot(share, risk, color=colour, label=f"{name}, {len(ordered)} pairs")
        sure = sum(record["confidence"] >= SURE for record in ordered)
        if sure:
            axes.plot(share[sure - 1], risk[sure - 1], "o", color=colour)
    axes.set_xlabel("coverage: share of the pairs, the surest first")
    axes.set_ylabel("risk: share of them that is wrong")
    axes.set_ylim(bottom=0)
    axes.grid(alpha=0.3)
    axes.legend()
    return figure


def main() -> None:
    """Draw what there are rows for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("records", type=Path, nargs="+")
    arguments = parser.parse_args()
    rows = read_rows(arguments.records)
    for name, titles, draw in (("errors", ERRORS, draw_errors), ("practice", RECALLS, draw_recalls)):
        if titles.keys() <= rows.keys():
            with look():
                print(*save(draw(rows), arguments.folder / name))
    for path in arguments.records:
        record = json.loads(path.read_text())
        if "median_ms" in record:
            with look():
                print(*save(draw_timings(read_timings(path)), arguments.folder / "speed"))
        if "families" in record:
            with look():
                print(*save(draw_risk(record["records"]), arguments.folder / "risk"))


if __name__ == "__main__":
    main()
