"""A batch's rows as one table."""

from __future__ import annotations

import csv
import json
import sys
from pathlib import Path

import numpy as np
import pytest

from idam.batch.collect import collect
from idam.batch.ledger import Ledger
from idam.batch.pairs import as_pairs
from idam.batch.rows import COLUMNS, Row, failed_row
from idam.errors import InputError, MissingDependencyError


@pytest.fixture
def run(tmp_path: Path) -> tuple[Path, list[Row]]:
    """A batch of five pairs, done in another order, one of them not yet."""
    pairs = as_pairs([(f"a{i}.ply", "ü, b.ply") for i in range(5)])
    rows = []
    for number, pair in enumerate(pairs[:4]):
        matrix = np.random.default_rng(number).normal(size=(4, 4))
        row = failed_row(pair, "a.ply: is empty (0 bytes)", 0.1) | {
            "status": "ok",
            "error": None,
            "transformation": matrix.tolist(),
            "information": np.kron(np.eye(2), matrix[:3, :3]).tolist(),
            "confidence": 0.1 + 0.2,
            "converged": False,
            "reason": "low overlap",
        }
        rows.append(row if number else failed_row(pair, "a0.ply: is empty (0 bytes)", 0.1))
    with Ledger(tmp_path / "run", {"model": "default"}, pairs) as ledger:
        for row in reversed(rows):
            ledger.append(row)
    return tmp_path / "run", rows


def test_jsonl_has_the_rows_in_the_order_of_the_pairs(run: tuple[Path, list[Row]], tmp_path: Path) -> None:
    folder, rows = run
    assert collect(folder, tmp_path / "table.jsonl") == (4, 1)
    assert [json.loads(line) for line in (tmp_path / "table.jsonl").read_text().splitlines()] == rows


def test_csv_holds_every_digit(run: tuple[Path, list[Row]], tmp_path: Path) -> None:
    folder, rows = run
    collect(folder, tmp_path / "table.csv")
    with (tmp_path / "table.csv").open(encoding="utf-8", newline="") as file:
        found = list(csv.DictReader(file))
    assert list(found[0]) == list(COLUMNS)
    for texts, row in zip(found, rows, strict=True):
        assert texts["source"] == row["source"]
        assert texts["target"] == "ü, b.ply"
        assert texts["error"] == (row["error"] or "")
        matrix = np.array(texts["transformation"].split(), float)
        assert np.array_equal(matrix, np.ravel(row["transformation"] or []))
    assert float(found[1]["confidence"]) == 0.1 + 0.2
    # a table of results is one of pairs, whose guesses the results are
    columns = ("id", "source", "target")
    guesses = [{**{name: texts[name] for name in columns}, "init": texts["transformation"] or None} for texts in found]
    assert [pair.init for pair in as_pairs(guesses)] == [row["transformation"] for row in rows]


def test_parquet_has_types(run: tuple[Path, list[Row]], tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason="tables as .parquet need pyarrow")
    folder, rows = run
    collect(folder, tmp_path / "table.parquet")
    table = parquet.read_table(tmp_path / "table.parquet")
    assert table.column_names == list(COLUMNS)
    assert [str(table.schema.field(name).type) for name in ("converged", "fitness", "id")] == [
        "bool",
        "double",
        "string",
    ]
    for found, row in zip(table.to_pylist(), rows, strict=True):
        for name in COLUMNS:
            flat = np.ravel(row[name]).tolist() if isinstance(row[name], list) else row[name]
            assert found[name] == flat


def test_parquet_without_pyarrow_says_what_to_install(
    run: tuple[Path, list[Row]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'idam\[parquet\]'"):
        collect(run[0], tmp_path / "table.parquet")
    assert not (tmp_path / "table.parquet").exists()


def test_refused(run: tuple[Path, list[Row]], tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"unknown table format: the ones to write are .csv, .jsonl, .parquet"):
        collect(run[0], tmp_path / "table.xlsx")
    with pytest.raises(InputError, match="there is no folder"):
        collect(run[0], tmp_path / "none" / "table.csv")
    with pytest.raises(InputError, match="is not the folder of a batch"):
        collect(tmp_path, tmp_path / "table.csv")
