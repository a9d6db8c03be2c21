"""``idam evaluate``."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Annotated

import typer

from idam.errors import InputError

__all__ = ["evaluate"]


def evaluate(
    experiment: Annotated[
        str | None,
        typer.Argument(
            help="unseen-shapes, unseen-categories, gaussian-noise, ablation, practice or practice-any-rotation; "
            "or give --pairs."
        ),
    ] = None,
    data: Annotated[Path | None, typer.Option(help="Folder of ModelNet40 (modelnet40_ply_hdf5_2048).")] = None,
    pairs: Annotated[
        Path | None, typer.Option(help="Your own pairs: .npz of source, target, R and t, or .json of files.")
    ] = None,
    method: Annotated[
        list[str] | None,
        typer.Option(help="Method to measure, or your own package.module:function; all methods if left out."),
    ] = None,
    model: Annotated[
        str | None,
        typer.Option(
            help="Weights of the learned methods; those trained for the experiment if left out. For the ablation, the "
            "folder that benchmarks/ablation.py wrote, or that IDAM_ABLATION names."
        ),
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="A setting of the method."),
    ] = None,
    within: Annotated[
        tuple[float, float] | None,
        typer.Option(
            metavar="DEGREES DISTANCE", help="With --pairs: largest errors of a right answer; 5 0.05 if left out."
        ),
    ] = None,
    limit: Annotated[int | None, typer.Option(min=1, help="Only the first so many pairs.")] = None,
    jobs: Annotated[int, typer.Option(min=1, help="Number of processes.")] = 1,
    json: Annotated[Path | None, typer.Option("--json", help="Write the results here, after each method.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Keep the results that are in the JSON file.")] = False,
) -> None:
    r"""Measure methods on the pairs of an experiment or on your own. Needs idam\[lab].

    The paper's figures stand in brackets.

    [bold]Examples[/bold]

      idam evaluate unseen-shapes --data modelnet40 --limit 100

      idam evaluate gaussian-noise --data modelnet40 --method fgr --set fgr_distance=0.05

      idam evaluate --pairs pairs.npz --method gnn-idam --model gnn-unseen-shapes --json out.json

      idam evaluate --pairs scans/pairs.json --method register --method mine:align --within 5 0.01
    """
    from idam.lab.evaluation.evaluate import evaluate as run
    from idam.lab.evaluation.experiments import read_pairs, test_set

    if (experiment is None) == (pairs is None):
        raise InputError("give either an experiment with --data or your own --pairs")
    if within is not None and pairs is None:
        raise InputError("--within is for your own --pairs: an experiment has bounds of its own")
    if pairs is not None:
        test = read_pairs(pairs, within)
    elif data is None:
        raise InputError("an experiment needs --data, the folder of ModelNet40")
    else:
        test = test_set(str(experiment), data)
    run(
        test if limit is None else test.first(limit),
        method,
        model=model,
        settings=settings or (),
        jobs=jobs,
        output=json,
        resume=resume,
        command=shlex.join(["idam", *sys.argv[1:]]),
    )
