"""Train the four networks of the ablation (section 4.6), with equal budgets, for ``idam evaluate ablation``.

    python benchmarks/ablation.py FOLDER --data modelnet40
    idam evaluate ablation --data modelnet40 --model FOLDER

Each is the network for unseen categories, trained without the parts that its row lacks, in two stages as the models of
the package were: on balanced samples, then on the points that its own hard elimination keeps (random ones without it).
With --start, all four begin with the features of that model, and learn everything else anew. A run that was stopped
goes on from its last checkpoint.
"""

from __future__ import annotations

import argparse
import shlex
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import torch

from idam.errors import InputError, MissingDependencyError
from idam.io import make_folder
from idam.lab.evaluation.methods import ABLATION
from idam.lab.evaluation.methods.network import ablation_weights
from idam.lab.training import Recipe, train
from idam.network.config import Config
from idam.network.model import IDAM
from idam.network.pretrained import load_model, save_model

CONFIGS = dict(
    zip(
        ABLATION,
        (
            Config(convolution=False, hard_elimination=False, hybrid_elimination=False),
            Config(hard_elimination=False, hybrid_elimination=False),
            Config(hybrid_elimination=False),
            Config(),
        ),
        strict=True,
    )
)


STAGES = (
    Recipe("unseen-categories", noise=0.002, learning_rate=1e-3, schedule="one-cycle"),
    Recipe("unseen-categories", noise=0.0005, learning_rate=5e-4, schedule="one-cycle", eliminate=True),
)
"""As in the provenance of ``gnn-unseen-categories``."""
FIRST = 0.6
"""The first stage's share of the epochs."""


def main(words: list[str] | None = None) -> None:
    """Read the command line and train."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="for the weights, and a folder of each run")
    parser.add_argument("--data", type=Path, required=True, help="folder of ModelNet40")
    parser.add_argument("--start", help="model whose features all four begin with; random ones if left out")
    parser.add_argument("--epochs", type=float, default=10, help="of each network")
    parser.add_argument("--batch-size", type=int, default=16)
    parser.add_argument("--device", default="auto", help="auto, cpu or cuda")
    parser.add_argument("--precision", choices=("32", "bf16"), default="bf16")
    parser.add_argument("--fuse", action="store_true", help="fuse the convolutions; needs a C++ compiler")
    arguments = parser.parse_args(words)
    command = shlex.join(["python", "benchmarks/ablation.py", *(sys.argv[1:] if words is None else words)])
    for method in CONFIGS:
        try:
            print(shutil.copy(train_one(method, arguments, command), ablation_weights(method, arguments.folder)))
        except (InputError, MissingDependencyError) as error:
            parser.error(str(error))


def train_one(method: str, arguments: argparse.Namespace, command: str) -> Path:
    """Train the network of one row, stage after stage; the path of the best model of the last."""
    folder = make_folder(arguments.folder / method)
    start = None if arguments.start is None else begin_with_features(arguments.start, method, folder)
    best = folder
    for number, (stage, share) in enumerate(zip(STAGES, (FIRST, 1 - FIRST), strict=True), start=1):
        best = train(
            replace(
                stage,
                config=CONFIGS[method],
                epochs=arguments.epochs * share,
                batch_size=arguments.batch_size,
                start=None if start is None else str(start),
            ),
            arguments.data,
            folder / f"stage{number}",
            resume=True,
            device=arguments.device,
            precision=arguments.precision,
            fuse=arguments.fuse,
            command=command,
        )
        start = best.with_name("last.ckpt")
    return best


def begin_with_features(name: str, method: str, folder: Path) -> Path:
    """A file of the row's network with the features of a trained model the rest at random, unless it is there."""
    path = folder / "start.safetensors"
    if not path.exists():
        torch.manual_seed(0)
        network = IDAM(CONFIGS[method])
        network.features.load_state_dict(load_model(name).features.state_dict())
        save_model(path, network, {"command": f"features of {name}"})
    return path


if __name__ == "__main__":
    main()
