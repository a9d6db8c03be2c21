"""The learned rivals: shapes and gradients, their parts against other ways to the same, learning, weights, training."""

import importlib
import math
from collections.abc import Callable
from itertools import count, pairwise
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch
from benchmarks.rivals import prnet
from benchmarks.rivals.attention import Attention
from benchmarks.rivals.dcp import DCP
from benchmarks.rivals.dgcnn import DGCNN, EdgeConv, largest_neighbour
from benchmarks.rivals.features import FeatureConfig, Features, procrustes
from benchmarks.rivals.methods import RIVALS, load_rival
from benchmarks.rivals.pointnetlk import Config as LKConfig
from benchmarks.rivals.pointnetlk import PointNetLK, pseudo_inverse
from benchmarks.rivals.prnet import Config, PRNet, keypoints, straight_through
from benchmarks.rivals.rival import Rival
from benchmarks.rivals.twist import twist_to_transform
from torch import Tensor

from idam.errors import InputError
from idam.lab.data import pairs as protocol
from idam.lab.data.pairs import Pairs, make_pairs
from idam.lab.evaluation.evaluate import evaluate
from idam.lab.evaluation.experiments import TestSet
from idam.lab.evaluation.methods import build_method
from idam.lab.evaluation.paper import PAPER
from idam.lab.evaluation.table import columns
from idam.network.features.gnn import neighbour_graph
from idam.network.geometry import apply_transform, compose, invert, rotation_angle, weighted_procrustes
from idam.network.pretrained import save_weights
from idam.weights import provenance

SIZES = {"neighbours": 8, "widths": (16, 32), "heads": 2, "feed_forward": 32}
SMALL: dict[str, Callable[[], Rival]] = {
    "pointnetlk": lambda: PointNetLK(LKConfig(widths=(16, 32, 64), iterations=4)),
    "dcp": lambda: DCP(FeatureConfig(**SIZES)),
    "prnet": lambda: PRNet(Config(**SIZES, keypoints=48, iterations=2)),
}
METHOD = {name: f"benchmarks.rivals.methods:{name}" for name in RIVALS}
each_rival = pytest.mark.parametrize("name", RIVALS)


@pytest.fixture
def shapes(generator) -> Tensor:
    """Bent sheets of 96 points in the unit sphere, no two alike."""
    u, v = (torch.rand(16, 96, 2, generator=generator) * 2 - 1).unbind(-1)
    bend = torch.randn(3, 16, 1, generator=generator)
    points = torch.stack([u, 0.6 * v, bend[0] * u**2 + bend[1] * u * v**2 + bend[2] * torch.sin(2 * v)], -1)
    points -= points.mean(1, keepdim=True)
    return points / points.norm(dim=-1).amax(1)[:, None, None]


@pytest.fixture
def pairs(shapes, generator, monkeypatch) -> Pairs:
    """16 pairs of 72 of these points."""
    monkeypatch.setattr(protocol, "CROPPED_POINTS", 72)
    return make_pairs(shapes, generator)


# the networks


def test_the_defaults_are_the_papers_sizes():
    assert LKConfig() == LKConfig((64, 64, 64, 128, 1024), 10, 1e-2, 1e-7)
    assert FeatureConfig() == FeatureConfig(20, (64, 64, 128, 256, 512), 4, 1024)
    assert Config() == Config(20, (64, 64, 128, 256, 512), 4, 1024, 512, 3)
    assert (prnet.DISCOUNT, DCP.learning_rate, DCP.weight_decay) == (0.9, 1e-3, 1e-4)


@each_rival
def test_a_rival_answers_with_a_transform_for_clouds_of_different_sizes(name, randn, assert_rotations):
    network = SMALL[name]().eval()
    rotation, translation = network(randn(2, 40, 3).float(), randn(2, 52, 3).float())
    assert (rotation.shape, translation.shape) == ((2, 3, 3), (2, 3))
    assert_rotations(rotation)


@each_rival
def test_every_parameter_gets_a_gradient(name, pairs):
    network = SMALL[name]()
    network.loss(pairs).total.backward()
    without = [key for key, value in network.named_parameters() if value.grad is None or not value.grad.any()]
    assert without == []
    assert all(value.grad.isfinite().all() for value in network.parameters())


@each_rival
def test_a_pair_s_answer_does_not_depend_on_its_batch(name, pairs):
    network = SMALL[name]().eval()
    together = network(pairs.source[:3], pairs.target[:3])
    alone = network(pairs.source[1:2], pairs.target[1:2])
    for one, other in zip(together, alone, strict=True):
        torch.testing.assert_close(one[1:2], other, rtol=1e-3, atol=1e-3)


