"""What a training under test does, step by step."""

from __future__ import annotations

from typing import Any

from idam.lab.training.log import Log

__all__ = ["watched_log"]


def watched_log(losses: list[Any], stop_after: int | None) -> type[Log]:
    """A log that keeps the loss of every step, without its gradient, and presses Ctrl-C after one if asked to."""

    class WatchedLog(Log):
        def step(self, step: int, loss: Any, done: int | None = None) -> None:
            super().step(step, loss, done)
            losses.append(type(loss)(*(part.detach() for part in loss)))
            if step == stop_after:
                raise KeyboardInterrupt

    return WatchedLog
