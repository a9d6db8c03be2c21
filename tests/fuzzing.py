"""What fuzz tests share: how many examples, limits of time and memory, damage to valid files, and what failed.

The same every time; but where the environment's IDAM_FUZZ says how many examples each test takes, as ``make fuzz``
does, they are fresh ones, and what fails is kept in .hypothesis and tried first the next time. IDAM_FUZZ_LOG is then
the file that gets the figures, IDAM_FUZZ_FOUND the folder that gets the shrunk inputs.
"""

from __future__ import annotations

import json
import os
import re
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.database import DirectoryBasedExampleDatabase

from idam.errors import InputError
from idam.io import PointCloud

resource = pytest.importorskip("resource", reason="memory is limited by setrlimit, which this system lacks")
needs_proc = pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="no /proc to read the memory's size from")

MEMORY = 2**28
"""Bytes of address space that reading a file of some kilobytes may take: more than 256 MB is a blow-up."""
SECONDS = 2.0
"""Processor time it may take."""

FRESH = int(os.environ.get("IDAM_FUZZ", "0"))


def examples(count: int) -> settings:
    """So many examples of a test in the suite, or as many as ``make fuzz`` asks for."""
    return settings(
        max_examples=FRESH or count,
        deadline=None,
        derandomize=not FRESH,
        database=DirectoryBasedExampleDatabase(".hypothesis/fuzz") if FRESH else None,
        suppress_health_check=list(HealthCheck),
    )


# --- limits, and what failed -----------------------------------------------------------------------------------------

tried: dict[str, list[float]] = {}
"""By test: inputs, and seconds of processor time."""


@pytest.fixture(scope="module", autouse=True)
def figures() -> Iterator[None]:
    """Leaves the figures for benchmarks/fuzz.py."""
    tried.clear()
    yield
    if "IDAM_FUZZ_LOG" in os.environ:
        log = Path(os.environ["IDAM_FUZZ_LOG"])
        before = json.loads(log.read_text()) if log.exists() else {}
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
        log.write_text(json.dumps({**before, **tried, "peak GB": max(peak, before.get("peak GB", 0.0))}))


@contextmanager
def limits() -> Iterator[None]:
    """Lets the process grow by so much and no more, in so much time, without a warning."""
    name = os.environ["PYTEST_CURRENT_TEST"].split("::")[-1].split(" ")[0]
    figure = tried.setdefault(name, [0, 0.0])
    figure[0] += 1
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    started = time.process_time()
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, hard))
    try:
        with warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always")
            yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
        seconds = time.process_time() - started
        figure[1] += seconds
    assert not warned
    assert seconds < SECONDS


def check_refusal(error: InputError, *names: object) -> None:
    """One line that names what is at fault, and hides no fault of our own."""
    message = str(error)
    assert message.isprintable() and len(message) < 500
    assert not names or message.startswith(tuple(f"{name}" for name in names))
    assert "memory" not in message
    cause = error.__cause__
    if isinstance(cause, NameError | AttributeError | AssertionError | RecursionError):
        place = traceback.extract_tb(cause.__traceback__)[-1].filename
        assert f"{os.sep}idam{os.sep}" not in place, f"{cause!r} in {place}"


def read_or_refuse(path: Path, content: bytes, read: Callable[[Path], Any], output: Path | None = None) -> Any:
    """What is read, or None where it is refused as it should be; an input that fails is kept as a file."""
    path.write_bytes(content)
    try:
        with limits():
            try:
                found = read(path)
            except InputError as error:
                found = None
                check_refusal(error, path, *([output] if output else []))
        if isinstance(found, PointCloud):
            assert len(found.points) and np.isfinite(found.points).all()
    except BaseException:
        if "IDAM_FUZZ_FOUND" in os.environ:  # the last that fails is the smallest
            (Path(os.environ["IDAM_FUZZ_FOUND"]) / path.name).write_bytes(content)
        raise
    return found


# --- damage ----------------------------------------------------------------------------------------------------------

HUGE = [b"1000000000000", b"18446744073709551616", b"4294967295", b"-1", b"0", b"1e308", b"9" * 5000, b"nan"]


def _flip(draw: st.DrawFn, data: bytes) -> bytes:
    at = draw(st.integers(0, min(300, len(data) - 1)) | st.integers(0, len(data) - 1))
    return data[:at] + bytes([draw(st.integers(0, 255))]) + data[at + 1 :]


def _fill(draw: st.DrawFn, data: bytes) -> bytes:
    at, length = draw(st.integers(0, len(data) - 1)), draw(st.sampled_from([1, 4, 8, 64]))
    return data[:at] + draw(st.sampled_from([b"\0", b"\xff", b"\n", b" "])) * length + data[at + length :]


def _cut_out(draw: st.DrawFn, data: bytes) -> bytes:
    at = draw(st.integers(0, len(data) - 1))
    return data[:at] + data[at + draw(st.integers(1, 200)) :]


def _repeat(draw: st.DrawFn, data: bytes) -> bytes:
    at = draw(st.integers(0, len(data) - 1))
    return data[:at] + data[at : at + 100] * draw(st.integers(2, 50)) + data[at:]


def _promise(draw: st.DrawFn, data: bytes) -> bytes:
    """One of the first numbers of the text becomes an absurd one."""
    numbers = list(re.finditer(rb"\d+", data[:400]))
    if not numbers:
        return data
    chosen = draw(st.sampled_from(numbers))
    return data[: chosen.start()] + draw(st.sampled_from(HUGE)) + data[chosen.end() :]


@st.composite
def damaged(draw: st.DrawFn, valid: bytes) -> bytes:
    """A file with some damage."""
    data = valid
    for damage in draw(st.lists(st.sampled_from([_flip, _fill, _cut_out, _repeat, _promise]), max_size=3)):
        data = damage(draw, data) or b"\n"
    return data[: draw(st.just(len(data)) | st.integers(0, len(data)))]
