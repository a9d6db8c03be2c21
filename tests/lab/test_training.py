"""Training: the paper's recipe, batches and ranks, learning, checkpoints and resuming, and what is refused."""

import dataclasses
import itertools
import json
import math
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from torch import Tensor

from idam.errors import InputError, MissingDependencyError
from idam.lab.data import pairs as protocol
from idam.lab.data.modelnet40 import Shapes
from idam.lab.data.pairs import Pairs
from idam.lab.evaluation.metrics import Metrics, measure
from idam.lab.training import TRAININGS, Recipe, loop, task, train
from idam.lab.training import checkpoint as saving
from idam.lab.training.batches import Batch, batch_at, split_validation
from idam.lab.training.checkpoint import initial_model
from idam.lab.training.pool import Pool
from idam.lab.training.step import SupervisedStep
from idam.lab.training.task import validate
from idam.network.config import Config
from idam.network.geometry import apply_transform, euler_xyz_to_rotation, rotation_angle
from idam.network.model import IDAM
from idam.network.pretrained import load_model, save_model
from idam.network.supervision import Loss
from idam.weights import provenance
from watching import watched_log

SMALL = Recipe(
    config=Config(neighbours=6, channels=8),
    epochs=1,
    batch_size=4,
    schedule="one-cycle",
    learning_rate=3e-3,
    keep=1 / 3,
)
SHIPPED = "gnn-unseen-shapes"
STEPS = 9
"""Of SMALL: 36 of the 40 shapes are trained on, 4 a step."""


def changed(**options: Any) -> Recipe:
    return dataclasses.replace(SMALL, **options)


@pytest.fixture(scope="module")
def shapes() -> Shapes:
    """Bent sheets of 128 points in the unit sphere, each with a label of its own."""
    generator = torch.Generator().manual_seed(0)
    u, v = (torch.rand(40, 128, 2, generator=generator) * 2 - 1).unbind(-1)
    bend = torch.randn(3, 40, 1, generator=generator)
    points = torch.stack([u, 0.7 * v, bend[0] * u**2 + bend[1] * u * v**2 + bend[2] * torch.sin(2 * v)], -1)
    points -= points.mean(1, keepdim=True)
    return Shapes(points / points.norm(dim=-1).amax(1)[:, None, None], torch.arange(40))


@pytest.fixture
def fit(monkeypatch: pytest.MonkeyPatch, shapes: Shapes) -> Callable[..., list[Loss]]:
    """Trains on the small shapes, stopped by Ctrl-C after a step if asked to, and returns the loss of every step."""
    pytest.importorskip("lightning_fabric", reason="training needs Lightning Fabric")
    pytest.importorskip("tensorboard", reason="training needs TensorBoard")
    monkeypatch.setattr(task, "experiment_shapes", lambda *_: shapes)
    monkeypatch.setattr(loop, "keep_freed_memory", lambda: True)  # it would hold for all tests after this one
    monkeypatch.setattr(protocol, "CROPPED_POINTS", 96)

    def run(recipe: Recipe, output: Path, *, stop_after: int | None = None, **options: Any) -> list[Loss]:
        losses: list[Loss] = []
        with monkeypatch.context() as patch:
            patch.setattr(loop, "Log", watched_log(losses, stop_after))
            best = train(recipe, "not read", output, **({"device": "cpu"} | options))
        assert best == output / "best.safetensors"
        return losses

    return run


def checkpoint(folder: Path) -> dict[str, Any]:
    return torch.load(folder / "last.ckpt", weights_only=True)


def same(one: dict[str, Tensor], other: dict[str, Tensor]) -> bool:
    """Whether two sets of weights are equal to the bit."""
    assert one.keys() == other.keys()
    return all(torch.equal(value, other[name]) for name, value in one.items())


def names(folder: Path) -> set[str]:
    """The files of a folder, the logs' host and time left out."""
    return {"events" if path.name.startswith("events.") else path.name for path in folder.iterdir()}


# the recipe


def test_the_defaults_are_the_paper_s_recipe():
    recipe = Recipe()
    assert (recipe.epochs, recipe.batch_size, recipe.schedule) == (40, 16, "step")
    assert (recipe.learning_rate, recipe.weight_decay) == (1e-4, 1e-3)
    assert (recipe.radius, recipe.keep) == (0.05, 1 / 6)
    assert not recipe.eliminate
    assert recipe.start is None
    config = recipe.config
    assert (config.features, config.neighbours, config.channels) == ("gnn", 12, 32)
    assert (config.blocks, config.iterations, config.keep, config.keep_matches) == (3, 3, 1 / 6, 0.5)
    assert not config.soft_matches


