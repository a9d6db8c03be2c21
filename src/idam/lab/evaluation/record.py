"""The JSON file of an evaluation: what ran where, and its rows; written after each of them, and read to go on."""

from __future__ import annotations

import json
import os
import platform
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import torch

from idam import __version__
from idam.errors import InputError
from idam.io import write_json
from idam.lab.evaluation.experiments import TEST_SEED, TestSet
from idam.lab.evaluation.metrics import WITHIN
from idam.lab.evaluation.runner import Row, Task

__all__ = ["Missing", "read_rows", "write_record"]


@dataclass(frozen=True)
class Missing:
    """A row that could not be computed: which, and why."""

    task: Task
    reason: str

    def to_dict(self) -> dict[str, str]:
        """A record for JSON."""
        return {"method": self.task.method, "missing": self.reason}


def write_record(path: Path, test: TestSet, rows: list[Row | Missing], command: str, jobs: int) -> None:
    """Write all rows so far, atomically; the only row's figures stand at the top as well.

    Raises:
        InputError: the file cannot be written.
    """
    single = rows[0].to_dict() if len(rows) == 1 else {}
    write_json(
        path,
        {
            "pairs_from": test.name,
            "checksum": test.checksum,
            "recall_within": list(test.within),
            "seed": TEST_SEED,
            "command": command,
            "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
            "machine": {
                "processor": processor(),
                "cores": os.cpu_count(),
                "jobs": jobs,
                "python": platform.python_version(),
                "torch": torch.__version__,
                "idam": __version__,
            },
            **single,
            "rows": [row.to_dict() for row in rows],
        },
    )


def read_rows(path: Path, test: TestSet) -> list[Row]:
    """The rows that a file holds already; none where there is no file.

    Raises:
        InputError: the file is not such a record, or is of other pairs.
    """
    if not path.is_file():
        return []
    try:
        record: dict[str, Any] = json.loads(path.read_text())
        rows = [Row.from_dict(row) for row in record["rows"] if "missing" not in row]
        checksum, within = record["checksum"], record.get("recall_within", list(WITHIN))
    except (OSError, ValueError, KeyError, TypeError):
        raise InputError(
            f"{path}: holds no evaluation to go on with; name another --json, or leave --resume out"
        ) from None
    if (checksum, within) != (test.checksum, list(test.within)):
        raise InputError(
            f"{path}: is an evaluation of other pairs or bounds; name another --json, or leave --resume out"
        )
    return rows


def processor() -> str:
    """The processor's name, where the system tells it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())