@each_rival
def test_a_rival_learns(name, pairs, one_thread):
    network, pairs = SMALL[name](), pairs[:8]
    optimizer = torch.optim.Adam(network.parameters(), 3e-3)
    losses = []
    for _ in range({"pointnetlk": 60, "dcp": 60, "prnet": 50}[name]):
        loss = network.loss(pairs).total
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        losses.append(loss.item())
    with torch.no_grad():
        rotation, _ = network.eval()(pairs.source, pairs.target)
    assert np.mean(losses[-10:]) < 0.6 * np.mean(losses[:5])
    assert rotation_angle(pairs.rotation @ rotation.mT).mean() < 0.7 * rotation_angle(pairs.rotation).mean()


# their parts


@pytest.fixture
def edge_conv(randn) -> tuple[EdgeConv, Tensor, Tensor]:
    """A layer in evaluation, its input and a graph."""
    layer = EdgeConv(3, 5).double().eval()
    points = randn(2, 12, 3)
    return layer, points.flatten(0, 1), neighbour_graph(points, 4)


def test_an_edge_convolution_is_the_largest_over_the_edges(edge_conv, close):
    layer, x, graph = edge_conv
    edges = layer.centre(x) + layer.difference(x[graph] - x)
    close(layer(x, graph), torch.relu(layer.norm(edges.flatten(0, 1))).view_as(edges).amax(0))


def test_the_largest_neighbour_has_the_gradient_of_a_maximum(edge_conv, randn):
    _, _, graph = edge_conv
    h = randn(24, 5, requires_grad=True)
    assert torch.autograd.gradcheck(lambda h: largest_neighbour(h, graph), h)
    assert torch.equal(largest_neighbour(h, graph), h[graph].amax(0))


def test_a_rigid_move_leaves_the_graph_as_it_is(randn, assert_rotations):
    dgcnn, points = DGCNN(5, (4, 4)), randn(2, 30, 3)
    move = twist_to_transform(randn(2, 6))
    assert torch.equal(dgcnn.graph(points), dgcnn.graph(apply_transform(points, *move)))


def test_attention_is_a_mean_of_the_values_by_the_softmax_of_products(randn, close):
    layer, x, memory = Attention(6, 2).double(), randn(1, 4, 6), randn(1, 5, 6)
    heads = [slice(0, 3), slice(3, 6)]
    q, k, v = layer.query(x), layer.key(memory), layer.value(memory)
    gathered = [torch.softmax(q[..., h] @ k[..., h].mT / math.sqrt(3), -1) @ v[..., h] for h in heads]
    close(layer(x, memory), layer.output(torch.cat(gathered, -1)))


def test_bfloat16_changes_the_features_a_little_and_not_their_type(pairs):
    features = Features(FeatureConfig(**SIZES)).eval()
    graphs = features.graphs(pairs.source, pairs.target)
    exact, _ = features(pairs.source, pairs.target, graphs)
    features.autocast = True
    rounded, _ = features(pairs.source, pairs.target, graphs)
    assert rounded.dtype == torch.float32
    assert 0 < (rounded - exact).norm() < 0.02 * exact.norm()


def test_the_svd_head_is_procrustes_on_the_matches(randn, close):
    points, target = randn(2, 7, 3), randn(2, 9, 3)
    matching = randn(2, 7, 9).softmax(-1)
    expected = weighted_procrustes(points, torch.einsum("bij,bjk->bik", matching, target), torch.ones(2, 7).double())
    for one, other in zip(procrustes(points, matching, target), expected, strict=True):
        close(one, other)


def test_right_matches_give_the_right_transform(randn, close):
    points, truth = randn(2, 9, 3), twist_to_transform(randn(2, 6))
    order = torch.randperm(9)
    found = procrustes(points, torch.eye(9).double()[order].T, apply_transform(points, *truth)[:, order])
    for one, other in zip(found, truth, strict=True):
        close(one, other)


# PointNetLK


def test_twists_are_turned_into_transforms(randn, assert_rotations, close):
    twist = randn(5, 6)
    rotation, translation = twist_to_transform(twist)
    assert_rotations(rotation)
    close(rotation_angle(rotation), twist[:, :3].norm(dim=-1).remainder(2 * math.pi).rad2deg())
    for one, other in zip(twist_to_transform(-twist), invert(rotation, translation), strict=True):
        close(one, other)
    shift = torch.cat([torch.zeros(5, 3).double(), twist[:, 3:]], 1)
    close(twist_to_transform(shift)[1], twist[:, 3:])


