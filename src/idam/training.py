"""The training loop (sections 3.4, 3.5 and 4): pairs, balanced sampling, loss, Adam, checkpoints."""

from __future__ import annotations

import io
import json
import math
import os
import subprocess
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from pickle import UnpicklingError
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from idam.data.modelnet40 import Shapes, experiment_shapes
from idam.data.pairs import EXPERIMENTS, Pairs, experiment_noise, fixed_pairs, make_pairs
from idam.errors import InputError, MissingDependencyError
from idam.evaluation.metrics import Metrics, measure
from idam.geometry import apply_transform, gather_points
from idam.io.files import make_folder, one_line, write_bytes
from idam.memory import keep_freed_memory
from idam.network.config import Config
from idam.network.elimination import keep_most_significant, share_of
from idam.network.model import IDAM
from idam.network.pretrained import load_model, save_model
from idam.network.sampling import balanced_sample
from idam.network.supervision import Loss, mutual_supervision

__all__ = ["EXPERIMENTS", "Recipe", "train"]

VALIDATION_SHAPES = 200
VALIDATION_SEED = 7


@dataclass(frozen=True)
class Recipe:
    """How to train; the defaults are the paper's (section 4).

    Attributes:
        experiment: one of :data:`EXPERIMENTS`.
        config: the network.
        epochs: passes over the training shapes; may be a fraction.
        batch_size: pairs a step, over all processes.
        schedule: ``step`` divides the rate by 10 at three quarters of the epochs (30 of 40); ``one-cycle`` rises to it
            and falls to nothing.
        learning_rate: Adam's, at its highest.
        weight_decay: Adam's.
        radius: r of the loss and of balanced sampling.
        noise: sigma of the noise on both clouds; None for the experiment's own.
        keep: share of points that balanced sampling draws.
        iterations: iterations of a training step; the configuration's are those after training.
        eliminate: let hard elimination choose the target points, and half of the source points, as it does after
            training; balanced sampling chooses the other half.
        start: name or file of a model, or a ``last.ckpt``, whose weights to start from; None for random ones.
        seed: of the weights, pairs and samples.
    """

    experiment: str = "unseen-shapes"
    config: Config = field(default_factory=Config)
    epochs: float = 40
    batch_size: int = 16
    schedule: str = "step"
    learning_rate: float = 1e-4
    weight_decay: float = 1e-3
    radius: float = 0.05
    noise: float | None = None
    keep: float = 1 / 6
    iterations: int = 3
    eliminate: bool = False
    start: str | None = None
    seed: int = 0

    @property
    def sigma(self) -> float:
        """Sigma of the noise on both clouds."""
        return experiment_noise(self.experiment) if self.noise is None else self.noise

    def rate(self, progress: float) -> float:
        """The learning rate at a share of the training, in [0, 1)."""
        if self.schedule == "step":
            return self.learning_rate * (0.1 if progress >= 0.75 else 1.0)
        rise = 0.2
        if progress < rise:
            low = self.learning_rate / 25
            return low + (self.learning_rate - low) * 0.5 * (1 - math.cos(math.pi * progress / rise))
        return self.learning_rate * 0.5 * (1 + math.cos(math.pi * (progress - rise) / (1 - rise)))


class Batch(NamedTuple):
    """Pairs (:class:`idam.data.pairs.Pairs`) and the rows (B, M) of each cloud that balanced sampling drew."""

    source: Tensor
    target: Tensor
    rotation: Tensor
    translation: Tensor
    source_index: Tensor
    target_index: Tensor


