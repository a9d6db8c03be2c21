"""``idam batch``."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from idam.cli.shared import INTERRUPTED, UNSURE, tell
from idam.errors import InputError

if TYPE_CHECKING:
    from idam.batch.ledger import Ledger
    from idam.batch.pairs import Pair
    from idam.batch.rows import Row

__all__ = ["batch"]


def batch(
    pairs: Annotated[
        Path | None,
        typer.Argument(help="CSV with columns source and target, JSONL, or text with two names a line; - for stdin."),
    ] = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Folder of the run; with --collect, the table.")
    ] = None,
    within: Annotated[Path | None, typer.Option(help="Pair the scans in this folder with one another.")] = None,
    partners: Annotated[
        int | None,
        typer.Option(min=1, help="Likeliest partners of each scan; if left out, all for up to 30 scans, else 8."),
    ] = None,
    collect: Annotated[
        Path | None, typer.Option(help="Write the rows of this run as one table: .csv, .jsonl or .parquet.")
    ] = None,
    jobs: Annotated[int | None, typer.Option(min=1, help="Processes; as many as cores if left out.")] = None,
    shard: Annotated[str | None, typer.Option(metavar="I/N", help="Only part I of N; others do the rest.")] = None,
    engine: Annotated[str, typer.Option(help="local, or ray for a cluster; needs idam\\[ray].")] = "local",
    address: Annotated[str | None, typer.Option(help="Of the Ray cluster; auto for this machine's.")] = None,
    retry_failed: Annotated[bool, typer.Option("--retry-failed", help="Try pairs again that failed before.")] = False,
    time_limit: Annotated[float, typer.Option(help="Seconds that a pair may take.")] = 600.0,
    settings: Annotated[
        list[str] | None, typer.Option("--set", metavar="NAME=VALUE", help="An option of register, for all pairs.")
    ] = None,
) -> None:
    """Register many pairs; stop and start again at any time.

    The rows are kept in the folder of the run, each as soon as it is done. The same command goes on where it stopped,
    however it was stopped. The exit code is 0 when every pair was registered, 1 when some failed, and 2 for bad input.

    [bold]Examples[/bold]

      idam batch pairs.csv -o run/

      idam batch --within scans/ -o run/ --set refine=plane

      idam batch --collect run/ -o results.csv
    """
    if sum(given is not None for given in (pairs, within, collect)) != 1:
        raise InputError("give one of: a file of PAIRS, --within FOLDER, or --collect RUN")
    if output is None:
        raise InputError("give the folder of the run, or the table, as -o")
    if collect is not None:
        gather(collect, output)
        return
    if not time_limit > 0:
        raise InputError(f"the time limit must be more than 0 s, not {time_limit:g}")
    from idam.batch.ledger import Ledger
    from idam.batch.options import check_options, job_of, parse_options
    from idam.batch.pairs import by_scan, read_pairs
    from idam.batch.work import Register

    run, part = engine_of(engine, address), parse_shard(shard)
    options = parse_options(settings or ())
    check_options(options)
    work = read_pairs(str(pairs)) if within is None else chosen(within, partners)
    with Ledger(output, job_of(options), work, part) as ledger:
        todo = by_scan(ledger.todo(retry_failed))
        try:
            follow(ledger, run(todo, partial(Register, options), jobs, time_limit), len(todo))
        except KeyboardInterrupt:
            left = len(ledger.todo())
            print(f"idam: interrupted: {left} pairs are left: run the same command to go on", file=sys.stderr)
            raise typer.Exit(INTERRUPTED) from None
        failed = sum(status == "failed" for status in ledger.status.values())
        print(f"{len(ledger.status)} pairs, {failed} failed. For a table: idam batch --collect {output} -o results.csv")
    if failed:
        raise typer.Exit(UNSURE)


def gather(run: Path, table: Path) -> None:
    """Write a run's rows as one table."""
    from idam.batch.collect import collect

    rows, missing = collect(run, table)
    print(f"{rows} rows: {table}")
    if missing:
        print(f"idam: {missing} pairs have no row yet: run the same command to go on", file=sys.stderr)
        raise typer.Exit(UNSURE)


def chosen(folder: Path, partners: int | None) -> list[Pair]:
    """The pairs of a folder's scans."""
    from idam.batch.within import pairs_within

    tell("choosing pairs")
    return pairs_within(folder, partners)


def engine_of(name: str, address: str | None) -> Callable[..., Iterator[Row]]:
    """What runs the pairs, given pairs, work, jobs and time limit."""
    if name == "local" and address is None:
        from idam.batch import local

        return local.run
    if name == "ray":
        from idam.batch import distributed

        return partial(distributed.run, address=address)
    raise InputError("--address needs --engine ray" if name == "local" else f"unknown engine {name!r}: local or ray")


def parse_shard(text: str | None) -> tuple[int, int]:
    """Part and number of parts; the only one where none is named."""
    part, _, parts = (text or "1/1").partition("/")
    if not (part.isdecimal() and parts.isdecimal() and 1 <= int(part) <= int(parts)):
        raise InputError(f"shard {text!r}: give I/N with I from 1 to N, such as 3/16")
    return int(part), int(parts)


def follow(ledger: Ledger, rows: Iterable[Row], total: int) -> None:
    """Keep every row as it comes, and show on a terminal how far it is."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[told]}"),
        TimeRemainingColumn(),
    )
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task("", total=total, told="")
        failed, confidence = 0, 0.0
        for done, row in enumerate(rows, 1):
            ledger.append(row)
            failed += row["status"] == "failed"
            confidence += row["confidence"] or 0.0
            mean = confidence / max(1, done - failed)
            told = f"{pace(progress.tasks[task].speed)}{failed} failed, mean confidence {mean:.0%}"
            progress.update(task, advance=1, told=told)


def pace(speed: float | None) -> str:
    """Say how fast pairs are done, given pairs a second, in three digits: ``12.5 pairs/s, `` or ``3.08 s a pair, ``."""
    if not speed:
        return ""
    return f"{speed:.3g} pairs/s, " if speed >= 1 else f"{1 / speed:.3g} s a pair, "