def test_the_paper_s_rate_drops_to_a_tenth_after_30_of_40_epochs():
    recipe, per_epoch = Recipe(), 600
    rates = [recipe.rate(step / (40 * per_epoch)) for step in range(40 * per_epoch)]
    assert rates[: 30 * per_epoch] == pytest.approx([1e-4] * 30 * per_epoch)
    assert rates[30 * per_epoch :] == pytest.approx([1e-5] * 10 * per_epoch)


def test_the_one_cycle_rate_rises_to_its_peak_and_falls_to_nothing():
    recipe = Recipe(schedule="one-cycle", learning_rate=0.1)
    rates = np.array([recipe.rate(step / 5000) for step in range(5000)])
    top = rates.argmax()
    assert rates[top] == pytest.approx(0.1, rel=1e-5)
    assert 0 < top < 2500
    assert (np.diff(rates[: top + 1]) >= 0).all()
    assert (np.diff(rates[top:]) <= 0).all()
    assert np.abs(np.diff(rates)).max() < 0.1 / 500
    assert 0 < rates[0] < 0.01
    assert 0 < rates[-1] < 1e-5


@pytest.mark.parametrize("schedule", ["step", "one-cycle"])
def test_adam_takes_the_rate_of_the_schedule_and_the_weight_decay(schedule, fit, tmp_path):
    recipe = changed(schedule=schedule, weight_decay=0.02)
    fit(recipe, tmp_path)
    (group,) = checkpoint(tmp_path)["optimizer"]["param_groups"]
    assert group["lr"] == recipe.rate((STEPS - 1) / STEPS)
    assert group["weight_decay"] == 0.02
    assert group["betas"] == (0.9, 0.999)


# shapes and batches


def held_out(train_shapes: Shapes) -> set[int]:
    return set(range(40)) - set(train_shapes.labels.tolist())


def owner(points: Tensor, shapes: Shapes) -> list[int]:
    """Labels of the shapes that some of the points (N, 3) are exactly a point of."""
    among = (shapes.points[:, :, None] == points[None, None, :5]).all(-1).any(2).any(1)
    return shapes.labels[among].tolist()


def test_validation_pairs_are_of_shapes_that_are_not_trained_on(shapes):
    train_shapes, pairs = split_validation(shapes, SMALL)
    assert len(train_shapes) == 36
    assert len(pairs) == 4
    assert sorted(owner(source, shapes)[0] for source in pairs.source) == sorted(held_out(train_shapes))
    for points, label in zip(train_shapes.points, train_shapes.labels, strict=True):
        assert torch.equal(points, shapes.points[label])


def test_200_shapes_validate_where_there_are_many():
    many = Shapes(torch.rand(2500, 4, 3), torch.arange(2500))
    train_shapes, pairs = split_validation(many, SMALL)
    assert (len(train_shapes), len(pairs)) == (2300, 200)


def test_the_split_depends_on_the_seed_alone(shapes):
    first, pairs = split_validation(shapes, changed(seed=3))
    torch.rand(1)
    again, same_pairs = split_validation(shapes, changed(seed=3))
    assert torch.equal(first.labels, again.labels)
    assert torch.equal(pairs.source, same_pairs.source)
    assert torch.equal(pairs.rotation, same_pairs.rotation)
    assert held_out(split_validation(shapes, changed(seed=4))[0]) != held_out(first)


@pytest.mark.parametrize("features", ["gnn", "fpfh", "invariant"])
def test_practice_pairs_are_turned_as_far_as_the_features_can_take(features, shapes):
    recipe = changed(experiment="practice-any-rotation", config=Config(features=features))
    train_shapes, validation = split_validation(shapes, recipe)
    batches = [batch_at(train_shapes, recipe, step, 0, 1) for step in range(12)]
    angles = rotation_angle(torch.cat([validation.rotation, *(batch.rotation for batch in batches)]))
    assert (angles.max() > 90) == (features != "gnn")
    assert torch.equal(batches[3].source, batch_at(train_shapes, recipe, 3, 0, 1).source)
    assert not torch.equal(batches[3].source, batches[4].source)


def test_noise_of_one_s_own_takes_the_place_of_the_experiment_s(shapes):
    for experiment, noise, exact in (("gaussian-noise", 0.0, True), ("unseen-shapes", 0.01, False)):
        _, pairs = split_validation(shapes, changed(experiment=experiment, noise=noise))
        assert all((owner(source, shapes) != []) == exact for source in pairs.source)


