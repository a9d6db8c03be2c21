"""General training: its loss against loops, its pairs and batches, learning, resuming, and what is refused."""

import dataclasses
import itertools
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F
import trimesh
from safetensors.torch import load_file
from torch import Tensor

from idam.cli import main
from idam.describe.invariant import surroundings
from idam.errors import InputError
from idam.lab.data import general as scans
from idam.lab.data.modelnet40 import Shapes
from idam.lab.data.working import TOUCHING
from idam.lab.training import Recipe, general, loop, train
from idam.lab.training.batches import VALIDATION_SEED
from idam.lab.training.general import (
    AMBIGUOUS,
    MATCHED,
    GeneralStep,
    GeneralTask,
    Lesson,
    MatchLoss,
    ScannedPair,
    compact,
    learns_features_alone,
    matching_of,
    scanned,
)
from idam.lab.training.recipe import check
from idam.network.config import Config
from idam.network.features.invariant import Invariant
from idam.network.pretrained import load_model
from idam.weights import provenance
from watching import watched_log

CONFIG = Config(features="invariant", convolution=False, hybrid_elimination=False, iterations=1, blocks=1, channels=8)
SMALL = Recipe("general", CONFIG, epochs=1, batch_size=3, schedule="one-cycle", learning_rate=3e-3)
STEPS = 2
"""Of SMALL: 6 pairs, 3 a step."""


def changed(**options: Any) -> Recipe:
    return dataclasses.replace(SMALL, **options)


@pytest.fixture
def shapes() -> Shapes:
    """17 bent sheets of 1024 points."""
    generator = torch.Generator().manual_seed(0)
    u, v = (torch.rand(17, 1024, 2, generator=generator) * 2 - 1).unbind(-1)
    bend = torch.randn(2, 17, 1, generator=generator)
    return Shapes(torch.stack([u, 0.7 * v, bend[0] * u**2 + bend[1] * u * v**2], -1), torch.arange(17))


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch, shapes: Shapes) -> None:
    """Six pairs to train on and two to validate on, of scans of some 150 points."""
    monkeypatch.setattr(general, "load", lambda *_: shapes)
    monkeypatch.setattr(general, "PAIRS", {"general": 6, "practice-any-rotation": 6})
    monkeypatch.setattr(general, "VALIDATION_PAIRS", 2)
    monkeypatch.setattr(scans, "DENSE", 15_000)
    monkeypatch.setattr(scans, "COUNTS", (150,) * 4)
    monkeypatch.setattr(scans, "FEWEST", 60)


@pytest.fixture
def make(small, tmp_path) -> Callable[..., GeneralTask]:
    """Makes the task of a recipe like SMALL."""
    return lambda **options: GeneralTask(changed(**options), tmp_path, "32")


@pytest.fixture
def fit(small, monkeypatch) -> Callable[..., list[MatchLoss]]:
    """Trains, stopped by Ctrl-C after a step if asked to, and returns the loss of every step."""
    pytest.importorskip("lightning_fabric", reason="training needs Lightning Fabric")
    pytest.importorskip("tensorboard", reason="training needs TensorBoard")
    monkeypatch.setattr(loop, "keep_freed_memory", lambda: True)  # it would hold for all tests after this one

    def run(recipe: Recipe, output: Path, *, stop_after: int | None = None, **options: Any) -> list[MatchLoss]:
        losses: list[MatchLoss] = []
        with monkeypatch.context() as patch:
            patch.setattr(loop, "Log", watched_log(losses, stop_after))
            train(recipe, output.parent, output, **({"device": "cpu"} | options))
        return losses

    return run


def tensors(pair: ScannedPair) -> list[Tensor]:
    return [*map(torch.from_numpy, (*pair.source, *pair.target)), pair.aligned, pair.goal]


def same(one: ScannedPair, other: ScannedPair) -> bool:
    return all(torch.equal(a, b) for a, b in zip(tensors(one), tensors(other), strict=True))


def numbers(lesson: Lesson, task: GeneralTask) -> list[int]:
    """Which of the six pairs a lesson has."""
    return [next(n for n in range(6) if same(task.pair(n), pair)) for pair in lesson.pairs]