def test_the_finite_differences_are_the_derivative(randn, close):
    network = PointNetLK(LKConfig(widths=(8, 16), step=1e-6)).double()
    template = randn(1, 20, 3)

    def feature(twist: Tensor) -> Tensor:
        return network.features(apply_transform(template, *twist_to_transform(-twist[None])))[0]

    exact = torch.autograd.functional.jacobian(feature, torch.zeros(6).double())
    close(network.jacobian(template, network.features(template))[0], exact, rtol=1e-4, atol=1e-5)


def test_the_feature_is_the_maximum_over_points_and_has_its_gradient(randn, close, same_gradients):
    network = PointNetLK(LKConfig(widths=(8, 16))).double().features
    points = randn(3, 20, 3)
    direct = points
    for layer in (*network.shared, network.last):
        direct = layer(direct)
    close(network(points), direct.amax(1))
    same_gradients(network, network(points), direct.amax(1))


def test_observing_clouds_is_all_that_changes_the_statistics(randn, close):
    network = PointNetLK(LKConfig(widths=(8,))).double().train()
    points, norm = randn(4, 20, 3), network.features.last.norm
    network(points, points)
    close(norm.running_mean, torch.zeros(8).double())
    network.features.observe(points)
    close(norm.running_mean, 0.1 * network.features.last.linear(points).mean((0, 1)))


def test_the_pseudo_inverse_is_left_inverse_and_stands_dead_features(randn, close):
    jacobian = randn(2, 20, 6)
    close(pseudo_inverse(jacobian) @ jacobian, torch.eye(6).double().expand(2, 6, 6), atol=1e-5)
    assert not pseudo_inverse(torch.zeros(1, 20, 6)).any()


# PRNet


def test_keypoints_are_those_of_largest_norm(randn):
    features = randn(2, 30, 4)
    kept = keypoints(features, 10)
    for rows, cloud in zip(kept, features.norm(dim=-1), strict=True):
        assert cloud[rows].min() >= np.delete(cloud.numpy(), rows).max()
    assert keypoints(features, 50).shape == (2, 30)


@pytest.mark.parametrize("noisy", [True, False])
def test_matches_are_one_hot_with_the_gradient_of_a_softmax(noisy, randn, close):
    scores, temperature = randn(2, 5, 7, requires_grad=True), torch.full((2, 1, 1), 0.5, dtype=torch.float64)
    matches = straight_through(scores, temperature, noisy=noisy)
    assert ((matches == 0) | (matches == 1)).all()
    assert (matches.sum(-1) == 1).all()
    if not noisy:
        assert torch.equal(matches.argmax(-1), scores.argmax(-1))
        direction = randn(2, 5, 7)
        soft = torch.autograd.grad((scores / temperature).softmax(-1), scores, direction)
        close(torch.autograd.grad(matches, scores, direction)[0], soft[0])


def test_noise_samples_matches_by_their_softmax():
    scores = torch.tensor([0.2, 0.5, 0.3]).log().expand(1, 20_000, 3)
    matches = straight_through(scores, torch.ones(1, 1, 1), noisy=True)
    torch.testing.assert_close(matches.mean((0, 1)), torch.tensor([0.2, 0.5, 0.3]), rtol=0.05, atol=0)


def test_each_iteration_is_against_the_motion_that_is_left(pairs, monkeypatch):
    network, seen = PRNet(Config(**SIZES, keypoints=48, iterations=3)), []
    match, iteration_loss = network.match, prnet.iteration_loss
    monkeypatch.setattr(network, "match", lambda source, *rest: (seen.append(source), match(source, *rest))[1])

    def checked(matching, rotation, translation):
        left = apply_transform(seen[-1], rotation, translation)
        torch.testing.assert_close(
            left, apply_transform(pairs.source, pairs.rotation, pairs.translation), rtol=1e-4, atol=1e-4
        )
        return iteration_loss(matching, rotation, translation)

    monkeypatch.setattr(prnet, "iteration_loss", checked)
    network.loss(pairs)
    assert len(seen) == 3


def test_iterations_add_up(pairs, close):
    network = PRNet(Config(**SIZES, keypoints=48, iterations=2)).eval()
    graphs = network.features.graphs(pairs.source, pairs.target)
    first = network.match(pairs.source, pairs.target, graphs).estimate
    second = network.match(apply_transform(pairs.source, *first), pairs.target, graphs).estimate
    for one, other in zip(network(pairs.source, pairs.target), compose(*second, *first), strict=True):
        close(one, other)


