"""Where a training starts, stands and ends: weights in and out, with their provenance."""

from __future__ import annotations

import io
import json
import math
import subprocess
from dataclasses import asdict, dataclass
from pathlib import Path
from pickle import UnpicklingError
from typing import Any, Protocol

import torch
from torch import nn

from idam.errors import InputError
from idam.io.files import one_line, write_bytes
from idam.lab.training.recipe import Recipe
from idam.network.model import IDAM
from idam.network.pretrained import load_model

__all__ = ["Origin", "Progress", "Scores", "history", "initial_model", "restore", "save_checkpoint"]


class Scores(Protocol):
    """What a validation found."""

    def to_dict(self) -> dict[str, float]:
        """All of it, by name."""


class Origin(Protocol):
    """What a model comes from: the pairs that it learns from, and those that it is validated on, in words."""

    @property
    def data(self) -> str:
        """What the pairs are made of."""

    @property
    def held(self) -> str:
        """What is validated on."""


@dataclass
class Progress:
    """Where a training stands; saved in every checkpoint."""

    step: int = 0
    best: float = math.inf
    seconds: float = 0.0


def initial_model(recipe: Recipe) -> IDAM:
    """The network to train, with random weights or those to start from; raise InputError where those do not fit."""
    model = IDAM(recipe.config)
    if recipe.start is not None:
        checkpoint = Path(recipe.start).suffix == ".ckpt"
        state = read_checkpoint(Path(recipe.start))["model"] if checkpoint else load_model(recipe.start).state_dict()
        try:
            model.load_state_dict(state)
        except RuntimeError:
            raise InputError(
                f"{recipe.start}: has another architecture; start from a model with the same options"
            ) from None
    return model


def history(
    experiment: str, options: dict[str, Any], progress: Progress, scores: Scores, origin: Origin, command: str
) -> dict[str, Any]:
    """The provenance of a model: what it was trained on, how far, and how it did on the validation pairs."""
    return {
        "experiment": experiment,
        "data": origin.data,
        "recipe": options,
        "steps": progress.step,
        "training_seconds": round(progress.seconds),
        "validation": {key: round(value, 5) for key, value in scores.to_dict().items()},
        "validation_pairs": origin.held,
        "command": command,
        "commit": commit(),
        "torch": torch.__version__,
    }


def commit() -> str:
    """The source's commit, or an empty string outside its own checkout."""
    folder = Path(__file__).parent
    try:
        # a package installed below someone else's checkout is not in its tree
        listed = subprocess.run(
            ["git", "ls-files", "--error-unmatch", Path(__file__).name], cwd=folder, capture_output=True, check=False
        )
        if listed.returncode != 0:
            return ""
        result = subprocess.run(
            ["git", "rev-parse", "--short", "HEAD"], cwd=folder, capture_output=True, text=True, check=False
        )
    except OSError:
        return ""
    return result.stdout.strip()


def save_checkpoint(
    path: Path, model: nn.Module, optimizer: torch.optim.Optimizer, progress: Progress, options: dict[str, Any]
) -> None:
    """Write everything needed to go on, atomically."""
    state = {
        "model": model.state_dict(),
        "optimizer": optimizer.state_dict(),
        "progress": asdict(progress),
        "recipe": json.dumps(options),
    }
    buffer = io.BytesIO()
    torch.save(state, buffer)
    write_bytes(path, buffer.getvalue())


def restore(path: Path, model: nn.Module, optimizer: torch.optim.Optimizer, options: dict[str, Any]) -> Progress:
    """Load a checkpoint, if there is one; raise InputError where it was trained with other options."""
    if not path.is_file():
        return Progress()
    state = read_checkpoint(path)
    if json.loads(state["recipe"]) != json.loads(json.dumps(options)):
        raise InputError(f"{path}: was trained with other options; give the same ones, or another --output")
    model.load_state_dict(state["model"])
    optimizer.load_state_dict(state["optimizer"])
    return Progress(**state["progress"])


def read_checkpoint(path: Path) -> dict[str, Any]:
    """What :func:`save_checkpoint` wrote; raise InputError where the file is something else."""
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
        if not {"model", "optimizer", "progress", "recipe"} <= state.keys():
            raise ValueError("parts are missing")
    except (OSError, RuntimeError, AttributeError, ValueError, EOFError, UnpicklingError) as error:
        raise InputError(f"{path}: not a checkpoint of idam ({one_line(error)}); start again without it") from None
    return dict(state)
