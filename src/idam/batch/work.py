"""The work of a batch: one pair after another, every scan read once while pairs of it follow one another."""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from idam.batch.pairs import BLOCK, Pair
from idam.batch.rows import Row, failed_row, ok_row
from idam.errors import InputError, MissingDependencyError
from idam.io import read_transform

if TYPE_CHECKING:
    from idam.clouds.prepared import Prepared

__all__ = ["Register", "Work"]

Work = Callable[[Pair], Row]
"""What makes the row of a pair; raises nothing."""

KEPT = 3 * BLOCK
"""Scans to keep: the sources of a block of pairs, its targets, and those of the block before, which were used last."""
KEPT_POINTS = 10_000_000
"""Points of the scans to keep: 240 MB as they were given, for each process."""


class Register:
    """Registers pair after pair; whatever is wrong with one becomes its row.

    Args:
        options: keyword arguments of :func:`idam.register`, for pairs that say nothing else.
    """

    def __init__(self, options: Mapping[str, Any]) -> None:
        self._options = dict(options)
        self._scans: OrderedDict[int, Prepared] = OrderedDict()

    def __call__(self, pair: Pair) -> Row:
        """The row of a pair."""
        from idam.registration import register

        started = time.perf_counter()
        try:
            source, target = (
                self._scan(number, cloud if not isinstance(cloud, str) else pair.path(cloud))
                for number, cloud in zip(pair.scans, (pair.source, pair.target), strict=True)
            )
            result = register(source, target, **self._options | _own_options(pair))
        except (InputError, MissingDependencyError) as error:
            return failed_row(pair, str(error), time.perf_counter() - started)
        except Exception as error:  # a batch outlives whatever a pair comes upon
            return failed_row(pair, f"{type(error).__name__}: {error}", time.perf_counter() - started)
        return ok_row(pair, result, time.perf_counter() - started)

    def _scan(self, number: int, cloud: Any) -> Prepared:
        """A scan prepared to be registered, kept until others were asked for more lately."""
        from idam.registration import prepare

        if number not in self._scans:
            self._scans[number] = prepare(cloud, model=self._options.get("model", "default"))
        self._scans.move_to_end(number)
        while len(self._scans) > 2 and (len(self._scans) > KEPT or self._points() > KEPT_POINTS):
            self._scans.popitem(last=False)
        return self._scans[number]

    def _points(self) -> int:
        return sum(len(scan.points) for scan in self._scans.values())


def _own_options(pair: Pair) -> dict[str, Any]:
    init = read_transform(pair.path(pair.init)) if isinstance(pair.init, str) else pair.init
    own = {"init": init, "max_angle": pair.max_angle, "voxel_size": pair.voxel_size}
    return {name: value for name, value in own.items() if value is not None}
