"""The ablation's stand-ins, and a network made of them."""

import pytest
import torch

from idam.lab.data.pairs import make_pairs
from idam.network.ablation import EqualValidity, InnerProduct, RandomSignificance
from idam.network.config import Config
from idam.network.geometry import weighted_procrustes
from idam.network.model import IDAM

WITHOUT = ("convolution", "hard_elimination", "hybrid_elimination")


def test_the_score_is_the_inner_product_of_the_features_alone(randn, close):
    source_features, target_features = randn(2, 5, 16), randn(2, 7, 16)
    maximum, score = InnerProduct(8)(randn(2, 5, 3), randn(2, 7, 3), source_features, target_features)
    for b, i, j in ((0, 0, 0), (1, 4, 6), (0, 2, 5)):
        close(score[b, i, j], (source_features[b, i] * target_features[b, j]).sum() / 4)
    assert maximum.shape == (2, 5, 8)


def test_the_random_choice_ignores_the_features_and_stays_the_same(randn):
    scores = [RandomSignificance()(randn(2, 50, 8)) for _ in range(2)]
    assert torch.equal(*scores)
    assert scores[0].unique().numel() == 100


def test_equal_validity_solves_an_unweighted_procrustes(randn, seasoned, close):
    model = seasoned(IDAM(Config(neighbours=5, channels=8, keep=1 / 2, hybrid_elimination=False)))
    assert torch.equal(EqualValidity()(randn(2, 5, 8)), torch.zeros(2, 5, dtype=torch.float64))
    step = model(randn(1, 40, 3), randn(1, 50, 3)).iterations[0]
    close(step.weight, torch.full((1, 20), 1 / 20, dtype=torch.float64))
    rotation, translation = weighted_procrustes(step.source, step.match, torch.ones_like(step.weight))
    close(step.rotation, rotation)
    close(step.translation, translation)


@pytest.mark.parametrize("part", WITHOUT)
def test_a_network_without_a_part_has_none_of_its_weights_and_still_registers(part, randn, generator):
    whole, ablated = IDAM(Config()), IDAM(Config(**{part: False})).eval()
    names = {"convolution": "similarity", "hard_elimination": "significance", "hybrid_elimination": "validity"}
    missing = {name for name in whole.state_dict() if name.startswith(names[part])}
    assert whole.state_dict().keys() - ablated.state_dict().keys() == missing != set()
    pairs = make_pairs(randn(2, 200, 3, dtype=torch.float32), generator)
    output = ablated(pairs.source, pairs.target)
    assert output.rotation.isfinite().all()
    assert output.source.index.shape == (2, 34)


def test_without_all_parts_only_the_features_learn():
    model = IDAM(Config(**dict.fromkeys(WITHOUT, False)))
    assert {name.split(".")[0] for name, _ in model.named_parameters()} == {"features"}
