"""The command line: parse, call, print. Everything heavy is imported by the command that needs it."""

from __future__ import annotations

import logging
import shlex
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

from idam import __version__
from idam.errors import InputError, MissingDependencyError

if TYPE_CHECKING:
    from idam.result import RegistrationResult

__all__ = ["main"]

UNSURE = 1
BAD_INPUT = 2

app = typer.Typer(
    name="idam",
    help="Learned global registration of partially overlapping 3D point clouds.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)

Data = Annotated[Path, typer.Option("--data", help="Folder of ModelNet40 (modelnet40_ply_hdf5_2048).")]


def main() -> NoReturn:
    """Run the command line; bad input ends in one line on stderr and exit code 2."""
    try:
        code = app(standalone_mode=False)
    except (InputError, MissingDependencyError) as error:
        stop(str(error), BAD_INPUT)
    except (KeyboardInterrupt, typer.Abort):
        stop("interrupted", 130)
    except Exception as error:
        usage = getattr(error, "format_message", None)  # what the parser raises for a wrong call
        if usage is None:
            raise
        if not usage():  # no command: the help has been printed
            sys.exit(BAD_INPUT)
        stop(f"{usage()} See 'idam --help'.", BAD_INPUT)
    sys.exit(code if isinstance(code, int) else 0)


def stop(message: str, code: int) -> NoReturn:
    """Print one line on stderr and exit."""
    print("idam: " + " ".join(message.split()), file=sys.stderr)
    sys.exit(code)


@app.callback(invoke_without_command=True)
def about(version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False) -> None:
    """Learned global registration of partially overlapping 3D point clouds."""
    if version:
        print(f"idam {__version__}")
        raise typer.Exit


@app.command()
def register(
    source: Annotated[Path, typer.Argument(help="The cloud to move.")],
    target: Annotated[Path, typer.Argument(help="The cloud to lay it on.")],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Write the moved source here, colours and normals kept.")
    ] = None,
    transform: Annotated[Path | None, typer.Option(help="Write the 4x4 here.")] = None,
    json: Annotated[Path | None, typer.Option(help="Write the whole result here.")] = None,
    html: Annotated[Path | None, typer.Option(help="Write a page to look at the result, opens offline.")] = None,
    save_plot: Annotated[
        Path | None, typer.Option(help="Draw the result as .png or .svg; needs idam[figures].")
    ] = None,
    model: Annotated[str, typer.Option(help="Name or file of the weights; see 'idam models'.")] = "default",
    init: Annotated[Path | None, typer.Option(help="File of a 4x4 to start from.")] = None,
    max_angle: Annotated[float, typer.Option(help="Degrees that it turns at most.")] = 180.0,
    voxel_size: Annotated[
        float | None, typer.Option(help="Resolution for the network; from the data if left out.")
    ] = None,
    max_correspondence_distance: Annotated[
        float | None, typer.Option(help="Distance for fitness and RMSE; from the data if left out.")
    ] = None,
    refine: Annotated[str, typer.Option(help="Fine alignment: gicp, plane, point, symmetric or none.")] = "gicp",
    seed: Annotated[int, typer.Option(help="Of the starting rotations.")] = 0,
    device: Annotated[str, typer.Option(help="Where the network runs.")] = "cpu",
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print the 4x4 alone, for scripts.")] = False,
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="Say on stderr what each step did and took.")
    ] = False,
) -> None:
    """Lay SOURCE on TARGET: print the transform and how sure it is.

    The files may be PLY, PCD, XYZ, TXT, CSV, PTS, NPY, NPZ, OBJ, STL, OFF, LAS or LAZ. The exit code is 0 for a
    confident answer, 1 for one that is likely wrong and 2 for bad input.

    [bold]Examples[/bold]

      idam register scan1.ply scan2.ply

      idam register scan1.ply scan2.ply -o aligned.ply --transform T.txt --html look.html

      idam register scan1.ply scan2.ply -q > T.txt && echo "sure enough"
    """
    from idam import registration
    from idam.io import (
        check_destination,
        check_writable,
        read_point_cloud,
        read_transform,
        write_point_cloud,
        write_transform,
    )

    # before the work, and before the first of them is written
    if output is not None:
        check_writable(output)
    for path in (transform, json, html, save_plot):
        if path is not None:
            check_destination(path)
    if save_plot is not None:
        check_drawable(save_plot)
    source_cloud, target_cloud = read_point_cloud(source), read_point_cloud(target)
    with steps_told(verbose):
        result = registration.register(
            source_cloud,
            target_cloud,
            model=model,
            init=None if init is None else read_transform(init),
            max_angle=max_angle,
            voxel_size=voxel_size,
            max_correspondence_distance=max_correspondence_distance,
            refine=refine,
            seed=seed,
            device=device,
        )
    if output is not None:
        write_point_cloud(output, source_cloud.transformed(result.transformation))
    if transform is not None:
        write_transform(transform, result.transformation)
    if json is not None:
        result.save(json)
    if html is not None:
        from idam.report import write_report

        write_report(html, source_cloud, target_cloud, result, source_name=source.name, target_name=target.name)
    if save_plot is not None:
        from idam.figures.plot_result import write_plot

        write_plot(save_plot, source_cloud, target_cloud, result, source_name=source.name, target_name=target.name)
    show(result, quiet)
    if not result.converged:
        raise typer.Exit(UNSURE)