# as methods of the evaluation


@pytest.fixture
def weights(tmp_path) -> Callable[[str], Path]:
    """Saves a small rival."""

    def save(name: str) -> Path:
        network = SMALL[name]()
        save_weights(tmp_path / f"{name}.safetensors", network, network.config, {})
        return tmp_path / f"{name}.safetensors"

    return save


@each_rival
def test_a_rival_is_a_row_of_the_evaluation(name, weights, pairs):
    path = weights(name)
    (row,) = evaluate(TestSet("gaussian-noise", pairs[:2], "1"), [f"benchmarks.rivals.methods:{name}"], model=str(path))
    assert (row.task.model, row.pairs) == (str(path), 2)
    assert columns("gaussian-noise")["method"](row) == f"{name} ({path})"
    paper = PAPER["gaussian-noise"][name]
    assert columns("gaussian-noise")["RMSE(R)"](row).endswith(f"({paper[0]:g})")


def test_its_answer_is_the_network_s(weights, pairs):
    path = weights("dcp")
    network = load_rival("dcp", str(path))
    found = build_method(METHOD["dcp"], str(path))(pairs.source[0].numpy(), pairs.target[0].numpy())
    rotation, translation = network(pairs.source[:1], pairs.target[:1])
    np.testing.assert_allclose(found[:3, :3], rotation[0], atol=1e-6)
    np.testing.assert_allclose(found[:3, 3], translation[0], atol=1e-6)


@each_rival
@pytest.mark.parametrize("model", [None, "missing.safetensors"])
def test_without_weights_the_command_that_trains_them_is_named(name, model):
    with pytest.raises(InputError, match=rf"rivals\.train {name} ") as caught:
        build_method(METHOD[name], model)(*np.zeros((2, 40, 3), np.float32))
    assert "\n" not in str(caught.value)


def test_weights_of_another_rival_are_refused(weights):
    with pytest.raises(InputError, match="not a model of prnet"):
        load_rival("prnet", str(weights("dcp")))


# training


@pytest.fixture
def trainer() -> ModuleType:
    """benchmarks/rivals/train.py."""
    pytest.importorskip("tensorboard", reason="training needs TensorBoard")
    return importlib.import_module("benchmarks.rivals.train")


@pytest.fixture
def data(tmp_path) -> Path:
    """ModelNet40 of 22 boxes."""
    h5py = pytest.importorskip("h5py", reason="ModelNet40 is read with h5py")
    folder, rng = tmp_path / "data", np.random.default_rng(0)
    folder.mkdir()
    points = rng.uniform(-1, 1, (22, 1024, 3)) * rng.uniform(0.3, 1, (22, 1, 3))
    with h5py.File(folder / "train0.h5", "w") as file:
        file["data"] = points.astype(np.float32)
        file["label"] = np.arange(22, dtype=np.uint8)[:, None]
    (folder / "train_files.txt").write_text("train0.h5\n")
    return folder


@pytest.fixture
def fit(trainer, data, tmp_path, monkeypatch) -> Callable[..., Path]:
    """Trains small rivals on clouds of 72 points from the command line."""
    monkeypatch.setattr(trainer, "keep_freed_memory", lambda: True)  # it would hold for all tests after this one
    monkeypatch.setattr(trainer, "RIVALS", SMALL)
    monkeypatch.setattr(protocol, "CROPPED_POINTS", 72)

    def run(*words: object, output: str = "out") -> Path:
        fixed = ["unseen-shapes", "--data", data, "--output", tmp_path / output, "--batch-size", 4, "--device", "cpu"]
        trainer.main([str(word) for word in (words[0], *fixed, *words[1:])])
        return tmp_path / output

    return run


@each_rival
def test_a_training_leaves_weights_that_tell_how_they_came_about(name, fit):
    output = fit(name, "--epochs", 0.6, "--seed", 3)
    told = provenance(output / "best.safetensors")
    assert told["experiment"] == "unseen-shapes"
    assert told["recipe"] == {
        "method": name, "experiment": "unseen-shapes", "batch_size": 4, "precision": "32", "thin": False, "seed": 3
    }  # fmt: skip
    assert told["steps"] == 3
    assert told["command"].startswith(f"python -m benchmarks.rivals.train {name} unseen-shapes --data")
    assert told["validation"]["mae_r"] > 0
    clouds = np.random.default_rng(0).random((2, 40, 3), np.float32)
    assert build_method(METHOD[name], str(output / "best.safetensors"))(*clouds).shape == (4, 4)