def test_one_s_own_pairs_are_learnt_from_and_held_out(make, tmp_path, monkeypatch):
    rng = np.random.default_rng(0)
    scans_of, count = rng.standard_normal((9, 40, 3)), 9
    arrays = {"source": scans_of, "target": scans_of, "R": np.tile(np.eye(3), (count, 1, 1)), "t": np.zeros((count, 3))}
    np.savez(tmp_path / "mine.npz", **arrays)
    kept = []
    monkeypatch.setattr(general, "scanned", lambda draw, material, *_: kept.append(material))
    task = make(pairs=str(tmp_path / "mine.npz"))
    assert len(task.material.pairs) == 7
    assert [len(material.pairs) for material in kept] == [2, 2]
    assert "9 pairs of" in task.data


def test_own_pairs_are_for_general_training_alone():
    with pytest.raises(InputError, match="--pairs are for general training"):
        check(Recipe(pairs="mine.npz"))


# the loss


@pytest.fixture
def features(randn) -> dict[str, Tensor]:
    """Of 30 points and 40 others, at distances that leave some without a match and others with several near."""
    points, others = 2 * randn(30, 3), 2 * randn(40, 3)
    own, other, significance = (randn(*size, requires_grad=True) for size in ((30, 16), (40, 16), (30,)))
    return {"own": own, "other": other, "distance": torch.cdist(points, others), "significance": significance}


def direct_matching(own: Tensor, other: Tensor, distance: Tensor, significance: Tensor) -> MatchLoss:
    """The means over points with a match, one at a time."""
    matching, entropy, right = [], [], []
    for i in range(len(own)):
        match = int(distance[i].argmin())
        if distance[i, match] >= MATCHED:
            continue
        candidates = [j for j in range(len(other)) if j == match or distance[i, j] >= AMBIGUOUS]
        score = torch.stack([own[i] @ other[j] for j in candidates]) / own.shape[1] ** 0.5
        share = score.exp() / score.exp().sum()
        matching.append(-share[candidates.index(match)].log())
        entropy.append((significance[i] - (share * share.log()).sum().detach()) ** 2)
        right.append(float(candidates[int(score.argmax())] == match))
    assert 3 < len(matching) < len(own)
    return MatchLoss(torch.stack(matching).mean(), torch.stack(entropy).mean(), torch.tensor(right).mean())


def test_matching_is_the_mean_over_points_with_a_match(features, generator, close):
    ours, expected = matching_of(**features, generator=generator), direct_matching(**features)
    close(ours.matching, expected.matching)
    close(ours.entropy, expected.entropy)
    assert ours.accuracy == expected.accuracy
    inputs = [features[name] for name in ("own", "other", "significance")]
    for one, other in zip(*(torch.autograd.grad(loss.total, inputs) for loss in (ours, expected)), strict=True):
        close(one, other)


def test_at_most_so_many_points_are_drawn_and_others_at_other_times(features, generator, monkeypatch):
    monkeypatch.setattr(general, "ROWS", 2)
    gradients = []
    for _ in range(5):
        loss = matching_of(**features, generator=generator)
        gradients.append(torch.autograd.grad(loss.entropy, features["significance"])[0] != 0)
    assert [int(drawn.sum()) for drawn in gradients] == [2] * 5
    assert not all(torch.equal(drawn, gradients[0]) for drawn in gradients)


def test_the_significance_learns_from_the_matching_and_leaves_it_alone(make):
    task = make()
    loss = task.module(task.batch(0, 0, 1))
    of_features, of_significance = (list(part.parameters()) for part in
                                    (task.module.model.features, task.module.model.significance))  # fmt: skip
    for part, taught, left in (("matching", of_features, of_significance), ("entropy", of_significance, of_features)):
        grads = torch.autograd.grad(getattr(loss, part), taught + left, retain_graph=True, allow_unused=True)
        assert all(grad.any() for grad in grads[: len(taught)])
        assert not any(grad is not None and grad.any() for grad in grads[len(taught) :])


