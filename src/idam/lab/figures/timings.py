"""Times of one registration by size of the clouds, as ``benchmarks/speed.py`` wrote them."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path

from idam.errors import InputError
from idam.io.files import one_line, read_bytes

__all__ = ["Timings", "read_timings"]

Times = dict[int, float]


@dataclass(frozen=True)
class Timings:
    """What one run of the benchmark measured.

    Attributes:
        threads: that PyTorch used.
        milliseconds: of each method, by the points of each cloud; methods from slowest to fastest on the largest ones.
    """

    threads: int
    milliseconds: dict[str, Times]


def read_timings(path: Path) -> Timings:
    """Read the JSON file of ``benchmarks/speed.py``.

    Raises:
        InputError: the file is missing, or not of that form.
    """
    data = read_bytes(path)
    try:
        record = json.loads(data)
        threads = int(record["threads"])
        milliseconds: dict[str, Times] = {}
        for points, row in sorted(record["median_ms"].items(), key=lambda item: int(item[0])):
            for method, time in row.items():
                milliseconds.setdefault(method, {})[int(points)] = float(time)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            f"{path}: not what benchmarks/speed.py writes ({one_line(error)}); write it with --json"
        ) from None
    numbers = [number for times in milliseconds.values() for pair in times.items() for number in pair]
    if not numbers or not all(0 < number < math.inf for number in numbers):
        raise InputError(f"{path}: needs a time and a size above zero; write it with benchmarks/speed.py --json")
    return Timings(threads, dict(sorted(milliseconds.items(), key=lambda item: _on_largest(item[1]), reverse=True)))


def _on_largest(times: Times) -> float:
    return times[max(times)]
