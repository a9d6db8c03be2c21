"""One table: every row asked for, shown and saved as it is finished."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from idam.errors import InputError, MissingDependencyError
from idam.io import check_destination
from idam.lab.evaluation.experiments import TestSet
from idam.lab.evaluation.methods import ABLATION, has_weights, rows_of
from idam.lab.evaluation.methods.network import find_ablation_weights, weights_for
from idam.lab.evaluation.record import Missing, read_rows, write_record
from idam.lab.evaluation.runner import LIMITS, Row, Task, run
from idam.lab.evaluation.table import Board

__all__ = ["evaluate"]


def evaluate(
    test: TestSet,
    methods: Sequence[str] | None = None,
    *,
    model: str | None = None,
    settings: Sequence[str] = (),
    jobs: int = 1,
    output: Path | None = None,
    resume: bool = False,
    command: str = "",
) -> list[Row | Missing]:
    """Measure methods on test pairs.

    Args:
        test: the pairs.
        methods: names of the rows; None for all of the table, of which those that cannot run here say why instead.
        model: weights for the rows that take any, or the folder of the ablation's; None for those trained for the
            experiment.
        settings: of the one method asked for.
        jobs: processes that share the pairs.
        output: JSON file, written after each row.
        resume: keep the rows that the file has already.
        command: the command line, for the file.

    Raises:
        InputError: a method, its weights or its settings are unknown, or the file cannot be used.
        MissingDependencyError: a method asked for by name cannot run here.
    """
    if settings and len(methods or ()) != 1:
        raise InputError("settings are of one method: give --set with one --method")
    if model is not None and methods and not any(map(has_weights, methods)):
        raise InputError(f"{', '.join(methods)} takes no weights: leave --model out")
    if resume and output is None:
        raise InputError("give --resume with --json, the file to go on with")
    tasks = [Task(name, _weights(name, model, test.name), tuple(settings)) for name in methods or rows_of(test.name)]
    if output is not None:
        check_destination(output)
    if methods is not None:
        for task in tasks:
            task.build()  # a wrong name should not cost the rows before it
    done = {(row.task, row.pairs): row for row in read_rows(output, test)} if resume and output is not None else {}
    with Board(test.name, len(tasks) * len(test)) as board:
        for task in tasks:
            board.begin(task.method)
            board.add(_row(task, test, board, jobs, done, required=methods is not None))
            if output is not None:
                write_record(output, test, board.rows, command, jobs)
    return board.rows


def _weights(method: str, model: str | None, experiment: str) -> str | None:
    """The weights of a row: those named go to every row that takes any; the ablation's are in a folder."""
    if method in ABLATION:
        return find_ablation_weights(method, model)
    if model is not None:
        return model if has_weights(method) else None
    return weights_for(method, experiment)


def _row(
    task: Task, test: TestSet, board: Board, jobs: int, done: dict[tuple[Task, int], Row], *, required: bool
) -> Row | Missing:
    known = done.get((task, min(LIMITS.get(task.method, len(test)), len(test))))
    if known is not None:
        board.advance(len(test))
        return known
    try:
        return run(task, test, board.advance, jobs)
    except MissingDependencyError as error:
        if required:
            raise
        board.advance(len(test))
        return Missing(task, str(error))