def test_without_a_match_there_is_nothing_to_learn(features, generator):
    loss = matching_of(**(features | {"distance": features["distance"] + 5}), generator=generator)
    assert [part.item() for part in loss] == [0, 0, 0]
    loss.total.backward()
    assert not features["own"].grad.any()


def test_both_clouds_look_for_their_matches(make):
    task = make()
    pair, model = task.pair(0), task.module.model
    swapped = ScannedPair(pair.target, pair.source, pair.goal, pair.aligned)
    one, other = (task.module.eval()(Lesson([p], torch.Generator())) for p in (pair, swapped))
    torch.testing.assert_close(one, other)
    described = [model.features.describe(side) for side in (pair.source, pair.target)]
    distance = torch.cdist(pair.aligned, pair.goal)
    ways = [matching_of(*described, distance, torch.zeros(len(distance)), torch.Generator()),
            matching_of(*described[::-1], distance.T, torch.zeros(distance.shape[1]), torch.Generator())]  # fmt: skip
    torch.testing.assert_close(one.matching, (ways[0].matching + ways[1].matching) / 2)


def test_perfect_features_match_all_and_lose_nothing(generator):
    points = torch.randn(50, 3, generator=generator, dtype=torch.float64) * 20
    features = F.one_hot(torch.arange(50)).double() * 60
    loss = matching_of(features, features, torch.cdist(points, points), torch.zeros(50).double(), generator)
    assert loss.accuracy == 1
    assert loss.matching < 1e-6
    assert loss.entropy < 1e-6


# pairs and batches


@pytest.mark.parametrize("draw", [scans.draw_scans, scans.draw_halves])
def test_a_pair_s_clouds_overlap_under_the_truth(make, draw):
    material = make().material
    for n in range(4):
        pair = draw(material, np.random.default_rng((3, n)))
        found = scanned(draw, material, 3, n)
        distance = torch.cdist(found.aligned.double(), found.goal.double())
        shares = [(distance.amin(way) < TOUCHING).double().mean() for way in (0, 1)]
        assert min(shares).item() == pytest.approx(pair.overlap, abs=1e-9)
        for side, cloud in ((found.source, found.aligned), (found.target, found.goal)):
            assert len(side.points) == len(cloud)
            torch.testing.assert_close(
                torch.pdist(torch.from_numpy(side.points)), torch.pdist(cloud), rtol=1e-3, atol=1e-3
            )


def test_kept_pairs_lose_nothing_that_counts():
    around = surroundings(np.random.default_rng(0).standard_normal((200, 3)))
    kept = compact(around)
    assert np.array_equal(kept.near, around.near)
    np.testing.assert_allclose(kept.histograms, around.histograms, rtol=1e-3, atol=1e-3)
    assert all(np.array_equal(*both) for both in zip(kept[:2], around[:2], strict=True))
    assert sum(x.nbytes for x in kept[2:]) < 0.4 * sum(x.nbytes for x in around[2:])
    model = Invariant()
    torch.testing.assert_close(model.describe(kept), model.describe(around), rtol=0, atol=1e-2)


@pytest.mark.parametrize("seed", [3, -3])
def test_a_batch_depends_on_the_seed_and_the_step_alone(seed, make):
    one = make(seed=seed).batch(1, 0, 1)
    torch.rand(1)
    task = make(seed=seed, epochs=7, learning_rate=1.0)
    task.batch(0, 0, 1)
    again = task.batch(1, 0, 1)
    assert all(same(*both) for both in zip(one.pairs, again.pairs, strict=True))
    assert torch.equal(one.generator.get_state(), again.generator.get_state())
    for other in (task.batch(0, 0, 1), make(seed=4).batch(1, 0, 1)):
        assert not any(same(*both) for both in itertools.product(one.pairs, other.pairs))
        assert not torch.equal(one.generator.get_state(), other.generator.get_state())


def test_every_epoch_has_each_pair_once_in_an_order_of_its_own(make):
    task = make()
    epochs = [[numbers(task.batch(step, 0, 1), task) for step in (2 * n, 2 * n + 1)] for n in range(4)]
    assert all(sorted(itertools.chain(*epoch)) == list(range(6)) for epoch in epochs)
    assert len({tuple(itertools.chain(*epoch)) for epoch in epochs}) > 1


