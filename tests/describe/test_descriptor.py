"""The learned features: surroundings, and the forward pass against a slow one, in any pose, order, scale and thread."""

import hashlib
import os
import subprocess
import sys

import numpy as np
import pytest

from idam.describe.fpfh import fpfh
from idam.describe.invariant import NEIGHBOURS, STRIDES, Descriptor, Surroundings, pair_features, surroundings
from idam.describe.normals import estimate_normals
from idam.weights import find, load_descriptor, read_weights
from shapes import blob, degenerate_clouds, moved

LENGTH = 8.0
"""About that of the features."""


@pytest.fixture
def cloud() -> np.ndarray:
    return blob(300)


@pytest.fixture
def descriptor() -> Descriptor:
    return load_descriptor("general")


def all_distances(points: np.ndarray) -> np.ndarray:
    distance = np.linalg.norm(points[:, None] - points, axis=-1)
    np.fill_diagonal(distance, np.inf)
    return distance


# surroundings


@pytest.mark.parametrize("own", [True, False])
def test_histograms_are_fpfh_in_spacings(own: bool, cloud: np.ndarray) -> None:
    unit = np.sort(all_distances(cloud).min(1))[149] if own else 0.1
    around = surroundings(cloud, None if own else unit)
    points = (cloud - cloud.mean(0)) / unit
    np.testing.assert_allclose(around.points, points, atol=1e-5)
    normals = estimate_normals(points, radius=2.5, max_neighbours=30)
    np.testing.assert_allclose(around.normals, normals, atol=1e-4)
    expected = fpfh(points, normals, radius=6.0, max_neighbours=100)
    changed = np.abs(around.histograms - expected).max(1) > 1e-2  # a pair on the edge of a bin
    assert changed.mean() < 0.02


def test_each_layer_s_neighbours_are_every_so_many_th_of_the_nearest(cloud: np.ndarray) -> None:
    near = surroundings(cloud).near
    order = all_distances(cloud).argsort(1)
    assert near.shape == (len(STRIDES), NEIGHBOURS, 300)
    for rows, stride in zip(near, (1, 3, 8), strict=True):
        for k in range(16):
            assert np.array_equal(rows[k], order[:, stride * (k + 1) - 1])


@pytest.mark.parametrize("count", [2, 3, 20, 100, 128, 129])
def test_small_clouds_have_the_neighbours_there_are(count: int, cloud: np.ndarray, descriptor: Descriptor) -> None:
    around = surroundings(cloud[:count])
    assert around.near.shape == (len(STRIDES), NEIGHBOURS, count)
    assert (around.near != np.arange(count)).all()
    assert around.near.min() >= 0
    assert around.near.max() < count
    assert np.isfinite(descriptor.describe(around)).all()


def test_copies_of_points_do_not_make_the_spacing(cloud: np.ndarray) -> None:
    before, after = surroundings(cloud), surroundings(np.concatenate([cloud, cloud[:40]]))
    assert after.points[:300].std() == pytest.approx(before.points.std(), rel=0.05)


# the forward pass