def test_validation_pairs_have_the_experiment_s_noise(shapes):
    _, pairs = split_validation(shapes, changed(experiment="gaussian-noise"))
    assert all(owner(source, shapes) == [] for source in pairs.source)


def drawn(shapes: Shapes, recipe: Recipe, step: int, rank: int = 0, world: int = 1) -> list[int]:
    """Labels of the shapes in a batch."""
    batch = batch_at(shapes, recipe, step, rank, world)
    return list(itertools.chain(*(owner(source, shapes) for source in batch.source)))


def test_a_batch_depends_on_the_seed_and_the_step_alone(shapes):
    one = batch_at(shapes, SMALL, 5, 0, 1)
    torch.rand(7)
    batch_at(shapes, SMALL, 2, 0, 1)
    again = batch_at(shapes, changed(epochs=7, learning_rate=1.0, schedule="step"), 5, 0, 1)
    assert all(torch.equal(a, b) for a, b in zip(one[:6], again[:6], strict=True))
    assert one.features is again.features is None
    for other in (batch_at(shapes, SMALL, 6, 0, 1), batch_at(shapes, changed(seed=1), 5, 0, 1)):
        assert not any(torch.equal(a, b) for a, b in zip(one[:6], other[:6], strict=True))


def test_no_two_batches_use_the_same_transforms(shapes):
    batches = [
        batch_at(shapes, changed(seed=seed), step, rank, 2) for seed in (0, 1) for step in range(12) for rank in (0, 1)
    ]
    translations = torch.cat([batch.translation for batch in batches])
    assert len(translations.unique(dim=0)) == 2 * 12 * 4


def test_every_epoch_visits_each_shape_once_but_for_the_remainder(shapes):
    recipe = changed(batch_size=6)
    epochs = [[drawn(shapes, recipe, step) for step in range(6 * n, 6 * n + 6)] for n in range(3)]
    for epoch in epochs:
        assert [len(batch) for batch in epoch] == [6] * 6
        assert len(set(itertools.chain(*epoch))) == 36
    assert epochs[0] != epochs[1]
    assert len(set(itertools.chain(*itertools.chain(*epochs)))) == 40  # the remainder is another one each time


@pytest.mark.parametrize(("world", "sizes"), [(2, [3, 3]), (4, [2, 2, 1, 1]), (6, [1] * 6)])
def test_processes_share_a_batch(world, sizes, shapes):
    recipe = changed(batch_size=6)
    for step in (0, 5, 6):
        parts = [drawn(shapes, recipe, step, rank, world) for rank in range(world)]
        assert [len(part) for part in parts] == sizes
        assert sorted(itertools.chain(*parts)) == sorted(drawn(shapes, recipe, step))


@pytest.mark.parametrize("keep", [1 / 6, 1 / 3, 0.3])
def test_a_batch_samples_that_share_of_points_and_their_nearest_targets(keep, shapes):
    batch = batch_at(shapes, changed(keep=keep), 0, 0, 1)
    count = math.ceil(keep * 128)
    assert batch.source_index.shape == batch.target_index.shape == (4, count)
    aligned = apply_transform(batch.source, batch.rotation, batch.translation)
    distance = torch.cdist(aligned.double(), batch.target.double())
    chosen = distance.gather(1, batch.source_index[..., None].expand(-1, -1, 128))
    assert torch.equal(chosen.argmin(-1), batch.target_index)


def test_batches_have_the_experiment_s_noise(shapes):
    assert drawn(shapes, changed(experiment="gaussian-noise"), 0) == []
    assert len(drawn(shapes, changed(experiment="unseen-categories"), 0)) == 4


# the step


@pytest.fixture
def batch(shapes, monkeypatch) -> Batch:
    monkeypatch.setattr(protocol, "CROPPED_POINTS", 96)
    return batch_at(shapes, SMALL, 0, 0, 1)


@pytest.fixture
def matched(monkeypatch) -> Callable[[SupervisedStep, Batch], tuple[Tensor, Tensor]]:
    """Takes a step and returns the source and target points that went into matching."""

    def step(module: SupervisedStep, batch: Batch) -> tuple[Tensor, Tensor]:
        seen, iterate = [], module.model.iterate
        monkeypatch.setattr(module.model, "iterate", lambda *args: (seen.extend(args[:2]), iterate(*args))[1])
        module(batch)
        return seen[0], seen[1]

    return step


def rows(points: Tensor, cloud: Tensor) -> list[int]:
    """Which rows of a cloud the points are."""
    return [(cloud == point).all(-1).nonzero().item() for point in points]


