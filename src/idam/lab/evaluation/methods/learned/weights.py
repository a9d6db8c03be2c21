"""Where the weights of the learned rivals are: not in the wheel, but where the user trained them."""

from __future__ import annotations

import os
from pathlib import Path

from idam.errors import InputError, MissingDependencyError
from idam.lab.data.pairs import EXPERIMENTS

__all__ = ["find_rival_weights", "rival_weights_for"]

FOLDER = "IDAM_RIVALS"
"""The environment variable that names the folder of ``{method}-{experiment}.safetensors``."""


def rival_weights_for(method: str, experiment: str | None) -> str | None:
    """The name of a rival's weights for an experiment; None, the method's default, where it was not trained for it."""
    name = f"{method}-{experiment}"
    return name if experiment in EXPERIMENTS or in_folder(name).is_file() else None


def find_rival_weights(method: str, model: str | None) -> Path:
    """The file of a rival's weights.

    Args:
        method: the rival.
        model: a ``.safetensors`` file, or a name in the folder of IDAM_RIVALS; None for the one for unseen shapes.

    Raises:
        InputError: there is no such file.
        MissingDependencyError: the weights for one of the paper's experiments are still to be trained.
    """
    name = model or f"{method}-unseen-shapes"
    path = Path(name) if name.endswith(".safetensors") else in_folder(name)
    if path.is_file():
        return path
    experiment = name.removeprefix(f"{method}-")
    if experiment not in EXPERIMENTS:
        raise InputError(f"unknown model {name!r}: give the .safetensors file that benchmarks/train_rival.py wrote")
    raise MissingDependencyError(
        f"{method} has no weights here: python benchmarks/train_rival.py {method} {experiment} --data DIR --output OUT "
        f"--minutes 120, then copy OUT/best.safetensors to {name}.safetensors in the folder that {FOLDER} names"
    )


def in_folder(name: str) -> Path:
    """The file of that name in the folder of IDAM_RIVALS, or in the current one."""
    return Path(os.environ.get(FOLDER, ".")) / f"{name}.safetensors"
