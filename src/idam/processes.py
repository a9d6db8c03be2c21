"""Processes at work on one task after another, each replaced when it dies or takes too long."""

from __future__ import annotations

import contextlib
import math
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from multiprocessing import get_context, parent_process, resource_tracker
from multiprocessing.connection import Connection, wait
from typing import Any, Generic, TypeVar

from idam.errors import InputError

__all__ = ["Row", "Worker", "cores"]

Task = TypeVar("Task")
Row = dict[str, Any]
"""What becomes of a task."""

TRIES = 2
"""Times that a task is begun: its process may have died of something else, the second one hardly."""
STARTS = 5
"""Processes in a row that may die before they are ready, until it is the program that is at fault."""
HERE = "here"
"""What a process says first."""
THREADS = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"), "1")
"""One thread a process: the processes are what fills the cores."""


def cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Worker(Generic[Task]):
    """A process at work on one task at a time. It has one thread, never hears of Ctrl-C, and ends with this process.

    Args:
        build: makes the work, which turns a task into its row and raises nothing; called in the process.
        failed: the row of a task that could not be done, of its error and the seconds it took.
        limit: seconds that a task may take.
    """

    def __init__(
        self,
        build: Callable[[], Callable[[Task], Row]],
        failed: Callable[[Task, str, float], Row],
        limit: float = math.inf,
    ) -> None:
        self._build, self._make_failed, self._limit = build, failed, limit
        self._ready, self._starts, self._tries = False, 0, 0
        self._task: Task | None = None
        self._begun, self._deadline = 0.0, math.inf  # on the clock of time.monotonic
        self._start()

    @property
    def free(self) -> bool:
        """Whether it has no task."""
        return self._task is None

    def give(self, task: Task) -> None:
        """Give it a task; only when it is free."""
        self._task, self._tries = task, 0
        self._send()

    def take(self) -> Row | None:
        """The row that the process made, or failed to make; None where there is none yet.

        Raises:
            InputError: no process can be started.
        """
        late = time.monotonic() > self._deadline
        try:
            message = self._connection.recv() if self._connection.poll() else None
        except (EOFError, OSError):
            return self._bury()
        if message is None:
            return self._expire() if late else None
        if self._ready:
            return self._done(message)
        if message == HERE:
            self._tell(self._build)
        else:
            self._ready, self._starts = True, 0
            self._send()
        return None

    @staticmethod
    def wait(workers: Sequence[Worker[Any]]) -> None:
        """Wait until there is something to :meth:`take` from one of them."""
        first = min(worker._deadline for worker in workers)
        left = None if first == math.inf else max(0.0, first - time.monotonic())
        wait([worker._connection for worker in workers], left)

    def stop(self) -> None:
        """End the process, whatever it is doing: nothing but its task is lost."""
        self._process.kill()
        self._process.join()
        self._connection.close()

    def _start(self) -> None:
        context = get_context("spawn")
        self._connection, theirs = context.Pipe()
        # what it works with is sent once it reads: of a process that dies before, nobody would empty the pipe
        self._process = context.Process(target=_serve, args=(theirs,), daemon=True)
        with _one_thread(), _no_interrupt():
            self._process.start()
        theirs.close()
        self._ready, self._deadline = False, math.inf
        self._starts += 1

    def _send(self) -> None:
        """Have the process begin its task, if it is ready and has one."""
        if not self._ready or self._task is None:
            return
        self._tries += 1
        self._begun = time.monotonic()
        self._deadline = self._begun + self._limit
        self._tell(self._task)

    def _tell(self, what: Any) -> None:
        with contextlib.suppress(OSError):  # it has died: there is an end of file to read
            self._connection.send(what)

    def _done(self, row: Row) -> Row:
        self._task, self._deadline = None, math.inf
        return row

    def _failed(self, error: str) -> Row:
        assert self._task is not None
        return self._done(self._make_failed(self._task, error, time.monotonic() - self._begun))

    def _replace(self) -> None:
        self.stop()
        self._start()

    def _bury(self) -> Row | None:
        """Replace a process that died; its task is tried again, or has failed."""
        if not self._ready and self._starts >= STARTS:
            raise InputError(
                "worker processes die before they begin: a script must start its work below "
                "if __name__ == '__main__':, for each of them imports it"
            )
        self._process.join()
        cause = _cause(self._process.exitcode or 0)
        self._replace()
        if self._task is None or self._tries < TRIES:
            return None
        return self._failed(f"its process died {TRIES} times ({cause})")

    def _expire(self) -> Row:
        self._replace()
        return self._failed(f"took longer than the limit of {self._limit:g} s")


def _serve(connection: Connection) -> None:
    """Make the row of every task that comes, until the other end closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches every process of a terminal: the first one decides
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with contextlib.suppress(EOFError, OSError):
        connection.send(HERE)
        work = connection.recv()()
        connection.send("ready")
        while True:
            connection.send(work(connection.recv()))


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _cause(code: int) -> str:
    if code == -getattr(signal, "SIGKILL", 9):
        return "killed: most often by the system, when memory runs out"
    return f"signal {-code}" if code < 0 else f"exit code {code}"


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """An environment for processes that are started meanwhile; libraries read it as they load."""
    before = {name: os.environ.get(name) for name in THREADS}
    os.environ.update(THREADS)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextlib.contextmanager
def _no_interrupt() -> Iterator[None]:
    """Let processes that are started meanwhile not hear of Ctrl-C, from their first instruction on."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    resource_tracker.ensure_running()  # which unblocks the signal when it starts
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