def test_balanced_sampling_chooses_what_is_matched(batch, matched):
    found = matched(SupervisedStep(IDAM(SMALL.config), SMALL, "32"), batch)
    for points, cloud, index in zip(found, batch[:2], batch[4:6], strict=True):
        for b in range(4):
            assert rows(points[b], cloud[b]) == index[b].tolist()


def test_with_eliminate_hard_elimination_chooses_the_targets_and_half_of_the_sources(batch, matched):
    model = IDAM(SMALL.config)
    source, target = matched(SupervisedStep(model, changed(eliminate=True), "32"), batch)
    features = model.encode(batch.source, batch.target)
    kept_source, kept_target = (model.eliminate(*both).index for both in zip(batch[:2], features, strict=True))
    for b in range(4):
        assert set(rows(target[b], batch.target[b])) == set(kept_target[b].tolist())
        sampled, kept = set(batch.source_index[b].tolist()), set(kept_source[b].tolist())
        origin = rows(source[b], batch.source[b])
        assert len(origin) == 32
        assert len(sampled & set(origin)) >= 16
        assert len(kept & set(origin)) >= 16
        assert set(origin) <= sampled | kept
        # balanced samples come with the 16 that have a match first: half of either kind stay
        for kind in batch.source_index[b].split(16):
            assert sum(row in origin for row in kind.tolist()) >= 8


def test_a_pool_s_batches_come_with_the_features_that_the_network_gives_them(shapes, monkeypatch):
    monkeypatch.setattr(protocol, "CROPPED_POINTS", 96)
    recipe, model = changed(pool=12), IDAM(SMALL.config)
    pool = Pool(shapes, recipe, model)
    batches = [pool.batch(step, 0, 1) for step in range(6)]
    sources = {tuple(cloud[0].tolist()) for batch in batches[:3] for cloud in batch.source}
    assert len(sources) == 12
    assert {tuple(cloud[0].tolist()) for batch in batches[3:] for cloud in batch.source} == sources
    assert not torch.equal(batches[0].source_index, pool.batch(3, 0, 1).source_index)
    expected = model.eval().encode(batches[4].source, batches[4].target)
    torch.testing.assert_close(batches[4].features, expected)
    halves = [pool.batch(4, rank, 2) for rank in (0, 1)]
    assert sorted(cloud[0].tolist() for half in halves for cloud in half.source) == sorted(
        cloud[0].tolist() for cloud in batches[4].source
    )


# training


def test_a_pool_trains_all_but_the_features(fit, tmp_path):
    recipe = changed(pool=12, epochs=2)
    with pytest.raises(KeyboardInterrupt):
        fit(recipe, tmp_path, validate_every=2, stop_after=4)
    assert len(fit(recipe, tmp_path, resume=True)) == 2
    torch.manual_seed(recipe.seed)
    trained, started = checkpoint(tmp_path)["model"], initial_model(recipe).state_dict()
    kept = {name for name in trained if torch.equal(trained[name], started[name])}
    assert kept == {name for name in trained if name.startswith("features.")}


def test_the_loss_falls_and_more_points_are_matched_right(fit, tmp_path):
    losses = fit(changed(epochs=10), tmp_path)
    assert len(losses) == 90
    first, last = (
        Loss(*(torch.stack(part).mean() for part in zip(*ends, strict=True))) for ends in (losses[:10], losses[-10:])
    )
    assert last.total < 0.7 * first.total
    assert last.matching < first.matching - 0.2
    assert last.entropy < 0.5 * first.entropy
    assert last.elimination < first.elimination - 0.05
    assert last.accuracy > 2 * first.accuracy
    assert last.matching < math.log(32)  # what not looking at the points gives


def test_a_training_leaves_its_best_model_a_checkpoint_and_a_log(fit, tmp_path):
    fit(SMALL, tmp_path / "new" / "folder")
    assert names(tmp_path / "new" / "folder") == {"best.safetensors", "last.ckpt", "events"}


def test_the_best_model_tells_how_it_came_about(fit, tmp_path, shapes):
    recipe = changed(experiment="gaussian-noise", seed=5)
    fit(recipe, tmp_path, command="idam train gaussian-noise --seed 5")
    model, told = load_model(tmp_path / "best.safetensors"), provenance(tmp_path / "best.safetensors")
    assert model.config == recipe.config
    assert told["experiment"] == "gaussian-noise"
    assert told["recipe"] == {k: v for k, v in dataclasses.asdict(recipe).items() if k != "config"}
    assert told["steps"] == STEPS
    assert told["command"] == "idam train gaussian-noise --seed 5"
    assert told["torch"] == torch.__version__
    assert told["training_seconds"] >= 0
    assert told["validation_pairs"].startswith("4 ")
    _, pairs = split_validation(shapes, recipe)
    assert told["validation"] == pytest.approx(validate(model, pairs).to_dict(), abs=1e-5)


