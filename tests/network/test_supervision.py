"""The mutual-supervision loss against loops over its formulas, and where its gradients go."""

from typing import NamedTuple

import numpy as np
import pytest
import torch
from torch import Tensor

from idam.network.geometry import apply_transform, gather_points, random_rotation
from idam.network.model import Iteration
from idam.network.supervision import Loss, mutual_supervision

RADIUS = 0.3


class Scene(NamedTuple):
    """The arguments of the loss, in their order."""

    iterations: list[Iteration]
    source: Tensor
    target: Tensor
    rotation: Tensor
    translation: Tensor
    source_significance: Tensor
    target_significance: Tensor
    radius: float = RADIUS


@pytest.fixture
def scene(randn, generator) -> Scene:
    """Two pairs of 8 source and 6 target points, half of the sources with a target near under the truth."""
    rotation, translation = random_rotation(2, generator=generator, dtype=torch.float64), randn(2, 3)
    source = randn(2, 8, 3)
    target = apply_transform(source, rotation, translation)[:, 2:] + 0.02 * randn(2, 6, 3)
    target[:, 4:] += 3

    def iteration(right: int) -> Iteration:
        score = (3 * randn(2, 8, 6)).requires_grad_()
        logit = randn(2, 8).requires_grad_()
        correspondence = score.detach().argmax(-1)
        correspondence[:, 2 : 2 + right] = torch.arange(right)
        match = gather_points(target, correspondence)
        return Iteration(randn(2, 8, 3), score, match, correspondence, logit, randn(2, 8), rotation, translation)

    significance = randn(2, 8).requires_grad_(), randn(2, 6).requires_grad_()
    return Scene([iteration(right) for right in (3, 1, 2)], source, target, rotation, translation, *significance)


def array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().numpy()


def softmax(score: np.ndarray) -> np.ndarray:
    return np.exp(score) / np.exp(score).sum(-1, keepdims=True)


def square_distances(scene: Scene, b: int, i: int) -> np.ndarray:
    """|R* p_i + t* - q_j|^2 for every j."""
    moved = array(scene.rotation[b]) @ array(scene.source[b, i]) + array(scene.translation[b])
    return ((moved - array(scene.target[b])) ** 2).sum(-1)


def matching_by_loops(scene: Scene) -> float:
    means = []
    for step in scene.iterations:
        terms = []
        for b, i in np.ndindex(2, 8):
            distance = square_distances(scene, b, i)
            if distance.min() <= RADIUS**2:
                terms.append(-np.log(softmax(array(step.score[b, i]))[distance.argmin()]))
        means.append(np.mean(terms))
    return float(np.mean(means))


def entropy_by_loops(scene: Scene) -> float:
    score, total = array(scene.iterations[0].score), 0.0
    for scores, significance in (
        (score, array(scene.source_significance)),
        (score.transpose(0, 2, 1), array(scene.target_significance)),
    ):
        terms = []
        for b, i in np.ndindex(significance.shape):
            terms.append((significance[b, i] - sum(p * np.log(p) for p in softmax(scores[b, i]))) ** 2)
        total += np.mean(terms)
    return float(total)


def elimination_by_loops(scene: Scene) -> float:
    terms = []
    for step in scene.iterations:
        for b, i in np.ndindex(2, 8):
            right = square_distances(scene, b, i)[step.correspondence[b, i]] <= RADIUS**2
            validity = 1 / (1 + np.exp(-array(step.validity_logit)[b, i]))
            terms.append(-np.log(validity if right else 1 - validity))
    return float(np.mean(terms))


def accuracy_by_loops(scene: Scene) -> float:
    hits = []
    for b, i in np.ndindex(2, 8):
        distance = square_distances(scene, b, i)
        if distance.min() <= RADIUS**2:
            hits.append(distance[scene.iterations[-1].correspondence[b, i]] <= RADIUS**2)
    return float(np.mean(hits))


BY_LOOPS = {
    "matching": matching_by_loops,
    "entropy": entropy_by_loops,
    "elimination": elimination_by_loops,
    "accuracy": accuracy_by_loops,
}


