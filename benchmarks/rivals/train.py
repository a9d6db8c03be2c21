"""Train a learned rival on the pairs that IDAM is trained on, for a given time or number of epochs.

    python -m benchmarks.rivals.train {pointnetlk,dcp,prnet} EXPERIMENT --data DIR --output FOLDER --minutes 120

Shapes, pairs and the held-out validation split are those of ``idam train`` with the same seed. ``best.safetensors`` is
the model with the least validation MAE(R), ``last.ckpt`` what ``--resume`` goes on from; minutes count over all
resumptions, validations included. Adam's rate rises over the first 2 % of the budget and is divided by 10 after 30, 60
and 80 %, the shares of DCP's 250 epochs after which its authors divide it; gradients are clipped to norm 1, and a step
without a finite one is left out; with --thin the first 30 % of the budget see a random third of each cloud's points, in
a quarter of the time: on all of these the papers are silent.
"""

from __future__ import annotations

import argparse
import shlex
import sys
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.utils import clip_grad_norm_

from idam.errors import InputError, MissingDependencyError
from idam.io import make_folder
from idam.lab.data.modelnet40 import experiment_shapes
from idam.lab.data.pairs import Pairs
from idam.lab.training.batches import generator_at, pairs_at, split_validation
from idam.lab.training.checkpoint import Progress, history, restore, save_checkpoint
from idam.lab.training.log import Log
from idam.lab.training.loop import check_batch, check_finite, check_installed, check_run
from idam.lab.training.memory import keep_freed_memory
from idam.lab.training.recipe import TRAININGS, Recipe, check
from idam.lab.training.task import PairTask, validate
from idam.network.geometry import gather_points
from idam.network.pretrained import save_weights

from .features import Features
from .methods import RIVALS
from .rival import Rival

DROPS = (0.3, 0.6, 0.8)
WARM_UP = 0.02
THIN = 0.3
"""Share of the budget that sees a third of the points, where thinning is asked for."""
VALIDATION_BATCH = 20


@dataclass(frozen=True)
class Plan:
    """What a checkpoint must agree on to be gone on from; the budget may be another."""

    method: str
    experiment: str
    batch_size: int = 8
    precision: str = "32"
    thin: bool = False
    seed: int = 0

    @property
    def recipe(self) -> Recipe:
        """What makes the shapes and pairs those of ``idam train``."""
        return Recipe(self.experiment, batch_size=self.batch_size, seed=self.seed)


@dataclass(frozen=True)
class Budget:
    """How long to train: minutes, or epochs where these are None."""

    minutes: float | None
    epochs: float | None

    def share(self, progress: Progress, per_epoch: int) -> float:
        """The share that is used."""
        if self.minutes is not None:
            return progress.seconds / (60 * self.minutes)
        assert self.epochs is not None
        return progress.step / max(1, round(self.epochs * per_epoch))


@dataclass
class Training:
    """A training under way: what each step and each validation needs."""

    plan: Plan
    network: Rival
    optimizer: torch.optim.Optimizer
    progress: Progress
    validation: Pairs
    output: Path
    command: str
    data = PairTask.data

    @property
    def held(self) -> str:
        """What is validated on."""
        return f"{len(self.validation)} shapes held out of the training split"

    def step(self, pairs: Pairs, rate: float, log: Log, done: int) -> None:
        """One step of Adam."""
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        loss = self.network.loss(pairs)
        self.optimizer.zero_grad()
        torch.autograd.backward(loss.total)
        if clip_grad_norm_(self.network.parameters(), 1.0).isfinite():
            self.optimizer.step()
        log.step(self.progress.step, loss, done)

    def validate(self, log: Log) -> None:
        """Measure, keep the best, and save what is needed to go on."""
        check_finite(self.network, self.progress.step - 1)
        began = time.monotonic()
        scores = validate(self.network, self.validation, VALIDATION_BATCH)
        self.progress.seconds += time.monotonic() - began
        log.validation(self.progress.step - 1, scores)
        options = asdict(self.plan)
        if scores.mae_r < self.progress.best:
            self.progress.best = scores.mae_r
            told = history(self.plan.experiment, options, self.progress, scores, self, self.command)
            save_weights(self.output / "best.safetensors", self.network, self.network.config, told)
        save_checkpoint(self.output / "last.ckpt", self.network, self.optimizer, self.progress, options)


