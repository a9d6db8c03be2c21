"""The training loop (section 4): pairs, balanced sampling, loss, Adam, checkpoints."""

from __future__ import annotations

import os
import time
from dataclasses import asdict
from pathlib import Path

import torch
from torch import nn

from idam.errors import InputError, MissingDependencyError
from idam.io import make_folder
from idam.lab.training.checkpoint import Progress, history, restore, save_checkpoint
from idam.lab.training.fuse import fuse_convolutions
from idam.lab.training.general import GeneralTask, learns_features_alone
from idam.lab.training.log import Log, Parts
from idam.lab.training.memory import keep_freed_memory
from idam.lab.training.recipe import Recipe, check
from idam.lab.training.task import PairTask, Task
from idam.lab.training.underflow import flush_to_zero
from idam.network.pretrained import save_model

__all__ = ["train"]


def train(
    recipe: Recipe,
    data: str | Path,
    output: str | Path,
    *,
    resume: bool = False,
    device: str = "auto",
    precision: str = "32",
    fuse: bool = False,
    validate_every: int = 250,
    command: str = "",
) -> Path:
    """Train one model and keep its best checkpoint.

    Args:
        recipe: what and how.
        data: folder of ModelNet40 (:func:`idam.lab.data.modelnet40.load`).
        output: folder for ``best.safetensors``, ``last.ckpt`` and the TensorBoard log.
        resume: go on from ``last.ckpt`` where there is one.
        device: ``auto``, ``cpu`` or ``cuda``; under ``torchrun`` each process takes its own.
        precision: ``32``, or ``bf16`` for matrix products and activations in bfloat16.
        fuse: let ``torch.compile`` fuse the similarity convolutions.
        validate_every: steps between validations and checkpoints.
        command: the command line, for the provenance.

    Returns:
        Path of the best model.

    Raises:
        InputError: the data, the output folder or the recipe cannot be used.
        MissingDependencyError: the ``train`` extra is not installed.
    """
    check_installed()
    from lightning_fabric import Fabric

    check(recipe)
    check_run(device, precision, validate_every)
    output = make_folder(output)
    keep_freed_memory()
    fabric = Fabric(
        accelerator=device,
        devices=int(os.environ.get("LOCAL_WORLD_SIZE", 1)),
        num_nodes=int(os.environ.get("GROUP_WORLD_SIZE", 1)),
    )
    fabric.launch()
    torch.manual_seed(recipe.seed)
    task: Task = (GeneralTask if learns_features_alone(recipe) else PairTask)(recipe, data, precision)
    check_batch(recipe.batch_size, task.size, fabric.world_size)
    total = max(1, round(recipe.epochs * (task.size // recipe.batch_size)))
    module = task.module
    if fuse:
        fuse_convolutions(module.model)
    optimizer = torch.optim.Adam(module.parameters(), lr=recipe.learning_rate, weight_decay=recipe.weight_decay)
    flush_to_zero(optimizer)
    progress = restore(output / "last.ckpt", module.model, optimizer, asdict(recipe)) if resume else Progress()
    options = {name: value for name, value in asdict(recipe).items() if name != "config"}
    step_module, step_optimizer = fabric.setup(module, optimizer)
    started = time.monotonic() - progress.seconds
    with Log(output, total, progress.step, enabled=fabric.is_global_zero) as log:
        for step in range(progress.step, total):
            for group in step_optimizer.param_groups:
                group["lr"] = recipe.rate(step / total)
            batch = task.batch(step, fabric.global_rank, fabric.world_size)
            loss: Parts = step_module(fabric.to_device(batch))
            fabric.backward(loss.total)
            step_optimizer.step()
            step_optimizer.zero_grad()
            log.step(step, loss)
            if (step + 1) % validate_every == 0 or step + 1 == total:
                check_finite(module, step)
                progress.step, progress.seconds = step + 1, time.monotonic() - started
                if fabric.is_global_zero:
                    error, scores = task.validate()
                    log.validation(step, scores)
                    if error < progress.best:
                        progress.best = error
                        save_model(
                            output / "best.safetensors",
                            module.model,
                            history(recipe.experiment, options, progress, scores, task, command),
                        )
                    save_checkpoint(output / "last.ckpt", module.model, optimizer, progress, asdict(recipe))
                fabric.barrier()
    return output / "best.safetensors"


def check_installed() -> None:
    """Raise MissingDependencyError where the ``train`` extra is not installed."""
    try:
        import lightning_fabric  # noqa: F401
        from torch.utils.tensorboard import SummaryWriter  # noqa: F401 - for the log
    except ImportError as error:
        raise MissingDependencyError(
            "training needs Lightning Fabric and TensorBoard: pip install 'idam[train]'"
        ) from error


def check_run(device: str, precision: str, validate_every: int) -> None:
    """Raise InputError where a recipe cannot be run this way here."""
    if device not in ("auto", "cpu", "cuda"):
        raise InputError(f"unknown device {device!r}: choose auto, cpu or cuda")
    if device == "cuda" and not torch.cuda.is_available():
        raise InputError("there is no CUDA device here: choose another --device")
    if precision not in ("32", "bf16"):
        raise InputError(f"unknown precision {precision!r}: choose 32 or bf16")
    if validate_every < 1:
        raise InputError(f"cannot validate every {validate_every} steps: choose 1 or more")


def check_batch(batch_size: int, shapes: int, processes: int) -> None:
    """Raise InputError where there are too few shapes for a batch, or too few pairs in one for all processes."""
    if batch_size > shapes:
        raise InputError(
            f"{shapes} shapes or pairs to train on do not fill a batch of {batch_size}: choose a smaller --batch-size"
        )
    if batch_size < processes:
        raise InputError(f"{processes} processes cannot share a batch of {batch_size}: choose a larger --batch-size")


def check_finite(module: nn.Module, step: int) -> None:
    """Raise InputError where the training has diverged: weights that are no numbers answer identity, which scores."""
    if not all(parameter.isfinite().all() for parameter in module.parameters()):
        raise InputError(f"the training has diverged by step {step + 1}: choose a smaller --learning-rate")
