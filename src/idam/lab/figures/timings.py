"""Times of one registration by size of the clouds, as ``benchmarks/speed.py`` wrote them."""

from __future__ import annotations

import json
import math
import statistics
from dataclasses import dataclass, field
from pathlib import Path

from idam.errors import InputError
from idam.io.files import one_line, read_bytes

__all__ = ["Timings", "growth", "read_timings"]

Times = dict[int, float]


@dataclass(frozen=True)
class Timings:
    """What one run of the benchmark measured.

    Attributes:
        threads: that PyTorch used.
        milliseconds: of each method, by the points of each cloud; methods from slowest to fastest on the largest ones.
        quartiles: the lower and the upper one of the same, where the file has them.
    """

    threads: int
    milliseconds: dict[str, Times]
    quartiles: dict[str, dict[int, tuple[float, float]]] = field(default_factory=dict)


def growth(times: Times) -> float | None:
    """The exponent e of time ~ points^e that fits best, on logarithms; None of a single size."""
    if len(times) < 2:
        return None
    return statistics.linear_regression([*map(math.log, times)], [*map(math.log, times.values())]).slope


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
        quartiles: dict[str, dict[int, tuple[float, float]]] = {}
        for points, spreads in record.get("quartiles_ms", {}).items():
            for method, (low, high) in spreads.items():
                quartiles.setdefault(method, {})[int(points)] = float(low), float(high)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            f"{path}: not what benchmarks/speed.py writes ({one_line(error)}); write it with --json"
        ) from None
    numbers = [number for times in milliseconds.values() for pair in times.items() for number in pair]
    if not numbers or not all(0 < number < math.inf for number in numbers):
        raise InputError(f"{path}: needs a time and a size above zero; write it with benchmarks/speed.py --json")
    ordered = dict(sorted(milliseconds.items(), key=lambda item: _on_largest(item[1]), reverse=True))
    return Timings(threads, ordered, quartiles)


def _on_largest(times: Times) -> float:
    return times[max(times)]
