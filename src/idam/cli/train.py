"""``idam train``."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Annotated

import typer

from idam.cli.shared import Data

__all__ = ["train"]


def train(
    experiment: Annotated[str, typer.Argument(help="One of 'idam evaluate', or general.")],
    data: Data,
    features: Annotated[str, typer.Option(help="Point features: gnn, fpfh or invariant.")] = "gnn",
    output: Annotated[Path | None, typer.Option("--output", "-o", help="Folder for the weights and the log.")] = None,
    epochs: Annotated[float, typer.Option(help="Passes over the training pairs, also a fraction.")] = 40,
    batch_size: Annotated[int, typer.Option(help="Pairs a step, over all processes.")] = 16,
    schedule: Annotated[str, typer.Option(help="step (the paper's) or one-cycle.")] = "step",
    learning_rate: Annotated[float, typer.Option(help="Highest learning rate of Adam.")] = 1e-4,
    start: Annotated[
        str | None, typer.Option(help="Name or file of a model, or a last.ckpt, whose weights to start from.")
    ] = None,
    pairs: Annotated[
        Path | None,
        typer.Option(help="Your own scans for general training, as 'evaluate --pairs' takes them: half of all pairs."),
    ] = None,
    eliminate: Annotated[
        bool, typer.Option("--eliminate", help="Last stage: train on the points that hard elimination keeps.")
    ] = False,
    pool: Annotated[
        int | None,
        typer.Option(help="Draw so many pairs once and keep their features, which are then not trained."),
    ] = None,
    radius: Annotated[float, typer.Option(help="Distance within which points match.")] = 0.05,
    keep: Annotated[float, typer.Option(help="Share of points that balanced sampling draws.")] = 1 / 6,
    noise: Annotated[
        float | None, typer.Option(help="Sigma of the noise on both clouds; the experiment's own if left out.")
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="A setting of the network, such as iterations=20."),
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of weights, pairs and samples.")] = 0,
    device: Annotated[str, typer.Option(help="auto, cpu or cuda.")] = "auto",
    precision: Annotated[str, typer.Option(help="32 or bf16.")] = "32",
    fuse: Annotated[bool, typer.Option("--fuse", help="Fuse the convolutions; needs a C++ compiler.")] = False,
    validate_every: Annotated[int, typer.Option(help="Steps between checkpoints.")] = 250,
    resume: Annotated[bool, typer.Option("--resume", help="Continue from the last checkpoint.")] = False,
) -> None:
    r"""Train a model; the defaults are the paper's recipe. Runs in many processes under torchrun. Needs idam\[lab].

    General training, on pairs like real scans, teaches features and significance alone: see the last example.

    With --pairs, half of the training pairs are your own scans; --start general continues from the default model.

    Its data may also have a folder 'meshes' of .ply meshes. It ignores --noise, --radius and --keep.

    [bold]Examples[/bold]

      idam train unseen-shapes --data modelnet40

      idam train gaussian-noise --data modelnet40 --epochs 4 --schedule one-cycle --learning-rate 1e-3 --precision bf16

      torchrun --nproc-per-node 4 -m idam train unseen-shapes --data modelnet40

      idam train general --data modelnet40 --features invariant --set convolution=false --set hybrid_elimination=false \
      --set iterations=1 --set blocks=1 --epochs 6 --batch-size 4 --schedule one-cycle --learning-rate 2e-3
    """
    from idam.lab.settings import with_settings
    from idam.lab.training import Recipe
    from idam.lab.training import train as run
    from idam.network.config import Config

    recipe = Recipe(
        experiment=experiment,
        config=with_settings(Config(features=features), settings or ()),
        epochs=epochs,
        batch_size=batch_size,
        schedule=schedule,
        learning_rate=learning_rate,
        start=start,
        pairs=None if pairs is None else str(pairs),
        eliminate=eliminate,
        pool=pool,
        radius=radius,
        keep=keep,
        noise=noise,
        seed=seed,
    )
    best = run(
        recipe,
        data,
        output or Path("runs") / f"{features}-{experiment}",
        resume=resume,
        device=device,
        precision=precision,
        fuse=fuse,
        validate_every=validate_every,
        command=shlex.join(["idam", *sys.argv[1:]]),
    )
    print(f"best model: {best}")
