"""What a training shows while it runs."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol

from torch import Tensor

from idam.lab.training.checkpoint import Scores

__all__ = ["Log", "Parts"]


class Parts(Protocol):
    """A loss by its parts: a named tuple of tensors, and the sum that is minimised."""

    @property
    def total(self) -> Tensor:
        """The sum that is minimised."""

    def _asdict(self) -> dict[str, Any]: ...


class Log:
    """A progress bar with the parts of the loss, and the same figures in TensorBoard."""

    def __init__(self, folder: Path, total: int, done: int, *, enabled: bool) -> None:
        from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
        from rich.progress import Progress as Bar
        from torch.utils.tensorboard import SummaryWriter

        self.enabled = enabled
        self.bar = Bar(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
            disable=not enabled,
        )
        self.task = self.bar.add_task("starting", total=total, completed=done)
        self.writer = SummaryWriter(str(folder)) if enabled else None

    def __enter__(self) -> Log:
        self.bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.bar.stop()
        if self.writer is not None:
            self.writer.close()

    def step(self, step: int, loss: Parts, done: int | None = None) -> None:
        """Show the parts of one step's loss, and how much of the total is done: the steps, unless told otherwise."""
        if self.writer is None:
            return
        figures = {name: value.item() for name, value in loss._asdict().items()}
        text = " ".join(f"{name} {value:.3f}" for name, value in figures.items())
        self.bar.update(self.task, completed=step + 1 if done is None else done, description=text)
        if step % 10 == 0:
            for name, value in figures.items():
                self.writer.add_scalar(f"train/{name}", value, step)

    def validation(self, step: int, scores: Scores) -> None:
        """Show what a validation found."""
        self.bar.console.print(
            f"step {step + 1}: " + " ".join(f"{k} {v:.4f}" for k, v in scores.to_dict().items()), soft_wrap=True
        )
        if self.writer is not None:
            for name, value in scores.to_dict().items():
                self.writer.add_scalar(f"validation/{name}", value, step)