def test_the_provenance_has_the_commit_of_idam_s_checkout(fit, tmp_path):
    fit(SMALL, tmp_path)
    commit = provenance(tmp_path / "best.safetensors")["commit"]
    root = Path(saving.__file__).parents[4]
    if not (root / ".git").exists():
        assert commit == ""
    else:
        git = ["git", "-C", str(root), "rev-parse", "HEAD"]
        assert subprocess.run(git, capture_output=True, text=True, check=True).stdout.startswith(commit)
        assert len(commit) >= 7


def test_installed_below_another_checkout_idam_does_not_take_its_commit(tmp_path, monkeypatch):
    git = ["git", "-C", str(tmp_path), "-c", "user.name=x", "-c", "user.email=x"]
    try:
        subprocess.run([*git, "init", "-q"], check=True)
    except OSError:
        pytest.skip("no git here")
    subprocess.run([*git, "commit", "-q", "--allow-empty", "-m", "another project"], check=True)
    package = tmp_path / "site-packages" / "idam"
    package.mkdir(parents=True)
    (package / "checkpoint.py").touch()
    monkeypatch.setattr(saving, "__file__", str(package / "checkpoint.py"))
    assert saving.commit() == ""


def test_the_log_has_the_parts_of_the_loss_and_the_validation(fit, tmp_path):
    losses = fit(changed(epochs=2), tmp_path, validate_every=6)
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator").EventAccumulator
    log = accumulator(str(tmp_path)).Reload()
    for part in Loss._fields:
        events = log.Scalars(f"train/{part}")
        assert [event.step for event in events] == [0, 10]
        assert [event.value for event in events] == pytest.approx([float(getattr(losses[i], part)) for i in (0, 10)])
    for score in dataclasses.asdict(Metrics(0, 0, 0, 0, 0, 0, 0)):
        assert [event.step for event in log.Scalars(f"validation/{score}")] == [5, 11, 17]


def test_the_same_seed_gives_the_same_bits_and_another_seed_others(fit, tmp_path):
    for name, seed in (("one", 3), ("again", 3), ("other", 4)):
        torch.rand(seed)  # what was drawn before has no say
        fit(changed(seed=seed), tmp_path / name)
    one, again, other = (load_file(tmp_path / name / "best.safetensors") for name in ("one", "again", "other"))
    assert same(one, again)
    assert not any(torch.equal(one[name], other[name]) for name in one if name.endswith("linear.weight"))


def test_the_checkpoint_with_the_least_rotation_error_is_kept(fit, tmp_path, monkeypatch):
    errors, seen = iter([5.0, 3.0, 4.0]), []

    def scripted(model: IDAM, pairs: Pairs) -> Metrics:
        seen.append((pairs, {name: value.clone() for name, value in model.state_dict().items()}))
        return Metrics(9, next(errors), 9, 9, 0, 9, 9)

    monkeypatch.setattr(task, "validate", scripted)
    fit(SMALL, tmp_path, validate_every=3)
    best = tmp_path / "best.safetensors"
    assert provenance(best)["steps"] == 6
    assert provenance(best)["validation"]["mae_r"] == 3
    assert same(load_file(best), seen[1][1])
    assert same(checkpoint(tmp_path)["model"], seen[2][1])
    assert all(torch.equal(pairs.source, seen[0][0].source) for pairs, _ in seen)


def test_bfloat16_trains_to_finite_weights_in_single_precision(fit, tmp_path):
    exact = fit(SMALL, tmp_path / "32")
    rounded = fit(SMALL, tmp_path / "bf16", precision="bf16")
    assert all(part.isfinite() for loss in rounded for part in loss)
    assert rounded[0].matching != exact[0].matching
    assert rounded[0].total == pytest.approx(float(exact[0].total), rel=0.05)
    weights = load_file(tmp_path / "bf16" / "best.safetensors")
    floating = [value for value in weights.values() if value.is_floating_point()]
    assert {value.dtype for value in floating} == {torch.float32}
    assert all(value.isfinite().all() for value in floating)


class KnowsFromOnePoint(torch.nn.Module):
    """Answers from a pair's first points, number by number: no batch shape and no processor rounds it otherwise."""

    def __init__(self) -> None:
        super().__init__()
        self.scale = torch.nn.Parameter(torch.tensor(0.5))
        self.sizes: list[int] = []

    def forward(self, source: Tensor, target: Tensor) -> SimpleNamespace:
        assert not self.training
        self.sizes.append(len(source))
        return SimpleNamespace(
            rotation=euler_xyz_to_rotation(source[:, 0] * self.scale), translation=target[:, 0] * self.scale
        )


