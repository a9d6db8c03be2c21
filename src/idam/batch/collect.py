"""A batch's rows as one table."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from idam.batch.ledger import read_run
from idam.batch.rows import COLUMNS, Row
from idam.errors import InputError, MissingDependencyError
from idam.io.files import StrPath, check_destination, write_bytes

__all__ = ["collect"]

MATRICES = ("transformation", "information")


def collect(folder: StrPath, output: StrPath) -> tuple[int, int]:
    """Write the rows of a batch to one file, in the order of its pairs.

    ``.jsonl`` has the rows as they were kept; in ``.csv`` a matrix is its numbers row by row, separated by spaces; in
    ``.parquet`` it is a list of them, and numbers are float64.

    Args:
        folder: of the batch, complete or not.
        output: the file; its extension is the format.

    Returns:
        How many rows there are, and how many pairs have none yet.

    Raises:
        InputError: the folder is not one of a batch, or the file cannot be written.
        MissingDependencyError: it is ``.parquet``, and pyarrow is not installed.
    """
    encode = ENCODERS.get(Path(output).suffix.lower())
    if encode is None:
        raise InputError(f"{output}: unknown table format: the ones to write are {', '.join(ENCODERS)}")
    check_destination(output)
    rows, missing = read_run(folder)
    write_bytes(output, encode(rows))
    return len(rows), missing


def _jsonl(rows: Sequence[Row]) -> bytes:
    return "".join(json.dumps(row) + "\n" for row in rows).encode()


def _csv(rows: Sequence[Row]) -> bytes:
    table = io.StringIO()
    writer = csv.DictWriter(table, COLUMNS, lineterminator="\n")
    writer.writeheader()
    for row in rows:
        texts = {name: " ".join(map(repr, _flat(row[name]) or ())) for name in MATRICES}
        writer.writerow(row | texts)
    return table.getvalue().encode(errors="surrogateescape")


def _parquet(rows: Sequence[Row]) -> bytes:
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError:
        raise MissingDependencyError("a table as .parquet needs pyarrow: pip install 'idam[parquet]'") from None
    kinds = {
        **dict.fromkeys(("id", "source", "target", "status", "error", "reason"), pyarrow.string()),
        **dict.fromkeys(("confidence", "fitness", "inlier_rmse", "seconds"), pyarrow.float64()),
        **dict.fromkeys(MATRICES, pyarrow.list_(pyarrow.float64())),
        "converged": pyarrow.bool_(),
    }
    flat = [row | {name: _flat(row[name]) for name in MATRICES} for row in rows]
    schema = pyarrow.schema([(name, kinds[name]) for name in COLUMNS])
    stream = io.BytesIO()
    parquet.write_table(pyarrow.Table.from_pylist(flat, schema), stream)
    return stream.getvalue()


def _flat(matrix: Any) -> list[float] | None:
    return None if matrix is None else [number for row in matrix for number in row]


ENCODERS: dict[str, Callable[[Sequence[Row]], bytes]] = {".csv": _csv, ".jsonl": _jsonl, ".parquet": _parquet}
