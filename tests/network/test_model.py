"""The iteration: shapes, invariances, composition, and what each setting changes."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from idam.network.config import Config
from idam.network.elimination import hybrid_weights
from idam.network.features import GNN, build_features
from idam.network.geometry import apply_transform, gather_points, weighted_procrustes
from idam.network.model import IDAM
from idam.network.similarity import SimilarityConvolution

SMALL = {"neighbours": 5, "channels": 8, "keep": 1 / 2}


def favour_near_points(module: SimilarityConvolution) -> None:
    """Carry the distance through the first channel to a large negative weight of the score.

    Random weights match most points to the same few: that leaves the rotation open, and rounding decides it.
    """
    distance = 2 * module.feature_channels
    for layer, channel in ((module.first, distance), *((layer, 0) for layer in module.hidden)):
        layer.linear.weight.data[0] = 0
        layer.linear.weight.data[0, channel] = 1
        nn.init.constant_(layer.norm.running_mean[:1], 0)
        for one in (layer.norm.running_var, layer.norm.weight.data):
            one[0] = 1
        layer.norm.bias.data[0] = 0
    module.score.weight.data[0, 0] = -50


@pytest.fixture
def make_model(seasoned):
    """Makes random models in evaluation mode whose matches are near points, float64 unless asked otherwise."""

    def make(dtype: torch.dtype = torch.float64, **config) -> IDAM:
        model = seasoned(IDAM(Config(**(SMALL | config))), dtype)
        for module in model.similarity:
            favour_near_points(module)
        return model

    return make


@pytest.fixture
def clouds(randn) -> tuple[Tensor, Tensor]:
    """Two pairs of clouds of different sizes."""
    return randn(2, 40, 3), randn(2, 50, 3)


def homogeneous(rotation: Tensor, translation: Tensor) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, translation
    return matrix


def test_shapes_of_everything_the_model_returns(make_model, clouds, dtype):
    source, target = (x.to(dtype) for x in clouds)
    out = make_model(dtype, keep=1 / 6)(source, target)
    assert out.rotation.shape == (2, 3, 3)
    assert out.translation.shape == (2, 3)
    for keys, kept, count in ((out.source, 7, 40), (out.target, 9, 50)):
        assert keys.points.shape == (2, kept, 3)
        assert keys.features.shape == (2, kept, 64)
        assert keys.index.shape == (2, kept)
        assert keys.significance.shape == (2, count)
    assert len(out.iterations) == 3
    for step in out.iterations:
        assert step.score.shape == step.similarity.shape == (2, 7, 9)
        assert step.source.shape == step.match.shape == (2, 7, 3)
        assert step.correspondence.shape == step.validity.shape == step.weight.shape == (2, 7)
        assert step.rotation.shape == (2, 3, 3)
        assert step.translation.shape == (2, 3)
        assert {t.dtype for t in vars(step).values()} == {dtype, torch.int64}


def test_key_points_are_the_cloud_s_most_significant_points(make_model, clouds):
    source, target = clouds
    model = make_model()
    out = model(source, target)
    for keys, cloud in ((out.source, source), (out.target, target)):
        features = model.features(cloud)
        significance = model.significance(features)
        for b in range(2):
            best = significance[b].argsort(descending=True)[: keys.index.shape[1]]
            assert set(keys.index[b].tolist()) == set(best.tolist())
            torch.testing.assert_close(keys.points[b], cloud[b][keys.index[b]], rtol=0, atol=0)
            torch.testing.assert_close(keys.features[b], features[b][keys.index[b]])


def test_similarity_rows_and_weights_sum_to_one(make_model, clouds, close):
    for step in make_model()(*clouds).iterations:
        close(step.similarity.sum(-1), torch.ones_like(step.weight))
        close(step.weight.sum(-1), torch.ones(2, dtype=torch.float64))


def test_every_step_solves_its_weighted_matches(make_model, clouds, close):
    out = make_model(keep_matches=0.7)(*clouds)
    for step in out.iterations:
        assert torch.equal(step.correspondence, step.score.argmax(-1))
        assert torch.equal(step.match, gather_points(out.target.points, step.correspondence))
        close(step.weight, hybrid_weights(step.validity, 0.7))
        rotation, translation = weighted_procrustes(step.source, step.match, step.weight)
        close(step.rotation, rotation)
        close(step.translation, translation)


def test_each_iteration_starts_where_the_last_one_ended(make_model, clouds, close):
    out = make_model()(*clouds)
    source = out.source.points
    for step in out.iterations:
        close(step.source, source)
        source = torch.stack([source[b] @ step.rotation[b].T + step.translation[b] for b in range(2)])
    close(apply_transform(out.source.points, out.rotation, out.translation), source)


def test_the_transform_is_the_product_of_the_steps(make_model, clouds):
    out = make_model(iterations=4)(*clouds)
    for b in range(2):
        product = np.eye(4)
        for step in out.iterations:
            product = homogeneous(step.rotation[b], step.translation[b]) @ product
        np.testing.assert_allclose(homogeneous(out.rotation[b], out.translation[b]), product, atol=1e-10)


@pytest.mark.parametrize("soft", [False, True], ids=["hard", "soft"])
def test_the_order_of_the_points_does_not_matter(soft, make_model, clouds, generator, close):
    model, (source, target) = make_model(soft_matches=soft), clouds
    expected = model(source, target)
    for one, other in ((True, False), (False, True), (True, True)):
        rows = torch.randperm(40, generator=generator) if one else torch.arange(40)
        columns = torch.randperm(50, generator=generator) if other else torch.arange(50)
        out = model(source[:, rows], target[:, columns])
        close(out.rotation, expected.rotation)
        close(out.translation, expected.translation)
        assert torch.equal(columns[out.target.index], expected.target.index)
        assert torch.equal(rows[out.source.index], expected.source.index)


@pytest.mark.parametrize("target_points", [50, 40], ids=["different sizes", "one size"])
def test_pairs_of_a_batch_do_not_see_each_other(target_points, make_model, clouds, close):
    model, (source, target) = make_model(), clouds
    target = target[:, :target_points]
    out = model(source, target)
    for b in range(2):
        alone = model(source[b : b + 1], target[b : b + 1])
        close(out.rotation[b], alone.rotation[0])
        close(out.translation[b], alone.translation[0])


def test_clouds_of_one_size_are_encoded_as_they_would_be_alone(make_model, clouds, close):
    model, (source, target) = make_model(), clouds
    for actual, cloud in zip(model.encode(source, target[:, :40]), (source, target[:, :40]), strict=True):
        close(actual, model.features(cloud))


def test_the_same_input_gives_the_same_bits(make_model, clouds, dtype):
    model, clouds = make_model(dtype), [x.to(dtype) for x in clouds]
    one, other = model(*clouds), model(*clouds)
    assert torch.equal(one.rotation, other.rotation)
    assert torch.equal(one.translation, other.translation)
    assert torch.equal(one.iterations[-1].score, other.iterations[-1].score)


def test_matching_near_points_undoes_a_small_shift(make_model, randn, close):
    source, shift = randn(2, 40, 3), torch.tensor([0.01, -0.02, 0.015]).double()
    out = make_model()(source, source + shift)
    close(out.rotation, torch.eye(3, dtype=torch.float64).expand(2, 3, 3))
    close(out.translation, shift.expand(2, 3))


def test_iterations_past_the_blocks_use_the_last_block_again(make_model, clouds):
    shared, unrolled = make_model(blocks=2, iterations=5), make_model(blocks=5, iterations=5)
    for name in ("similarity", "validity"):
        blocks = getattr(shared, name)
        for n, block in enumerate(getattr(unrolled, name)):
            block.load_state_dict(blocks[min(n, 1)].state_dict())
    for name in ("features", "significance"):
        getattr(unrolled, name).load_state_dict(getattr(shared, name).state_dict())
    out, expected = shared(*clouds), unrolled(*clouds)
    assert len(out.iterations) == 5
    assert torch.equal(out.rotation, expected.rotation)
    assert torch.equal(out.iterations[4].score, expected.iterations[4].score)


def test_a_block_without_an_iteration_is_not_used(make_model, clouds):
    model = make_model(blocks=3, iterations=1)
    before = model(*clouds)
    for block in (*model.similarity[1:], *model.validity[1:]):
        for parameter in block.parameters():
            parameter.data.fill_(torch.nan)
    assert torch.equal(model(*clouds).rotation, before.rotation)


def test_soft_matches_are_the_expectation_of_their_row(make_model, clouds, close):
    out = make_model(soft_matches=True)(*clouds)
    for step in out.iterations:
        for b, i in np.ndindex(step.weight.shape):
            close(step.match[b, i], (step.similarity[b, i, :, None] * out.target.points[b]).sum(0))


def test_scores_and_validity_are_differentiable_and_the_transform_is_not(make_model, clouds):
    model = make_model()
    out = model(*clouds)
    tensors = [out.rotation, out.translation]
    for step in out.iterations:
        assert step.score.requires_grad
        assert step.validity_logit.requires_grad
        tensors += [step.source, step.match, step.weight, step.rotation, step.translation]
    assert not any(t.requires_grad for t in tensors)
    sum(step.score.sum() + step.validity_logit.sum() for step in out.iterations).backward()
    for name in ("features", "similarity", "validity"):
        assert all(p.grad is not None for p in getattr(model, name).parameters())


def test_under_autocast_the_transform_keeps_full_precision(make_model, clouds, assert_rotations, close):
    model, clouds = make_model(torch.float32), [x.float() for x in clouds]
    with torch.autocast("cpu", torch.bfloat16):
        out = model(*clouds)
    assert out.rotation.dtype == out.translation.dtype == torch.float32
    assert_rotations(out.rotation)
    moved = out.source.points
    for step in out.iterations:
        assert torch.equal(step.match, gather_points(out.target.points, step.correspondence))
        close(step.source, moved)
        moved = apply_transform(moved, step.rotation, step.translation)
    close(apply_transform(out.source.points, out.rotation, out.translation), moved)


def test_a_model_in_training_gives_finite_results(clouds):
    model = IDAM(Config(**SMALL)).double().train()
    out = model(*clouds)
    assert out.rotation.isfinite().all()
    sum(step.score.sum() + step.validity_logit.sum() for step in out.iterations).backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in model.parameters())


def test_features_are_chosen_by_name():
    assert isinstance(build_features(Config(features="gnn", neighbours=7)), GNN)
    assert build_features(Config(features="gnn", neighbours=7)).neighbours == 7
    assert build_features(Config(features="fpfh")).channels == 33
    with pytest.raises(ValueError, match="'sift'"):
        build_features(Config(features="sift"))


# further tries


@pytest.fixture
def tries(monkeypatch) -> list[tuple[int | None, IDAM, object]]:
    """What every call of match was given and gave."""
    calls, match = [], IDAM.match

    def watched(self, source, target, count=None):
        output = match(self, source, target, count)
        calls.append((count, source, output))
        return output

    monkeypatch.setattr(IDAM, "match", watched)
    return calls


def test_a_trusted_pair_is_not_tried_again(make_model, clouds, tries):
    out = make_model(keep_again=(1.0,), trusted=0.0)(*clouds)
    assert len(tries) == 1
    assert torch.equal(out.rotation, tries[0][2].rotation)


def test_a_pair_that_stays_untrusted_is_tried_with_each_share_and_twice_the_iterations(make_model, clouds, tries):
    make_model(keep_again=(0.75, 1.0), trusted=2.0)(*clouds)
    assert [count for count, _, _ in tries] == [None, 6, 6]
    assert [keys.points.shape[1] for _, keys, _ in tries] == [20, 30, 40]


def test_every_try_begins_where_the_best_led_and_its_transform_is_the_whole(make_model, clouds, tries):
    source, target = clouds
    model = make_model(keep_again=(0.75, 1.0), trusted=2.0)
    out = model(source, target)
    best = [homogeneous(*x) for x in zip(tries[0][2].rotation, tries[0][2].translation, strict=True)]
    trust = tries[0][2].trust
    for _, keys, step in tries[1:]:
        start = torch.from_numpy(np.stack(best))
        moved = apply_transform(source, start[:, :3, :3], start[:, :3, 3])
        torch.testing.assert_close(keys.points, gather_points(moved, keys.index))
        torch.testing.assert_close(keys.features, gather_points(model.features(moved), keys.index))
        for b in range(2):
            if step.trust[b] > trust[b]:
                best[b] = homogeneous(step.rotation[b], step.translation[b]) @ best[b]
        trust = torch.maximum(trust, step.trust)
    for b in range(2):
        np.testing.assert_allclose(homogeneous(out.rotation[b], out.translation[b]), best[b], atol=1e-9)
    assert torch.equal(out.trust, trust)
    assert torch.equal(out.source.index, tries[0][2].source.index)
    assert out.iterations is tries[0][2].iterations


def test_features_that_do_not_change_with_the_pose_are_tried_from_the_start_too(seasoned, randn, tries):
    source, target = randn(2, 40, 3), randn(2, 50, 3)
    model = seasoned(IDAM(Config(features="fpfh", keep_again=(0.75,), trusted=2.0)))
    model(source, target)
    assert len(tries) == 3  # the first, from the start, and from where the best led
    keys = tries[1][1]
    torch.testing.assert_close(keys.points, gather_points(source, keys.index))


def test_only_pairs_that_are_not_trusted_go_on(make_model, randn, tries):
    source, target = randn(3, 40, 3), randn(3, 50, 3)
    model = make_model(keep_again=(1.0,), trusted=2.0)
    every = model(source, target)
    first = tries[0][2]
    tries.clear()
    model.config = replace(model.config, trusted=float(first.trust.sort().values[1:].mean()))
    out = model(source, target)
    sure = first.trust >= model.config.trusted
    assert 0 < sure.sum() < 3
    assert len(tries[1][1].points) == (~sure).sum()
    for b in range(3):
        expected = first if sure[b] else every
        assert out.trust[b] >= first.trust[b]
        if sure[b] or every.trust[b] == first.trust[b]:
            torch.testing.assert_close(out.rotation[b], expected.rotation[b])


def test_iterations_end_where_no_point_moves_and_not_before_each_block_had_its_own(make_model, randn):
    source = randn(2, 40, 3)
    still = source, source.clone()  # matched to itself, nothing moves
    model = make_model(iterations=3)
    whole = model(*still)
    model.config = replace(model.config, iterations=30)
    ended = model(*still)
    assert [len(out.iterations) for out in (whole, ended)] == [3, 3]
    assert torch.equal(whole.rotation, ended.rotation)
    assert len(model.train().iterate(*(keys for keys in still), *(model.features(x) for x in still))) == 30


@pytest.mark.parametrize("features", ["gnn", "fpfh"])
def test_tries_keep_the_trust_from_falling(features, randn, seasoned):
    source, target = randn(4, 60, 3), randn(4, 70, 3)
    model = seasoned(IDAM(Config(features=features, neighbours=5, channels=8, keep=1 / 2, trusted=2.0)))
    trusts = []
    for keep_again in ((), (0.75,), (0.75, 1.0)):
        model.config = replace(model.config, keep_again=keep_again)
        trusts.append(model(source, target).trust)
    assert (trusts[1] >= trusts[0]).all()
    assert (trusts[2] >= trusts[1]).all()