def test_processes_share_a_batch(make):
    task = make()
    whole = task.batch(1, 0, 1)
    parts = [task.batch(1, rank, 2) for rank in range(2)]
    assert [len(part.pairs) for part in parts] == [2, 1]
    assert sorted(itertools.chain(*(numbers(part, task) for part in parts))) == sorted(numbers(whole, task))
    assert not torch.equal(*(part.generator.get_state() for part in parts))


def test_an_eighth_of_shapes_and_meshes_is_held_out(small, shapes, tmp_path, monkeypatch):
    (tmp_path / "meshes").mkdir()
    for n in range(9):
        trimesh.creation.box((n + 1, 1, 1)).export(tmp_path / "meshes" / f"{n}.ply")
    asked = []
    monkeypatch.setattr(general, "scanned", lambda _, material, *__: asked.append(material))
    task = GeneralTask(SMALL, tmp_path, "32")
    task.batch(0, 0, 1)
    held, taught = asked[0], asked[-1]
    assert len(held.shapes) == 3
    whole = np.concatenate([held.shapes, taught.shapes])
    assert {shape.tobytes() for shape in whole} == {shape.numpy().tobytes() for shape in shapes.points}
    assert sorted(mesh.extents[0] for mesh in held.meshes) == [1, 9]
    assert sorted(mesh.extents[0] for mesh in taught.meshes) == list(range(2, 9))
    assert "9 meshes" in task.data