def test_validation_is_the_network_on_each_pair_alone(shapes):
    model = KnowsFromOnePoint().train()
    _, pairs = split_validation(shapes, SMALL)
    scores = validate(model, pairs, batch_size=3)
    assert model.training
    assert model.sizes == [3, 1]
    rotation = euler_xyz_to_rotation(pairs.source[:, 0] * 0.5)
    alone = measure(rotation, pairs.target[:, 0] * 0.5, pairs.rotation, pairs.translation)
    assert scores.to_dict() == pytest.approx(alone.to_dict(), rel=1e-5)


# starting from a model


@pytest.fixture
def started(tmp_path, seasoned) -> Path:
    """A model to start from."""
    path = tmp_path / "start.safetensors"
    save_model(path, seasoned(IDAM(SMALL.config), torch.float32), {})
    return path


def test_a_checkpoint_is_a_start_as_well(fit, tmp_path):
    fit(changed(epochs=2 / STEPS), tmp_path / "first")
    last = load_file(tmp_path / "first" / "best.safetensors")
    recipe = changed(start=str(tmp_path / "first" / "last.ckpt"))
    model = initial_model(recipe)
    assert all(torch.equal(value, last[name]) for name, value in model.state_dict().items())
    with pytest.raises(InputError, match="not a checkpoint"):
        (tmp_path / "other.ckpt").write_bytes(b"nonsense")
        initial_model(changed(start=str(tmp_path / "other.ckpt")))


def test_a_start_is_where_the_weights_come_from(fit, started, shapes, tmp_path):
    recipe = changed(start=str(started), epochs=2 / STEPS)
    losses = fit(recipe, tmp_path / "run")
    train_shapes, _ = split_validation(shapes, SMALL)
    expected = SupervisedStep(load_model(started).train(), recipe, "32")(batch_at(train_shapes, recipe, 0, 0, 1))
    assert losses[0].total == expected.total
    assert fit(changed(epochs=2 / STEPS), tmp_path / "random")[0].total != expected.total
    before, after = load_file(started), checkpoint(tmp_path / "run")["model"]
    moved = [name for name, value in before.items() if not torch.equal(value, after[name])]
    assert {name for name in before if name.endswith("linear.weight")} <= set(moved)  # and they are free to move
    assert provenance(tmp_path / "run" / "best.safetensors")["recipe"]["start"] == str(started)


def test_a_shipped_model_can_be_gone_on_from_with_more_iterations(fit, tmp_path):
    recipe = changed(config=Config(iterations=4), start=SHIPPED, epochs=1 / STEPS, learning_rate=1e-9, keep=1 / 6)
    fit(recipe, tmp_path)
    shipped, trained = load_model(SHIPPED), load_model(tmp_path / "best.safetensors")
    assert trained.config.iterations == 4
    for one, other in zip(shipped.parameters(), trained.parameters(), strict=True):
        assert torch.allclose(one, other, atol=1e-6)


@pytest.mark.parametrize(
    ("start", "message"),
    [("no-such-model", "unknown model 'no-such-model'"), ("default", "another architecture"), (__file__, "unknown")],
)
def test_a_start_that_does_not_fit_is_refused(start, message, fit, tmp_path):
    with pytest.raises(InputError, match=message):
        fit(changed(start=start), tmp_path)


# going on


@pytest.fixture
def interrupted(fit, tmp_path) -> Callable[..., Path]:
    """Starts a training of 18 steps with a checkpoint every 4 and stops it after a step."""

    def start(stop_after: int) -> Path:
        with pytest.raises(KeyboardInterrupt):
            fit(changed(epochs=2), tmp_path / "interrupted", validate_every=4, stop_after=stop_after)
        return tmp_path / "interrupted"

    return start


@pytest.mark.parametrize(
    ("stop_after", "done"), [(1, 0), (9, 8), (11, 8)], ids=["before the first checkpoint", "between", "just before one"]
)
def test_a_resumed_training_ends_with_the_same_bits(stop_after, done, fit, interrupted, tmp_path):
    whole = fit(changed(epochs=2), tmp_path / "whole", validate_every=4)
    folder = interrupted(stop_after)
    rest = fit(changed(epochs=2), folder, validate_every=4, resume=True)
    assert [loss.total for loss in rest] == [loss.total for loss in whole[done:]]
    expected, found = checkpoint(tmp_path / "whole"), checkpoint(folder)
    assert same(found["model"], expected["model"])
    for one, other in zip(found["optimizer"]["state"].values(), expected["optimizer"]["state"].values(), strict=True):
        assert same(one, other)
    assert found["progress"]["step"] == 18
    assert found["progress"]["best"] == expected["progress"]["best"]
    best = [folder / "best.safetensors" for folder in (folder, tmp_path / "whole")]
    assert same(*(load_file(path) for path in best))
    assert len({provenance(path)["steps"] for path in best}) == 1