def train(
    plan: Plan,
    budget: Budget,
    data: Path,
    output: Path,
    *,
    network: Rival | None = None,
    resume: bool = False,
    device: str = "auto",
    validate_every: int = 100,
    command: str = "",
) -> Path:
    """Train one rival and keep its best weights.

    Args:
        plan: what to train, on what.
        budget: how long.
        data: folder of ModelNet40.
        output: folder for ``best.safetensors``, ``last.ckpt`` and the TensorBoard log.
        network: with other sizes than the paper's; None for these.
        resume: go on from ``last.ckpt`` where there is one.
        device: ``auto``, ``cpu`` or ``cuda``.
        validate_every: steps between validations and checkpoints.
        command: the command line, for the provenance.

    Returns:
        Path of the best weights.

    Raises:
        InputError: the data, the output folder or the options cannot be used.
        MissingDependencyError: the ``train`` extra is not installed.
    """
    check_installed()
    check(plan.recipe)
    check_run(device, plan.precision, validate_every)
    output = make_folder(output)
    keep_freed_memory()
    torch.manual_seed(plan.seed)
    shapes, validation = split_validation(experiment_shapes(plan.experiment, data, "train"), plan.recipe)
    check_batch(plan.batch_size, len(shapes), 1)
    place = torch.device("cuda" if device != "cpu" and torch.cuda.is_available() else "cpu")
    network = (network or RIVALS[plan.method]()).to(place).train()
    set_precision(network, plan.precision)
    optimizer = torch.optim.Adam(network.parameters(), lr=network.learning_rate, weight_decay=network.weight_decay)
    progress = restore(output / "last.ckpt", network, optimizer, asdict(plan)) if resume else Progress()
    training = Training(plan, network, optimizer, progress, validation, output, command)
    started, per_epoch = time.monotonic() - progress.seconds, len(shapes) // plan.batch_size
    with Log(output, 100, 0, enabled=True) as log:
        while (share := budget.share(progress, per_epoch)) < 1:
            generator = generator_at(plan.recipe, progress.step)
            pairs = pairs_at(shapes, plan.recipe, progress.step, generator)
            pairs = (thinned(pairs, generator) if plan.thin and share < THIN else pairs).to(place)
            torch.manual_seed(generator.initial_seed())  # of what the network draws, so that resuming repeats it
            training.step(pairs, rate(network, share), log, int(100 * share))
            progress.step, progress.seconds = progress.step + 1, time.monotonic() - started
            if progress.step % validate_every == 0 or budget.share(progress, per_epoch) >= 1:
                training.validate(log)
    return output / "best.safetensors"


def rate(network: Rival, share: float) -> float:
    """The learning rate when that share of the budget is used."""
    rise = min(1.0, 0.1 + 0.9 * share / WARM_UP)
    return network.learning_rate * rise * 0.1 ** sum(share >= drop for drop in DROPS)


def thinned(pairs: Pairs, generator: torch.Generator) -> Pairs:
    """Pairs of a random third of each cloud's points."""

    def some(points: Tensor) -> Tensor:
        order = torch.rand(points.shape[:2], generator=generator).argsort(-1)
        return gather_points(points, order[:, : points.shape[1] // 3])

    return replace(pairs, source=some(pairs.source), target=some(pairs.target))


def set_precision(network: Rival, precision: str) -> None:
    """Let the transformers compute in bfloat16.

    Raises:
        InputError: the network has none, and its finite differences need all digits.
    """
    transformers = [module for module in network.modules() if isinstance(module, Features)]
    if precision == "bf16" and not transformers:
        raise InputError(f"{network.name} has no part to compute in bfloat16: leave --precision out")
    for module in transformers:
        module.autocast = precision == "bf16"


def main(words: list[str] | None = None) -> None:
    """Read the command line and train."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("method", choices=RIVALS)
    parser.add_argument("experiment", choices=TRAININGS)
    parser.add_argument("--data", type=Path, required=True, help="folder of ModelNet40")
    parser.add_argument("--output", type=Path, required=True, help="folder for the weights, checkpoint and log")
    budget = parser.add_mutually_exclusive_group(required=True)
    budget.add_argument("--minutes", type=positive, help="wall-clock time, over all resumptions")
    budget.add_argument("--epochs", type=positive, help="passes over the training shapes; may be a fraction")
    parser.add_argument("--batch-size", type=int, default=8)
    parser.add_argument("--precision", choices=("32", "bf16"), default="32", help="of the transformer")
    parser.add_argument("--thin", action="store_true", help="begin with a third of the points")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto")
    parser.add_argument("--validate-every", type=int, default=100, help="steps between validations and checkpoints")
    parser.add_argument("--resume", action="store_true", help="go on from the output folder's last.ckpt")
    arguments = parser.parse_args(words)
    plan = Plan(
        arguments.method,
        arguments.experiment,
        arguments.batch_size,
        arguments.precision,
        arguments.thin,
        arguments.seed,
    )
    try:
        best = train(
            plan,
            Budget(arguments.minutes, arguments.epochs),
            arguments.data,
            arguments.output,
            resume=arguments.resume,
            device=arguments.device,
            validate_every=arguments.validate_every,
            command=shlex.join(["python", "-m", "benchmarks.rivals.train", *(words or sys.argv[1:])]),
        )
    except (InputError, MissingDependencyError) as error:
        parser.error(str(error))
    print(best)


def positive(text: str) -> float:
    """A finite number above zero."""
    value = float(text)
    if not 0 < value < float("inf"):
        raise ValueError
    return value


if __name__ == "__main__":
    main()