def check_drawable(path: Path) -> None:
    """Find out before the work whether a picture can be drawn there."""
    from idam.view import check_matplotlib

    if path.suffix.lower() not in (".png", ".svg"):
        raise InputError(f"{path}: unknown picture format '{path.suffix}': the ones to draw are .png, .svg")
    check_matplotlib("a result")


@contextmanager
def steps_told(verbose: bool) -> Iterator[None]:
    """Write what the steps log to stderr, if that is asked for."""
    log, handler = logging.getLogger("idam"), logging.StreamHandler()
    level = log.level
    if verbose:
        handler.setFormatter(logging.Formatter("%(message)s"))
        log.addHandler(handler)
        log.setLevel(logging.INFO)
    try:
        yield
    finally:
        log.removeHandler(handler)
        log.setLevel(level)


def show(result: RegistrationResult, quiet: bool = False) -> None:
    """Print a result: the 4x4 as CloudCompare takes it, then, unless quiet, the figures and why."""
    from idam.io import format_transform

    print(format_transform(result.transformation))
    if quiet:
        return
    print(f"fitness     {result.fitness:.3f}  (within {result.max_correspondence_distance:.4g})")
    print(f"inlier RMSE {result.inlier_rmse:.4g}")
    print(f"confidence  {result.confidence:.2f}")
    if result.reason:
        print(f"reason      {result.reason}")
    print(f"time        {result.seconds:.2f} s")


@app.command()
def models() -> None:
    """List the shipped models: what they were trained on and how they did."""
    from idam.network.pretrained import list_models, provenance

    for name in list_models():  # no table: names and commands are to be copied, whatever the terminal's width
        history = provenance(name)
        config = history["config"]
        print(name)
        print(
            f"  {config['features']} features, {history.get('experiment', '')}, {config['iterations']} iterations, "
            f"{history.get('steps', '')} steps, seed {history.get('recipe', {}).get('seed', '')}, "
            f"commit {history.get('commit') or 'unknown'}"
        )
        print(f"  {as_told(history.get('validation', {}))}")
        print(f"  {history.get('command', '')}")
    print("RMSE and MAE in degrees, network alone; accuracy: share of points whose best match is right.")
    print("All on shapes held out of the training.")


def as_told(scores: dict[str, float]) -> str:
    """What a validation found, on a line: the errors of a registration, or how well features match."""
    if "accuracy" in scores:
        return f"accuracy {scores['accuracy']:.3f}, matching loss {scores.get('matching', float('nan')):.3f}"
    return f"RMSE(R) {scores.get('rmse_r', float('nan')):.3f}, MAE(R) {scores.get('mae_r', float('nan')):.3f}"