def gradients(part: Tensor, leaves: list[Tensor]) -> list[Tensor]:
    found = torch.autograd.grad(part, leaves, allow_unused=True, retain_graph=True)
    return [torch.zeros_like(leaf) if g is None else g for leaf, g in zip(leaves, found, strict=True)]


def mutual_loss(scene: Scene) -> Loss:
    return mutual_supervision(*scene)


def test_the_scene_holds_every_kind_of_match(scene):
    nearest = np.array([square_distances(scene, b, i).min() for b, i in np.ndindex(2, 8)])
    assert 0 < (nearest <= RADIUS**2).sum() < 16
    assert 0 < accuracy_by_loops(scene) < 1


@pytest.mark.parametrize("part", BY_LOOPS)
def test_each_part_is_its_formula(part, scene):
    assert getattr(mutual_loss(scene), part).item() == pytest.approx(BY_LOOPS[part](scene), rel=1e-5)


def test_a_match_between_target_points_is_judged_by_where_it_lies(scene):
    aligned = apply_transform(scene.source, scene.rotation, scene.translation)

    def elimination(offset: float) -> float:
        step = Iteration(**(vars(scene.iterations[0]) | {"match": aligned + offset / 3**0.5}))
        return mutual_loss(scene._replace(iterations=[step])).elimination.item()

    logit = scene.iterations[0].validity_logit.detach().float()
    assert elimination(0.99 * RADIUS) == pytest.approx(-logit.sigmoid().log().mean().item(), rel=1e-5)
    assert elimination(1.01 * RADIUS) == pytest.approx(-(-logit).sigmoid().log().mean().item(), rel=1e-5)


def test_the_total_is_the_sum_of_the_parts(scene):
    loss = mutual_loss(scene)
    assert torch.equal(loss.total, loss.matching + loss.entropy + loss.elimination)


def test_the_entropy_trains_the_significance_and_not_the_scores(scene):
    loss = mutual_loss(scene)
    assert all((g == 0).all() for g in gradients(loss.entropy, [step.score for step in scene.iterations]))
    significance = [scene.source_significance, scene.target_significance]
    assert all((g != 0).all() for g in gradients(loss.entropy, significance))
    assert all((g == 0).all() for g in gradients(loss.matching + loss.elimination, significance))


def test_the_entropy_is_that_of_the_first_iteration(scene, randn):
    def entropy_with_other_scores_in(n: int) -> float:
        steps = list(scene.iterations)
        steps[n] = Iteration(**(vars(steps[n]) | {"score": randn(2, 8, 6)}))
        return mutual_loss(scene._replace(iterations=steps)).entropy.item()

    before = mutual_loss(scene).entropy.item()
    assert entropy_with_other_scores_in(1) == entropy_with_other_scores_in(2) == before
    assert entropy_with_other_scores_in(0) != before


def test_the_validity_s_labels_pass_no_gradient_to_the_scores(scene):
    elimination = mutual_loss(scene).elimination
    assert all((g == 0).all() for g in gradients(elimination, [step.score for step in scene.iterations]))
    assert all((g != 0).all() for g in gradients(elimination, [step.validity_logit for step in scene.iterations]))


def test_only_rows_with_a_match_are_taught_to_match(scene):
    matched = torch.tensor([[square_distances(scene, b, i).min() <= RADIUS**2 for i in range(8)] for b in range(2)])
    for gradient in gradients(mutual_loss(scene).matching, [step.score for step in scene.iterations]):
        assert torch.equal((gradient != 0).any(-1), matched)


def test_without_any_match_the_loss_is_finite(scene):
    loss = mutual_loss(scene._replace(target=scene.target + 100))
    assert loss.matching.item() == loss.accuracy.item() == 0
    assert loss.total.isfinite()
    assert all(g.isfinite().all() for g in gradients(loss.total, [step.score for step in scene.iterations]))


def test_certain_scores_keep_the_loss_finite(scene):
    certain = [Iteration(**(vars(step) | {"score": step.score * 1e4})) for step in scene.iterations]
    loss = mutual_loss(scene._replace(iterations=certain))
    assert loss.total.isfinite()
    assert all(g.isfinite().all() for g in gradients(loss.total, [step.score for step in scene.iterations]))
