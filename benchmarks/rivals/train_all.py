"""Train all nine rivals, one after the other, on a GPU in one go.

    python -m benchmarks.rivals.train_all FOLDER --data DIR

Sized to 18 minutes of an H200: 15 for DCP and PRNet together, 1 for each PointNetLK. It has not run on one yet. What
was stopped goes on, as each rival does from its ``last.ckpt``. Each leaves ``FOLDER/METHOD-EXPERIMENT.safetensors``
and, in a folder of the same name, the curves of its loss and its validation for TensorBoard.
"""

from __future__ import annotations

import argparse
import shlex
import shutil
import sys
from itertools import product
from pathlib import Path

from idam.errors import InputError, MissingDependencyError
from idam.lab.data.pairs import EXPERIMENTS

from .methods import RIVALS
from .train import Budget, Plan, positive, train

MINUTES = {"pointnetlk": 1.0, "dcp": 2.0, "prnet": 3.0}
"""Of each training: PRNet's step is three of DCP's."""


def main(words: list[str] | None = None) -> None:
    """Read the command line and train."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="for the weights, and a folder of each run")
    parser.add_argument("--data", type=Path, required=True, help="folder of ModelNet40")
    parser.add_argument("--times", type=positive, default=1.0, help="the minutes, times this")
    parser.add_argument("--batch-size", type=int, default=64)
    parser.add_argument("--validate-every", type=int, default=100, help="steps between validations and checkpoints")
    parser.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto")
    arguments = parser.parse_args(words)
    command = shlex.join(["python", "-m", "benchmarks.rivals.train_all", *(words or sys.argv[1:])])
    for experiment, method in product(EXPERIMENTS, RIVALS):
        name = f"{method}-{experiment}"
        # PointNetLK's finite differences need all digits, and its steps are cheap as they are
        transformer = method != "pointnetlk"
        plan = Plan(method, experiment, arguments.batch_size, "bf16" if transformer else "32", thin=transformer)
        try:
            best = train(
                plan,
                Budget(arguments.times * MINUTES[method], None),
                arguments.data,
                arguments.folder / name,
                resume=True,
                device=arguments.device,
                validate_every=arguments.validate_every,
                command=command,
            )
        except (InputError, MissingDependencyError) as error:
            parser.error(str(error))
        print(shutil.copy(best, arguments.folder / f"{name}.safetensors"))


if __name__ == "__main__":
    main()
