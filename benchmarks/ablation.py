"""Train the four networks of the ablation (section 4.6), with equal budgets, for ``idam evaluate ablation``.

    python benchmarks/ablation.py FOLDER --data modelnet40
    idam evaluate ablation --data modelnet40 --model FOLDER

Each is the network for unseen categories, trained without the parts that its row lacks. A run that was stopped goes on
from its last checkpoint. Five times the budget of the published rows (2 epochs, 11 minutes of a core each) by default.
"""

from __future__ import annotations

import argparse
import shlex
import shutil
import sys
from pathlib import Path

from idam.errors import InputError, MissingDependencyError
from idam.lab.evaluation.methods import ABLATION
from idam.lab.evaluation.methods.network import ablation_weights
from idam.lab.training import Recipe, train
from idam.network.config import Config

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


def main(words: list[str] | None = None) -> None:
    """Read the command line and train."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="for the weights, and a folder of each run")
    parser.add_argument("--data", type=Path, required=True, help="folder of ModelNet40")
    parser.add_argument("--epochs", type=float, default=10, help="of each network")
    parser.add_argument("--batch-size", type=int, default=16)
    parser.add_argument("--device", default="auto", help="auto, cpu or cuda")
    parser.add_argument("--precision", choices=("32", "bf16"), default="bf16")
    arguments = parser.parse_args(words)
    command = shlex.join(["python", "benchmarks/ablation.py", *(sys.argv[1:] if words is None else words)])
    for method, config in CONFIGS.items():
        recipe = Recipe(
            "unseen-categories",
            config,
            epochs=arguments.epochs,
            batch_size=arguments.batch_size,
            schedule="one-cycle",
            learning_rate=1e-3,
            noise=0.002,
        )
        try:
            best = train(
                recipe,
                arguments.data,
                arguments.folder / method,
                resume=True,
                device=arguments.device,
                precision=arguments.precision,
                command=command,
            )
        except (InputError, MissingDependencyError) as error:
            parser.error(str(error))
        print(shutil.copy(best, ablation_weights(method, arguments.folder)))


if __name__ == "__main__":
    main()