def test_pair_features_are_their_formula() -> None:
    rng = np.random.default_rng(0)
    points, normals = rng.standard_normal((2, 10, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points[3] = points[4]
    near = np.stack([rng.permutation(10) for _ in range(6)])
    near[0, 3] = 4
    found = pair_features(points, normals, near)
    assert found.shape == (5, 6, 10)
    for k, neighbours in enumerate(near):
        for i, j in enumerate(neighbours):
            offset, n, m = points[j] - points[i], normals[i], normals[j]
            distance = np.linalg.norm(offset)
            d = offset / distance if distance > 0 else offset
            expected = [distance / 8, n @ d, m @ d, n @ m, np.linalg.det([d, n, m])]
            np.testing.assert_allclose(found[:, k, i], expected, atol=1e-12)


def slow_features(weights: dict[str, np.ndarray], around: Surroundings) -> np.ndarray:
    """The formulas, in float64, with all messages at once."""
    w = {key: value.astype(float) for key, value in weights.items()}

    def linear(name: str, x: np.ndarray) -> np.ndarray:
        return x @ w[f"{name}.weight"].T + w.get(f"{name}.bias", 0.0)

    def norm(name: str, x: np.ndarray) -> np.ndarray:
        x = (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + 1e-5)
        return x * w[f"{name}.weight"] + w[f"{name}.bias"]

    x = norm("norm", linear("first", around.histograms / 20.0)).clip(0)
    for n, near in enumerate(around.near):
        pairs = pair_features(around.points.astype(float), around.normals.astype(float), near)
        layer = f"layers.{n}."
        messages = linear(layer + "other", x)[near] + linear(layer + "pair", pairs.transpose(1, 2, 0))
        gathered = linear(layer + "update", (linear(layer + "own", x) + messages.max(0)).clip(0))
        x = norm(layer + "norm", x + gathered).clip(0)
    x = linear("last", x)
    features: np.ndarray = w["length"] * x / np.linalg.norm(x, axis=1, keepdims=True)
    return features


def test_the_forward_pass_is_its_formula(cloud: np.ndarray) -> None:
    weights = {key.removeprefix("features."): x for key, x in read_weights(find("general"))[1].items()}
    around = surroundings(cloud)
    found = Descriptor(weights).describe(around)
    assert found.dtype == np.float32
    assert found.shape == (300, 32)
    np.testing.assert_allclose(found, slow_features(weights, around), atol=2e-5)


def test_pose_and_scale_hardly_matter(cloud: np.ndarray, descriptor: Descriptor) -> None:
    before, after = (descriptor.describe(surroundings(x)) for x in (cloud, 37 * moved(cloud)))
    changed = np.linalg.norm(after - before, axis=1) > 1e-2 * LENGTH
    assert changed.mean() < 0.05  # a few histograms have a pair on the edge of a bin


def test_permuted_points_give_permuted_features(cloud: np.ndarray, descriptor: Descriptor) -> None:
    order = np.random.default_rng(0).permutation(300)
    before, after = (descriptor.describe(surroundings(x)) for x in (cloud, cloud[order]))
    changed = np.linalg.norm(after - before[order], axis=1) > 1e-2 * LENGTH
    assert changed.mean() < 0.05


def test_a_mirror_image_has_other_features(cloud: np.ndarray, descriptor: Descriptor) -> None:
    before, after = (descriptor.describe(surroundings(x)) for x in (cloud, cloud * (-1, 1, 1)))
    assert np.median(np.linalg.norm(after - before, axis=1)) > 0.01 * LENGTH


def test_points_are_told_apart_by_vectors_of_one_length(cloud: np.ndarray, descriptor: Descriptor) -> None:
    found = descriptor.describe(surroundings(cloud))
    length = np.linalg.norm(found, axis=1)
    np.testing.assert_allclose(length, length[0], rtol=1e-5)
    assert all_distances(found).min() > 1e-4


@pytest.mark.parametrize("name", degenerate_clouds())
def test_degenerate_clouds_have_finite_features(name: str, descriptor: Descriptor) -> None:
    assert np.isfinite(descriptor.describe(surroundings(degenerate_clouds()[name]))).all()


def test_nothing_underflows_to_denormal_numbers(cloud: np.ndarray, descriptor: Descriptor) -> None:
    with np.errstate(under="raise"):  # Intel's processors take 150 cycles for each product with one
        assert np.isfinite(descriptor.describe(surroundings(cloud))).all()


BITS = """
import hashlib
from shapes import blob
from idam.describe.invariant import surroundings
from idam.weights import load_descriptor
digest = hashlib.sha256()
for count in (257, 500, 1025):
    around = surroundings(blob(count))
    for x in (*around, load_descriptor().describe(around)):
        digest.update(x.tobytes())
print(digest.hexdigest())
"""


@pytest.mark.parametrize("kernels", ["", "Haswell"])
def test_the_number_of_threads_changes_no_bit(kernels: str) -> None:
    # on Haswell's kernels, which AMD's processors use too, a whole product rounds otherwise in two threads
    def bits(threads: int) -> str:
        counts = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), str(threads))
        path = os.pathsep.join(sys.path)
        environment = os.environ | counts | {"OPENBLAS_CORETYPE": kernels, "PYTHONPATH": path}
        return subprocess.run(
            [sys.executable, "-c", BITS], env=environment, capture_output=True, text=True, check=True
        ).stdout

    assert len(bits(1)) == len(hashlib.sha256().hexdigest()) + 1
    assert bits(1) == bits(2)