def test_the_time_before_the_interruption_counts(fit, interrupted):
    folder = interrupted(9)
    state = checkpoint(folder)
    state["progress"]["seconds"] = 1000.0
    torch.save(state, folder / "last.ckpt")
    fit(changed(epochs=2), folder, validate_every=4, resume=True)
    assert 1000 < checkpoint(folder)["progress"]["seconds"] < 1100


def test_without_resume_a_training_starts_again(fit, interrupted):
    assert len(fit(changed(epochs=2), interrupted(9))) == 18


def test_resuming_a_finished_training_changes_nothing(fit, tmp_path):
    fit(SMALL, tmp_path)
    before = {name: (tmp_path / name).read_bytes() for name in ("best.safetensors", "last.ckpt")}
    assert fit(SMALL, tmp_path, resume=True) == []
    assert {name: (tmp_path / name).read_bytes() for name in before} == before


@pytest.mark.parametrize(
    "options",
    [{"seed": 1}, {"epochs": 3}, {"learning_rate": 1e-3}, {"config": Config(neighbours=6, channels=16)}],
    ids=lambda options: next(iter(options)),
)
def test_a_checkpoint_of_another_recipe_is_refused(options, fit, interrupted):
    folder = interrupted(5)
    before = (folder / "last.ckpt").read_bytes()
    with pytest.raises(InputError, match=r"last\.ckpt: was trained with other options"):
        fit(changed(**({"epochs": 2} | options)), folder, resume=True)
    assert (folder / "last.ckpt").read_bytes() == before


def without_weights(path: Path) -> None:
    torch.save({"recipe": json.dumps(dataclasses.asdict(SMALL))}, path)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda path: path.write_bytes(b"nonsense"),
        lambda path: path.write_bytes(b""),
        lambda path: path.write_bytes(path.read_bytes()[:-1000]),
        lambda path: torch.save([1, 2], path),
        without_weights,
    ],
    ids=["nonsense", "empty", "cut short", "a list", "without weights"],
)
def test_a_broken_checkpoint_is_refused_in_one_line(spoil, fit, tmp_path):
    fit(SMALL, tmp_path)
    spoil(tmp_path / "last.ckpt")
    with pytest.raises(InputError, match=r"last\.ckpt: not a checkpoint") as caught:
        fit(SMALL, tmp_path, resume=True)
    assert "\n" not in str(caught.value)


def test_a_checkpoint_that_cannot_be_written_leaves_the_old_one_and_nothing_else(fit, tmp_path, monkeypatch):
    fit(SMALL, tmp_path)
    before, files = (tmp_path / "last.ckpt").read_bytes(), names(tmp_path)

    def fill_the_disk(partial: Path, target: Path) -> None:
        if target.name == "last.ckpt":
            raise OSError(28, "No space left on device")
        os.replace(partial, target)  # noqa: PTH105 - Path's own is this very function

    monkeypatch.setattr(Path, "replace", fill_the_disk)
    with pytest.raises(InputError, match=r"last\.ckpt.*No space left"):
        fit(SMALL, tmp_path)
    assert (tmp_path / "last.ckpt").read_bytes() == before
    assert names(tmp_path) == files


# what is refused

BAD_RECIPES = {
    "an unknown experiment": ({"experiment": "seen-shapes"}, ", ".join(TRAININGS)),
    "an unknown schedule": ({"schedule": "cosine"}, "step or one-cycle"),
    "unknown features": ({"config": Config(features="sift")}, "gnn, fpfh or invariant"),
    "no epochs": ({"epochs": 0}, "epochs"),
    "negative epochs": ({"epochs": -1}, "epochs"),
    "epochs that are no number": ({"epochs": math.nan}, "epochs"),
    "endless epochs": ({"epochs": math.inf}, "epochs"),
    "no learning rate": ({"learning_rate": 0.0}, "learning rate"),
    "a learning rate that is no number": ({"learning_rate": math.nan}, "learning rate"),
    "an infinite learning rate": ({"learning_rate": math.inf}, "learning rate"),
    "a batch of one": ({"batch_size": 1}, "at least 2 pairs"),
    "a batch larger than the data": ({"batch_size": 37}, "36 shapes"),
    "a negative radius": ({"radius": -0.05}, "radius"),
    "a share of points above one": ({"keep": 1.5}, "share"),
    "no points": ({"keep": 0.0}, "share"),
    "a pool smaller than a batch": ({"pool": 3}, "pool of 3 pairs"),
    "negative noise": ({"noise": -0.01}, "sigma"),
    "noise that is no number": ({"noise": math.nan}, "sigma"),
    "a huge seed": ({"seed": 10**13}, "seed"),
}
BAD_OPTIONS = {
    "an unknown device": ({"device": "abacus"}, "auto, cpu or cuda"),
    "an unknown precision": ({"precision": "16"}, "32 or bf16"),
    "no steps between validations": ({"validate_every": 0}, "1 or more"),
}