class SupervisedStep(nn.Module):
    """The network and its loss as one module, so that distributed wrappers see one forward pass."""

    def __init__(self, model: IDAM, recipe: Recipe, precision: str) -> None:
        super().__init__()
        self.model = model
        self.recipe = recipe
        self.precision = precision

    def forward(self, batch: Batch) -> Loss:
        """The loss of the pairs on their sampled points."""
        # Fabric's own autocast would round the coordinates on the way in, and the labels need them exact as well
        with torch.autocast(batch.source.device.type, torch.bfloat16, enabled=self.precision == "bf16"):
            source_features, target_features = self.model.encode(batch.source, batch.target)
            source_significance = self.model.significance(source_features)
            target_significance = self.model.significance(target_features)
            source_index, target_index = batch.source_index, batch.target_index
            if self.recipe.eliminate:
                source_kept, target_index = (
                    keep_most_significant(significance.detach(), self.model.config.keep)
                    for significance in (source_significance, target_significance)
                )
                # drawn samples come positives first: every second one keeps the balance
                source_index = torch.cat([source_index[:, ::2], source_kept[:, : source_index.shape[1] // 2]], 1)
            source, target = gather_points(batch.source, source_index), gather_points(batch.target, target_index)
            iterations = self.model.iterate(
                source,
                target,
                gather_points(source_features, source_index),
                gather_points(target_features, target_index),
                self.recipe.iterations,
            )
        return mutual_supervision(
            iterations,
            source,
            target,
            batch.rotation,
            batch.translation,
            source_significance.gather(1, source_index),
            target_significance.gather(1, target_index),
            self.recipe.radius,
        )


@torch.inference_mode()
def validate(model: IDAM, pairs: Pairs, batch_size: int = 50) -> Metrics:
    """Errors of the network alone on pairs."""
    was_training, device = model.training, next(model.parameters()).device
    model.eval()
    estimates = []
    for start in range(0, len(pairs), batch_size):
        batch = pairs[start : start + batch_size].to(device)
        output = model(batch.source, batch.target)
        estimates.append((output.rotation.cpu(), output.translation.cpu()))
    model.train(was_training)
    rotation, translation = (torch.cat(parts) for parts in zip(*estimates, strict=True))
    return measure(rotation, translation, pairs.rotation, pairs.translation)


def split_validation(shapes: Shapes, seed: int, noise: float) -> tuple[Shapes, Pairs]:
    """Shapes to train on, and fixed pairs of the 200 others (a tenth, where there are few) that pick the checkpoint."""
    order = torch.randperm(len(shapes), generator=torch.Generator().manual_seed(seed))
    held = min(VALIDATION_SHAPES, max(1, len(shapes) // 10))
    train = Shapes(shapes.points[order[held:]], shapes.labels[order[held:]])
    return train, fixed_pairs(shapes.points[order[:held]], VALIDATION_SEED, noise)


def batch_at(shapes: Shapes, recipe: Recipe, step: int, rank: int, world: int) -> Batch:
    """The pairs and sampled points of one process at one step, a function of the seed and the step alone."""
    per_epoch = len(shapes) // recipe.batch_size
    epoch, position = divmod(step, per_epoch)
    order = torch.randperm(len(shapes), generator=torch.Generator().manual_seed(recipe.seed * 1009 + epoch))
    rows = order[position * recipe.batch_size : (position + 1) * recipe.batch_size][rank::world]
    generator = torch.Generator().manual_seed((recipe.seed * 1_000_003 + step) * 4099 + rank)
    pairs = make_pairs(shapes.points[rows], generator, recipe.sigma)
    aligned = apply_transform(pairs.source, pairs.rotation, pairs.translation)
    count = share_of(pairs.source.shape[1], recipe.keep)
    source_index, target_index = balanced_sample(aligned, pairs.target, count, recipe.radius, generator)
    return Batch(pairs.source, pairs.target, pairs.rotation, pairs.translation, source_index, target_index)


@dataclass
class Progress:
    """Where a training stands; saved in every checkpoint."""

    step: int = 0
    best: float = math.inf
    seconds: float = 0.0


def train(
    recipe: Recipe,
    data: str | Path,
    output: str | Path,
    *,
    resume: bool = False,
    device: str = "auto",
    precision: str = "32",
    validate_every: int = 250,
    command: str = "",
) -> Path:
    """Train one model and keep its best checkpoint.

    Args:
        recipe: what and how.
        data: folder of ModelNet40 (:func:`idam.data.modelnet40.load`).
        output: folder for ``best.safetensors``, ``last.ckpt`` and the TensorBoard log.
        resume: go on from ``last.ckpt`` where there is one.
        device: ``auto``, ``cpu`` or ``cuda``; under ``torchrun`` each process takes its own.
        precision: ``32``, or ``bf16`` for matrix products and activations in bfloat16.
        validate_every: steps between validations and checkpoints.
        command: the command line, for the provenance.

    Returns:
        Path of the best model.

    Raises:
        InputError: the data, the output folder or the recipe cannot be used.
        MissingDependencyError: the ``train`` extra is not installed.
    """
    try:
        from lightning_fabric import Fabric
        from torch.utils.tensorboard import SummaryWriter  # noqa: F401 - for the log
    except ImportError as error:
        raise MissingDependencyError(
            "training needs Lightning Fabric and TensorBoard: pip install 'idam[train]'"
        ) from error
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
    shapes, validation = split_validation(
        experiment_shapes(recipe.experiment, data, "train"), recipe.seed, recipe.sigma
    )
    check_batch(recipe.batch_size, len(shapes), fabric.world_size)
    total = max(1, round(recipe.epochs * (len(shapes) // recipe.batch_size)))
    module = SupervisedStep(initial_model(recipe), recipe, precision)
    optimizer = torch.optim.Adam(module.parameters(), lr=recipe.learning_rate, weight_decay=recipe.weight_decay)
    progress = restore(output / "last.ckpt", module, optimizer, recipe) if resume else Progress()
    step_module, step_optimizer = fabric.setup(module, optimizer)
    started = time.monotonic() - progress.seconds
    with Log(output, total, progress.step, enabled=fabric.is_global_zero) as log:
        for step in range(progress.step, total):
            for group in step_optimizer.param_groups:
                group["lr"] = recipe.rate(step / total)
            batch = batch_at(shapes, recipe, step, fabric.global_rank, fabric.world_size)
            loss: Loss = step_module(fabric.to_device(batch))
            fabric.backward(loss.total)
            step_optimizer.step()
            step_optimizer.zero_grad()
            log.step(step, loss)
            if (step + 1) % validate_every == 0 or step + 1 == total:
                check_finite(module, step)
                progress.step, progress.seconds = step + 1, time.monotonic() - started
                if fabric.is_global_zero:
                    scores = validate(module.model, validation)
                    log.validation(step, scores)
                    if scores.mae_r < progress.best:
                        progress.best = scores.mae_r
                        save_model(
                            output / "best.safetensors",
                            module.model,
                            history(recipe, progress, scores, len(validation), command),
                        )
                    save_checkpoint(output / "last.ckpt", module, optimizer, progress, recipe)
                fabric.barrier()
    return output / "best.safetensors"


def check(recipe: Recipe) -> None:
    """Raise InputError where a recipe makes no sense."""
    if recipe.experiment not in EXPERIMENTS:
        raise InputError(f"unknown experiment {recipe.experiment!r}: choose {', '.join(EXPERIMENTS)}")
    if recipe.schedule not in ("step", "one-cycle"):
        raise InputError(f"unknown schedule {recipe.schedule!r}: choose step or one-cycle")
    positive = (recipe.epochs, recipe.learning_rate, recipe.radius)
    if not all(0 < value < math.inf for value in positive) or recipe.batch_size < 2:
        raise InputError("epochs, the learning rate and the radius must be positive, and the batch at least 2 pairs")
    if not 0 <= recipe.sigma < math.inf:
        raise InputError(f"cannot add noise of sigma {recipe.sigma:g}: choose 0 or more, in the shapes' units")
    if not 0 < recipe.keep <= 1:
        raise InputError(f"cannot sample a share of {recipe.keep:g} of the points: choose one in (0, 1]")
    if abs(recipe.seed) >= 2**31:
        raise InputError(f"the seed {recipe.seed} is too large: choose one of 32 bits")


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
            f"{shapes} shapes to train on do not fill a batch of {batch_size}: choose a smaller --batch-size"
        )
    if batch_size < processes:
        raise InputError(f"{processes} processes cannot share a batch of {batch_size}: choose a larger --batch-size")


def check_finite(module: SupervisedStep, step: int) -> None:
    """Raise InputError where the training has diverged: weights that are no numbers answer identity, which scores."""
    if not all(parameter.isfinite().all() for parameter in module.parameters()):
        raise InputError(f"the training has diverged by step {step + 1}: choose a smaller --learning-rate")


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


def history(recipe: Recipe, progress: Progress, scores: Metrics, pairs: int, command: str) -> dict[str, Any]:
    """The provenance of a model: what it was trained on, how far, and how it did on the validation pairs."""
    return {
        "experiment": recipe.experiment,
        "data": "ModelNet40, 1024 points a shape, training split less the validation shapes",
        "recipe": {key: value for key, value in asdict(recipe).items() if key != "config"},
        "steps": progress.step,
        "training_seconds": round(progress.seconds),
        "validation": {key: round(value, 5) for key, value in scores.to_dict().items()},
        "validation_pairs": f"{pairs} shapes held out of the training split",
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
    path: Path, module: SupervisedStep, optimizer: torch.optim.Optimizer, progress: Progress, recipe: Recipe
) -> None:
    """Write everything needed to go on, atomically."""
    state = {
        "model": module.model.state_dict(),
        "optimizer": optimizer.state_dict(),
        "progress": asdict(progress),
        "recipe": json.dumps(asdict(recipe)),
    }
    buffer = io.BytesIO()
    torch.save(state, buffer)
    write_bytes(path, buffer.getvalue())


def restore(path: Path, module: SupervisedStep, optimizer: torch.optim.Optimizer, recipe: Recipe) -> Progress:
    """Load a checkpoint, if there is one; raise InputError where it is another recipe's."""
    if not path.is_file():
        return Progress()
    state = read_checkpoint(path)
    if json.loads(state["recipe"]) != json.loads(json.dumps(asdict(recipe))):
        raise InputError(f"{path}: was trained with other options; give the same ones, or another --output")
    module.model.load_state_dict(state["model"])
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


class Log:
    """A progress bar with the parts of the loss, and the same figures in TensorBoard."""

    def __init__(self, folder: Path, total: int, done: int, *, enabled: bool) -> None:
        from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
        from rich.progress import Progress as Bar
        from torch.utils.tensorboard import SummaryWriter

        self.enabled = enabled
        self.bar = Bar(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
            disable=not enabled,
        )
        self.task = self.bar.add_task("starting", total=total, completed=done)
        self.writer = SummaryWriter(str(folder)) if enabled else None

    def __enter__(self) -> Log:
        self.bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.bar.stop()
        if self.writer is not None:
            self.writer.close()

    def step(self, step: int, loss: Loss) -> None:
        """Show the parts of one step's loss."""
        if self.writer is None:
            return
        figures = {
            "matching": loss.matching.item(),
            "entropy": loss.entropy.item(),
            "elimination": loss.elimination.item(),
            "accuracy": loss.accuracy.item(),
        }
        text = " ".join(f"{name} {value:.3f}" for name, value in figures.items())
        self.bar.update(self.task, completed=step + 1, description=text)
        if step % 10 == 0:
            for name, value in figures.items():
                self.writer.add_scalar(f"train/{name}", value, step)

    def validation(self, step: int, scores: Metrics) -> None:
        """Show the errors on the validation pairs."""
        self.bar.console.print(
            f"step {step + 1}: " + " ".join(f"{k} {v:.4f}" for k, v in scores.to_dict().items()), soft_wrap=True
        )
        if self.writer is not None:
            for name, value in scores.to_dict().items():
                self.writer.add_scalar(f"validation/{name}", value, step)