@app.command()
def train(
    experiment: Annotated[str, typer.Argument(help="For what: a table of 'evaluate', or general.")],
    data: Data,
    features: Annotated[str, typer.Option(help="Point features: gnn, fpfh or invariant.")] = "gnn",
    output: Annotated[Path | None, typer.Option("--output", "-o", help="Folder for the weights and the log.")] = None,
    epochs: Annotated[float, typer.Option(help="Passes over the training pairs; may be a fraction.")] = 40,
    batch_size: Annotated[int, typer.Option(help="Pairs a step, over all processes.")] = 16,
    schedule: Annotated[str, typer.Option(help="step (the paper's) or one-cycle.")] = "step",
    learning_rate: Annotated[float, typer.Option(help="Adam's, at its highest.")] = 1e-4,
    start: Annotated[
        str | None, typer.Option(help="Name or file of a model, or a last.ckpt, whose weights to start from.")
    ] = None,
    eliminate: Annotated[
        bool, typer.Option("--eliminate", help="A last stage: train on the points that hard elimination keeps.")
    ] = False,
    radius: Annotated[float, typer.Option(help="Distance within which points match.")] = 0.05,
    keep: Annotated[float, typer.Option(help="Share of points that balanced sampling draws.")] = 1 / 6,
    noise: Annotated[
        float | None, typer.Option(help="Sigma of the noise on both clouds; the experiment's own if left out.")
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="A field of the network's configuration, as iterations=20."),
    ] = None,
    seed: Annotated[int, typer.Option(help="Of the weights, pairs and samples.")] = 0,
    device: Annotated[str, typer.Option(help="auto, cpu or cuda.")] = "auto",
    precision: Annotated[str, typer.Option(help="32 or bf16.")] = "32",
    validate_every: Annotated[int, typer.Option(help="Steps between checkpoints.")] = 250,
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the last checkpoint.")] = False,
) -> None:
    r"""Train a model; the defaults are the paper's recipe. Under torchrun it uses every process.

    General training, on scans as practice has them, teaches features and significance alone: see the last example.

    Its data may have a folder 'meshes' of .ply meshes besides. Noise, radius and keep play no part in it.

    [bold]Examples[/bold]

      idam train unseen-shapes --data modelnet40

      idam train gaussian-noise --data modelnet40 --epochs 4 --schedule one-cycle --learning-rate 1e-3 --precision bf16

      torchrun --nproc-per-node 4 -m idam train unseen-shapes --data modelnet40

      idam train general --data modelnet40 --features invariant --set convolution=false --set hybrid_elimination=false \
      --set iterations=1 --set blocks=1 --epochs 6 --batch-size 4 --schedule one-cycle --learning-rate 2e-3
    """
    from idam.network.config import Config
    from idam.settings import with_settings
    from idam.training import Recipe
    from idam.training import train as run

    recipe = Recipe(
        experiment=experiment,
        config=with_settings(Config(features=features), settings or ()),
        epochs=epochs,
        batch_size=batch_size,
        schedule=schedule,
        learning_rate=learning_rate,
        start=start,
        eliminate=eliminate,
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
        validate_every=validate_every,
        command=shlex.join(["idam", *sys.argv[1:]]),
    )
    print(f"best model: {best}")