@pytest.mark.parametrize(("options", "message"), BAD_RECIPES.values(), ids=BAD_RECIPES)
def test_a_recipe_that_makes_no_sense_is_refused_in_one_line(options, message, fit, tmp_path):
    with pytest.raises(InputError, match=message) as caught:
        fit(changed(**options), tmp_path)
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.glob("*.safetensors"))


@pytest.mark.parametrize(("options", "message"), BAD_OPTIONS.values(), ids=BAD_OPTIONS)
def test_options_that_make_no_sense_are_refused_in_one_line(options, message, fit, tmp_path):
    with pytest.raises(InputError, match=message) as caught:
        fit(SMALL, tmp_path, **options)
    assert "\n" not in str(caught.value)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device here")
def test_cuda_is_refused_where_there_is_none(fit, tmp_path):
    with pytest.raises(InputError, match="no CUDA device"):
        fit(SMALL, tmp_path, device="cuda")


def test_more_processes_than_pairs_in_a_batch_are_refused(fit, tmp_path, monkeypatch):
    fabric = pytest.importorskip("lightning_fabric").Fabric
    monkeypatch.setattr(fabric, "world_size", property(lambda _: 5))
    with pytest.raises(InputError, match="5 processes"):
        fit(SMALL, tmp_path)


def test_a_training_that_diverges_stops_and_leaves_no_model(fit, tmp_path):
    with pytest.raises(InputError, match="diverged"):
        fit(changed(learning_rate=1e30, schedule="step"), tmp_path, validate_every=4)
    assert names(tmp_path) <= {"events"}


def test_a_missing_data_folder_is_refused_in_one_line(tmp_path, monkeypatch):
    for package in ("lightning_fabric", "tensorboard", "h5py"):
        pytest.importorskip(package, reason=f"training needs {package}")
    monkeypatch.setattr(loop, "keep_freed_memory", lambda: True)
    with pytest.raises(InputError, match="nowhere") as caught:
        train(SMALL, tmp_path / "nowhere", tmp_path / "out", device="cpu")
    assert "\n" not in str(caught.value)


def test_a_file_in_place_of_the_output_folder_is_refused(fit, tmp_path):
    (tmp_path / "file").touch()
    for output in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(InputError, match="choose another"):
            fit(SMALL, output)


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write everywhere")
def test_a_read_only_output_folder_is_refused(fit, tmp_path):
    tmp_path.chmod(0o500)
    for output in (tmp_path, tmp_path / "below"):
        with pytest.raises(InputError, match="choose another"):
            fit(SMALL, output)


@pytest.mark.parametrize(
    "missing", [["lightning_fabric"], ["tensorboard", "torch.utils.tensorboard"]], ids=lambda missing: missing[0]
)
def test_without_its_packages_the_pip_command_is_given(missing, monkeypatch, tmp_path):
    for module in missing:
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'idam\[train\]'"):
        train(SMALL, tmp_path, tmp_path)


# memory

FAULTS = """
import resource
from idam.lab.training.memory import keep_freed_memory

def faults(size):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(5):
        b"x" * size
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

# glibc treats blocks of up to 32 MiB in one way and larger ones in another
sizes = 2**24, 2**27
plain = [faults(size) for size in sizes]
taken = keep_freed_memory()
print(taken, *plain, *map(faults, sizes))
"""


def test_a_process_that_keeps_freed_memory_does_not_fault_it_in_again():
    found = subprocess.run([sys.executable, "-c", FAULTS], capture_output=True, text=True, check=True)
    taken, *counts = found.stdout.split()
    if taken == "False":
        pytest.skip("this C library has no such setting")
    small, large, small_kept, large_kept = map(int, counts)
    assert small_kept < 0.3 * small
    assert large_kept < 0.3 * large