def test_a_resumed_training_ends_with_the_same_bits(fit, trainer, monkeypatch):
    whole = fit("prnet", "--epochs", 1, "--validate-every", 2, output="whole")
    step = trainer.Training.step

    def stopped(self, *rest):
        if self.progress.step == 3:
            raise KeyboardInterrupt
        step(self, *rest)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(trainer.Training, "step", stopped)
        fit("prnet", "--epochs", 1, "--validate-every", 2)
    parts = fit("prnet", "--epochs", 1, "--validate-every", 2, "--resume")
    one, other = (torch.load(folder / "last.ckpt")["model"] for folder in (whole, parts))
    assert all(torch.equal(one[key], other[key]) for key in one)


def test_minutes_count_over_resumptions_and_rates_fall_with_them(fit, trainer, monkeypatch):
    # a clock of its own: however busy the machine, a step takes a tenth of a second
    clock = count(0.0, 0.1)
    monkeypatch.setattr(trainer, "time", SimpleNamespace(monotonic=lambda: next(clock)))
    output = fit("dcp", "--minutes", 0.01)
    state = torch.load(output / "last.ckpt")
    assert state["progress"]["seconds"] >= 0.6
    assert state["optimizer"]["param_groups"][0]["lr"] < 1e-3
    fit("dcp", "--minutes", 0.01, "--resume")
    assert torch.load(output / "last.ckpt")["progress"] == state["progress"]
    rates = [trainer.rate(SMALL["dcp"](), share) for share in (0, 0.02, 0.29, 0.31, 0.61, 0.81)]
    assert [high / low for high, low in pairwise(rates)] == pytest.approx([0.1, 1, 10, 10, 10])


def test_a_training_may_begin_with_a_third_of_the_points(fit, trainer, monkeypatch):
    seen, loss = [], DCP.loss
    monkeypatch.setattr(DCP, "loss", lambda self, pairs: (seen.append(pairs.source.shape[1]), loss(self, pairs))[1])
    fit("dcp", "--epochs", 2, "--thin")
    assert seen == [24] * 3 + [72] * 7


def test_thinned_pairs_are_some_of_their_points(trainer, pairs, generator):
    some = trainer.thinned(pairs, generator)
    assert some.source.shape == (16, 24, 3)
    for one, whole in zip(some.source, pairs.source, strict=True):
        assert len({tuple(point) for point in one.tolist()} & {tuple(point) for point in whole.tolist()}) == 24
    assert torch.equal(some.rotation, pairs.rotation)


def test_all_nine_are_trained_in_one_go_and_go_on(data, tmp_path, monkeypatch, trainer, capsys):
    script = importlib.import_module("benchmarks.rivals.train_all")
    for module in (trainer, script):
        monkeypatch.setattr(module, "RIVALS", SMALL)
    monkeypatch.setattr(trainer, "keep_freed_memory", lambda: True)  # it would hold for all tests after this one
    monkeypatch.setattr(protocol, "CROPPED_POINTS", 72)
    clock = count(0.0, 0.1)
    monkeypatch.setattr(trainer, "time", SimpleNamespace(monotonic=lambda: next(clock)))
    words = [tmp_path / "all", "--data", data, "--times", 0.003, "--batch-size", 4, "--device", "cpu"]
    script.main(list(map(str, words)))
    files = sorted((tmp_path / "all").glob("*.safetensors"))
    assert len(files) == 9
    told = {path.stem: provenance(path) for path in files}
    assert all(name == f"{one['recipe']['method']}-{one['experiment']}" for name, one in told.items())
    assert told["prnet-gaussian-noise"]["steps"] > told["pointnetlk-gaussian-noise"]["steps"]
    script.main(list(map(str, words)))  # goes on, and finds nothing left to do
    assert {path.stem: provenance(path) for path in files} == told


def test_what_cannot_be_trained_is_refused(fit, capsys):
    fit("dcp", "--epochs", 0.2)
    for words, message in (
        (("dcp", "--epochs", 0.2, "--resume", "--seed", 1), "other options"),
        (("pointnetlk", "--epochs", 1, "--precision", "bf16"), "bfloat16"),
        (("dcp", "--epochs", 0), "--epochs"),
    ):
        with pytest.raises(SystemExit):
            fit(*words)
        assert message in capsys.readouterr().err
