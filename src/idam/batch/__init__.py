"""Thousands of pairs: a table of them in, a row for each out, on one machine or many."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

from idam.batch import local
from idam.batch.options import check_options
from idam.batch.pairs import as_pairs, by_scan
from idam.batch.rows import Row
from idam.batch.work import Register
from idam.errors import InputError

__all__ = ["register_pairs"]


def register_pairs(
    pairs: Any, *, jobs: int | None = None, time_limit: float = local.TIME_LIMIT, **options: Any
) -> Iterator[Row]:
    """Register many pairs in processes of their own.

    Each process keeps the scans it read while pairs of them follow one another. One that dies costs its pair another
    try; a pair that cannot be registered, whatever the reason, costs its own row alone. A script that calls this needs
    the usual ``if __name__ == "__main__":``, for every process imports it.

    Args:
        pairs: an iterable of ``(source, target)``, paths or clouds as :func:`idam.register` takes them, or of mappings
            with ``source``, ``target`` and, where wanted, ``id``, ``init``, ``max_angle`` and ``voxel_size``; or the
            path of a file of pairs, CSV, JSONL or two names a line.
        jobs: processes, of one thread each; None for as many as there are cores.
        time_limit: seconds that a pair may take.
        options: of :func:`idam.register`, for all pairs.

    Yields:
        A row as soon as its pair is done: a dict of plain values with ``id`` (the one given, else ``"source target"``
        for paths and the number of the pair, from 0, for clouds), ``source``, ``target``, ``status`` (``ok`` or
        ``failed``), ``error`` (why it failed, one line), ``transformation`` (4x4, target = T source), ``confidence``,
        ``converged``, ``reason``, ``fitness``, ``inlier_rmse``, ``information`` (6x6) and ``seconds``. The same rows
        whatever ``jobs`` is, but for ``seconds`` and their order.

    Raises:
        InputError: the pairs cannot be read, two have one id, or an option is wrong.
    """
    check_options(options)
    if (jobs is not None and jobs < 1) or not time_limit > 0:
        raise InputError(f"jobs and time_limit must be positive, not {jobs} and {time_limit}")
    return local.run(by_scan(as_pairs(pairs)), partial(Register, options), jobs, time_limit)