def test_validation_pairs_are_none_that_training_draws_whatever_its_seed(small, shapes, tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(general, "scanned", lambda *state: drawn.append(state[2:]))
    task = GeneralTask(changed(seed=VALIDATION_SEED), tmp_path, "32")
    held = set(drawn)
    for step in range(task.size // SMALL.batch_size):
        task.batch(step, 0, 1)
    assert len(held) == general.VALIDATION_PAIRS
    assert held.isdisjoint(drawn[len(held) :])


def test_halves_are_drawn_where_they_are_what_is_trained_for(small, shapes, tmp_path, monkeypatch):
    drawn = set()
    monkeypatch.setattr(general, "scanned", lambda draw, *_: drawn.add(draw))
    for experiment, draw in (("general", scans.draw_scans), ("practice-any-rotation", scans.draw_halves)):
        drawn.clear()
        recipe = changed(experiment=experiment)
        assert learns_features_alone(recipe)
        GeneralTask(recipe, tmp_path, "32").batch(0, 0, 1)
        assert drawn == {draw}
    assert not learns_features_alone(changed(experiment="practice-any-rotation", config=Config()))


# training


def test_the_loss_falls_and_more_points_are_matched_right(fit, tmp_path):
    losses = fit(changed(epochs=12), tmp_path / "run", validate_every=100)
    first, last = (
        MatchLoss(*(torch.stack(part).mean() for part in zip(*ends, strict=True))) for ends in (losses[:6], losses[-6:])
    )
    assert last.matching < first.matching - 0.5
    assert last.accuracy > 2 * first.accuracy


def test_the_significance_learns_what_matching_finds_easy(make):
    task = make()
    lesson = Lesson([task.pair(0)], torch.Generator())
    optimizer = torch.optim.Adam(task.module.model.significance.parameters(), 0.02)
    losses = []
    for _ in range(15):
        loss = task.module(lesson).entropy
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.5 * losses[0]


def test_the_same_seed_gives_the_same_bits_and_another_seed_others(fit, tmp_path):
    for name, seed in (("one", 3), ("again", 3), ("other", 4)):
        torch.rand(seed)  # what was drawn before has no say
        fit(changed(seed=seed), tmp_path / name)
    one, again, other = (load_file(tmp_path / name / "best.safetensors") for name in ("one", "again", "other"))
    assert all(torch.equal(value, again[name]) for name, value in one.items())
    assert not torch.equal(one["features.first.weight"], other["features.first.weight"])


def test_a_resumed_training_ends_with_the_same_bits(fit, tmp_path):
    recipe = changed(epochs=3)
    whole = fit(recipe, tmp_path / "whole", validate_every=2)
    with pytest.raises(KeyboardInterrupt):
        fit(recipe, tmp_path / "run", validate_every=2, stop_after=4)
    rest = fit(recipe, tmp_path / "run", validate_every=2, resume=True)
    assert [loss.total for loss in rest] == [loss.total for loss in whole[4:]]
    expected, found = (torch.load(tmp_path / name / "last.ckpt", weights_only=True) for name in ("whole", "run"))
    assert all(torch.equal(value, found["model"][name]) for name, value in expected["model"].items())
    assert found["progress"]["best"] == expected["progress"]["best"]


def test_how_often_is_validated_does_not_change_the_model(fit, tmp_path):
    for every in (1, 2):
        fit(SMALL, tmp_path / str(every), validate_every=every)
    one, other = (torch.load(tmp_path / name / "last.ckpt", weights_only=True)["model"] for name in "12")
    assert all(torch.equal(value, other[name]) for name, value in one.items())


def test_the_checkpoint_with_the_least_matching_loss_is_kept(fit, tmp_path, monkeypatch):
    losses = iter([5.0, 3.0, 4.0])
    monkeypatch.setattr(
        GeneralTask, "validate", lambda _: (error := next(losses), general.MatchScores(error, 1 / error))
    )
    fit(changed(epochs=1.5), tmp_path / "run", validate_every=1)
    told = provenance(tmp_path / "run" / "best.safetensors")
    assert (told["steps"], told["validation"]) == (2, {"matching": 3.0, "accuracy": 0.33333})


def test_the_best_model_tells_how_it_came_about_and_can_be_used(fit, tmp_path, make, randn):
    fit(SMALL, tmp_path / "run", command="idam train general")
    best = tmp_path / "run" / "best.safetensors"
    model, told = load_model(best), provenance(best)
    assert model.config == CONFIG
    assert (told["experiment"], told["steps"], told["command"]) == ("general", STEPS, "idam train general")
    assert told["data"].startswith("6 pairs of scans")
    assert told["validation_pairs"].startswith("2 pairs of scans")
    task = make()
    task.module = GeneralStep(model)
    assert told["validation"] == pytest.approx(task.validate()[1].to_dict(), abs=1e-5)
    output = model(randn(2, 50, 3).float(), randn(2, 60, 3).float())
    assert output.rotation.isfinite().all()


# what is refused

REFUSED = {
    "features that change with the pose": ({"config": Config()}, "32", "--features invariant"),
    "a convolution": ({"config": dataclasses.replace(CONFIG, convolution=True)}, "32", "convolution=false"),
    "a validity": ({"config": dataclasses.replace(CONFIG, hybrid_elimination=True)}, "32", "hybrid_elimination=false"),
    "bfloat16": ({}, "bf16", "--precision"),
    "a batch larger than the pairs": ({"batch_size": 7}, "32", "6 "),
}


@pytest.mark.parametrize(("options", "precision", "message"), REFUSED.values(), ids=REFUSED)
def test_what_cannot_be_taught_is_refused_in_one_line(options, precision, message, fit, tmp_path):
    with pytest.raises(InputError, match=message) as caught:
        fit(changed(**options), tmp_path / "run", precision=precision)
    assert "\n" not in str(caught.value)


def test_a_mesh_that_cannot_be_read_is_refused(fit, tmp_path):
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "cow.ply").write_bytes(b"moo")
    with pytest.raises(InputError, match=r"cow\.ply"):
        fit(SMALL, tmp_path / "run")


# the command line


def test_the_command_of_the_help_text_trains(small, fit, tmp_path, monkeypatch, capsys):
    words = "train general --features invariant --set convolution=false --set hybrid_elimination=false --epochs 1"
    words += f" --set iterations=1 --set blocks=1 --batch-size 4 --device cpu --data {tmp_path} -o {tmp_path / 'run'}"
    monkeypatch.setattr(sys, "argv", ["idam", *words.split()])
    with pytest.raises(SystemExit) as exit:
        main()
    assert exit.value.code == 0
    assert str(tmp_path / "run" / "best.safetensors") in capsys.readouterr().out.replace("\n", "")
