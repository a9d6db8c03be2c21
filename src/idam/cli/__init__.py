"""The command line: parse, call, print. Everything heavy is imported by the command that needs it."""

from __future__ import annotations

import os
import sys
from typing import Annotated, NoReturn

import typer

from idam import __version__
from idam.cli.apply import apply
from idam.cli.batch import batch
from idam.cli.data import data
from idam.cli.demo import demo
from idam.cli.evaluate import evaluate
from idam.cli.figures import figures
from idam.cli.info import info
from idam.cli.merge import merge
from idam.cli.models import models
from idam.cli.register import register
from idam.cli.shared import BAD_INPUT
from idam.cli.train import train
from idam.cli.view import view
from idam.errors import InputError, MissingDependencyError

__all__ = ["main"]

BROKEN_PIPE = 141
"""What shells make of a program whose reader has gone, as ``| head`` does."""

LAB = ("torch", "scipy", "h5py", "lightning_fabric", "tensorboard", "matplotlib")
"""Packages that the core does without, and training, evaluation and figures need."""

app = typer.Typer(
    name="idam",
    help="Learned global registration of partially overlapping 3D point clouds.",
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)


def main() -> NoReturn:
    """Run the command line; bad input ends in one line on stderr and exit code 2."""
    try:
        code = app(standalone_mode=False, prog_name="idam")
        sys.stdout.flush()
    except (InputError, MissingDependencyError) as error:
        stop(str(error), BAD_INPUT)
    except ModuleNotFoundError as error:
        if error.name is None or error.name.partition(".")[0] not in LAB:
            raise
        stop(f"this needs {error.name}, of the packages for the lab: pip install 'idam[lab]'", BAD_INPUT)
    except (KeyboardInterrupt, typer.Abort):
        stop("interrupted", 130)
    except SystemExit as stopped:  # which the parser makes of a reader that has gone, with the code of an unsure answer
        sys.exit(BROKEN_PIPE if isinstance(stopped.__context__, BrokenPipeError) else stopped.code)
    except OSError as error:  # files raise InputError: it is the standard output
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # or Python would try once more as it exits
        if isinstance(error, BrokenPipeError):
            sys.exit(BROKEN_PIPE)
        stop(f"cannot write to the standard output ({error.strerror or error})", BAD_INPUT)
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


for command in (register, merge, batch, apply, info, view, demo, models, train, evaluate, figures):
    app.command()(command)
app.add_typer(data, name="data")