@app.command()
def evaluate(
    experiment: Annotated[
        str | None,
        typer.Argument(
            help="unseen-shapes, unseen-categories, gaussian-noise, ablation, practice or practice-any-rotation; "
            "or give --pairs."
        ),
    ] = None,
    data: Annotated[Path | None, typer.Option(help="Folder of ModelNet40 (modelnet40_ply_hdf5_2048).")] = None,
    pairs: Annotated[Path | None, typer.Option(help="Your own pairs: .npz of source, target, R and t.")] = None,
    method: Annotated[list[str] | None, typer.Option(help="Rows to compute; all if left out.")] = None,
    model: Annotated[
        str | None, typer.Option(help="Weights for the learned rows; those trained for the experiment if left out.")
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="A setting of the one method asked for."),
    ] = None,
    limit: Annotated[int | None, typer.Option(min=1, help="Only so many pairs, for a quick look.")] = None,
    jobs: Annotated[int, typer.Option(min=1, help="Processes that share the pairs.")] = 1,
    json: Annotated[Path | None, typer.Option("--json", help="Write the rows here, after each of them.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Keep the rows that the JSON file has already.")] = False,
) -> None:
    """Measure methods on the pairs of an experiment, or on your own; the paper's figures stand in brackets.

    [bold]Examples[/bold]

      idam evaluate unseen-shapes --data modelnet40 --limit 100

      idam evaluate gaussian-noise --data modelnet40 --method fgr --set fgr_distance=0.05

      idam evaluate --pairs pairs.npz --method gnn-idam --model gnn-unseen-shapes --json out.json
    """
    from idam.evaluation.evaluate import evaluate as run
    from idam.evaluation.experiments import read_pairs, test_set

    if (experiment is None) == (pairs is None):
        raise InputError("give either an experiment with --data or your own --pairs")
    if pairs is not None:
        test = read_pairs(pairs)
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


@app.command()
def figures(
    output: Annotated[Path, typer.Argument(help="Folder for the figures, each as PNG and SVG.")],
    data: Data,
    scans: Annotated[
        list[Path] | None, typer.Option("--scan", help="Scans to register without fine-tuning: source, target, ...")
    ] = None,
    speed: Annotated[Path | None, typer.Option(help="Times that benchmarks/speed.py --json wrote, to plot.")] = None,
    model: Annotated[str, typer.Option(help="Weights for the figures with noise.")] = "gnn-gaussian-noise",
) -> None:
    """Draw the figures of the paper's appendix B, and curves of error, validity and speed.

    [bold]Example[/bold]

      idam figures out --data modelnet40 --scan bun045.ply --scan bun000.ply
    """
    from idam.figures import draw_figures

    for path in draw_figures(output, data, scans=scans or (), speed=speed, model=model, progress=tell):
        print(path)


def tell(what: str) -> None:
    """Say on a terminal's stderr what is being done."""
    if sys.stderr.isatty():
        print(what, file=sys.stderr)


data_app = typer.Typer(help="Fetch the data that models are trained and measured on.", no_args_is_help=True)
app.add_typer(data_app, name="data")


@data_app.callback()
def about_data() -> None:
    """Fetch the data that models are trained and measured on."""


@data_app.command()
def modelnet40(
    folder: Annotated[Path, typer.Argument(help="Where to put it, then to be given as --data.")],
    url: Annotated[str | None, typer.Option(help="Of the archive, where the usual address does not answer.")] = None,
    sha256: Annotated[str | None, typer.Option(help="Of the archive, to check before unpacking.")] = None,
) -> None:
    """Download ModelNet40 (435 MB) and unpack it, go on with a broken download, or check a folder that has it."""
    from idam.data.download import MODELNET40_URL, fetch_modelnet40

    with download_bar() as advance:
        found = fetch_modelnet40(folder, url or MODELNET40_URL, sha256, progress=advance)
    print(f"ModelNet40 is in {found}")


@contextmanager
def download_bar() -> Iterator[Callable[[int, int | None], None]]:
    """A bar of bytes on stderr, and the function that moves it."""
    from rich.console import Console
    from rich.progress import BarColumn, DownloadColumn, Progress, TimeRemainingColumn, TransferSpeedColumn

    console = Console(stderr=True)
    columns = BarColumn(), DownloadColumn(), TransferSpeedColumn(), TimeRemainingColumn()
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task("", total=None)
        yield lambda done, total: progress.update(task, completed=done, total=total)


@app.command()
def demo(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the page and the aligned cloud.")] = Path(
        "out"
    ),
) -> None:
    """Align two shipped scans of a CAD part, seen by a depth camera from 60 degrees apart."""
    from idam.demo import run

    result, files = run(output)
    show(result)
    for what, path in files.items():
        print(f"{what:<12}{path}")


if __name__ == "__main__":
    main()
