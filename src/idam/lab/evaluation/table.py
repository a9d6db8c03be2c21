"""The table that an evaluation prints, growing while it works."""

from __future__ import annotations

from collections.abc import Callable

from rich.console import Console, Group
from rich.live import Live
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from idam.lab.evaluation.methods import METHODS
from idam.lab.evaluation.paper import PAPER
from idam.lab.evaluation.record import Missing
from idam.lab.evaluation.runner import Row

__all__ = ["Board", "columns", "order", "results_table", "short_name"]

WIDTH = 130
"""Columns of a table that is not printed to a terminal."""

Cell = Callable[[Row], str]


def columns(experiment: str) -> dict[str, Cell]:
    """Headings of a table, and what stands below each for a row.

    Of the paper's experiments, what the paper reports, its figures in brackets; of practice pairs, what counts there.
    """
    middle = _practice_columns() if experiment.startswith("practice") else _paper_columns(experiment)
    return {
        "method": _name,
        **middle,
        "pairs": lambda row: str(row.pairs),
        "ms a pair": lambda row: f"{row.seconds_per_pair * 1000:.1f}",
    }


def results_table(experiment: str, rows: list[Row | Missing]) -> Table:
    """The rows as a table for the terminal; a row that could not be computed says why."""
    cells = columns(experiment)
    table = Table(*cells)
    for row in rows:
        if isinstance(row, Missing):
            table.add_row(row.task.method, row.reason.split(":")[0])
        else:
            table.add_row(*(cell(row) for cell in cells.values()))
    return table


def order(method: str) -> float:
    """Where a method stands in a table: those of one's own, such as the rivals, before the networks of this package."""
    rows, name = list(METHODS), short_name(method)
    return rows.index(name) if name in METHODS else rows.index("fpfh-idam-paper") - 0.5


def short_name(method: str) -> str:
    """A method of one's own by its function, the others as they are."""
    return method.rpartition(":")[2]


def _name(row: Row) -> str:
    settings = f" [{', '.join(row.task.settings)}]" if row.task.settings else ""
    return short_name(row.task.method) + (f" ({row.task.model})" if row.task.model else "") + settings


def _paper_columns(experiment: str) -> dict[str, Cell]:
    def beside(row: Row, place: int, text: str) -> str:
        # a method's other settings stand beside the same figures
        name = short_name(row.task.method).removesuffix("-tuned").removesuffix("-paper")
        reported = PAPER.get(experiment, {}).get(name)
        return text if reported is None else f"{text} ({reported[place]:g})"

    return {
        "RMSE(R)": lambda row: beside(row, 0, f"{row.metrics.rmse_r:.3f}"),
        "MAE(R)": lambda row: beside(row, 1, f"{row.metrics.mae_r:.3f}"),
        "RMSE(t)": lambda row: beside(row, 2, f"{row.metrics.rmse_t:.4f}"),
        "MAE(t)": lambda row: beside(row, 3, f"{row.metrics.mae_t:.4f}"),
        "recall": lambda row: f"{row.metrics.recall:.3f}",
    }


def _practice_columns() -> dict[str, Cell]:
    return {
        "recall": lambda row: f"{row.metrics.recall:.3f}",
        "with symmetric poses": lambda row: "" if row.symmetric_recall is None else f"{row.symmetric_recall:.3f}",
        "without axisymmetric": lambda row: "" if row.observable is None else f"{row.observable.recall:.3f}",
        "angle": lambda row: f"{row.metrics.angle:.2f}",
        "distance": lambda row: f"{row.metrics.distance:.4f}",
        "Chamfer": lambda row: "" if row.chamfer is None else f"{row.chamfer:.5f}",
    }


class Board:
    """The table with a progress bar below it; what is not a terminal gets the finished table alone."""

    def __init__(self, experiment: str, total: int) -> None:
        self.experiment = experiment
        self.rows: list[Row | Missing] = []
        console = Console()
        self.console = console if console.is_terminal else Console(width=WIDTH)
        self.progress = Progress(
            TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
        )
        self.task = self.progress.add_task("", total=total)
        self.live = Live(self._view(), console=self.console, transient=True)

    def __enter__(self) -> Board:
        if self.console.is_terminal:
            self.live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.live.stop()
        if self.rows:
            self.console.print(results_table(self.experiment, self.rows))

    def begin(self, name: str) -> None:
        """Say which row is being computed."""
        self.progress.update(self.task, description=name)

    def advance(self, pairs: int = 1) -> None:
        """Count pairs as done."""
        self.progress.advance(self.task, pairs)

    def add(self, row: Row | Missing) -> None:
        """Show a finished row."""
        self.rows.append(row)
        self.live.update(self._view())

    def _view(self) -> Group:
        return Group(results_table(self.experiment, self.rows), self.progress)
