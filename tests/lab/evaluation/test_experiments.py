"""Test pairs, and anyone's own pairs."""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from idam.errors import InputError
from idam.lab.data.modelnet40 import Shapes
from idam.lab.data.pairs import EXPERIMENTS, Pairs
from idam.lab.evaluation import experiments
from idam.lab.evaluation.experiments import AXISYMMETRIC, TABLES, read_pairs
from idam.lab.training import Recipe
from idam.lab.training.batches import split_validation
from idam.network.geometry import random_rotation


def same(one: Pairs, other: Pairs) -> bool:
    return all(torch.equal(getattr(one, f.name), getattr(other, f.name)) for f in dataclasses.fields(Pairs))


# the experiments' test pairs


@pytest.fixture
def shapes(monkeypatch: pytest.MonkeyPatch, randn) -> Shapes:
    """What every experiment tests on."""
    shapes = Shapes(randn(6, 1024, 3, dtype=torch.float32), torch.arange(6))
    monkeypatch.setattr(experiments, "experiment_shapes", lambda *_: shapes)
    return shapes


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_test_pairs_depend_on_nothing_but_the_shapes(experiment, shapes):
    pairs = experiments.test_set(experiment, "anywhere").pairs
    torch.manual_seed(99)
    assert same(experiments.test_set(experiment, "elsewhere").pairs, pairs)
    assert pairs.source.shape == pairs.target.shape == (6, 768, 3)


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_the_first_test_pairs_are_those_of_the_first_shapes(experiment, shapes, monkeypatch):
    pairs = experiments.test_set(experiment, "anywhere").pairs
    monkeypatch.setattr(experiments, "experiment_shapes", lambda *_: Shapes(shapes.points[:2], shapes.labels[:2]))
    assert same(experiments.test_set(experiment, "anywhere").pairs, pairs[:2])


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_only_the_noise_experiment_tests_with_noise(experiment, shapes):
    pairs = experiments.test_set(experiment, "anywhere").pairs
    for source, points in zip(pairs.source, shapes.points, strict=True):
        exact = (source[:20, None] == points).all(-1).any(-1)
        assert exact.all() == (experiment != "gaussian-noise")


def test_the_test_split_of_the_experiment_is_read(monkeypatch, shapes):
    asked = []
    monkeypatch.setattr(experiments, "experiment_shapes", lambda *args: (asked.append(args), shapes)[1])
    experiments.test_set("unseen-categories", "a folder")
    assert asked == [("unseen-categories", "a folder", "test")]


def test_test_pairs_are_other_ones_than_those_that_pick_the_checkpoint(shapes):
    _, validation = split_validation(Shapes(shapes.points.repeat(10, 1, 1), torch.arange(60)), Recipe())
    test = experiments.test_set("unseen-shapes", "anywhere").pairs
    assert torch.cdist(test.translation, validation.translation).min() > 1e-4


def test_an_unknown_experiment_is_refused_with_the_known_ones(shapes):
    with pytest.raises(InputError, match=r"'seen-shapes'.*unseen-shapes, unseen-categories, gaussian-noise"):
        experiments.test_set("seen-shapes", "anywhere")


@pytest.mark.parametrize("experiment", TABLES)
def test_a_checksum_tells_the_draws_and_the_shapes_apart(experiment, shapes, monkeypatch):
    checksum = experiments.test_set(experiment, "anywhere").checksum
    assert experiments.test_set(experiment, "anywhere").checksum == checksum
    other = shapes.points.clone()
    other[5, 1023, 2] += 1e-3
    for seed, points in ((experiments.TEST_SEED + 1, shapes.points), (experiments.TEST_SEED, other)):
        with monkeypatch.context() as changed:
            changed.setattr(experiments, "TEST_SEED", seed)
            changed.setattr(experiments, "experiment_shapes", lambda *_, p=points: Shapes(p, shapes.labels))
            assert experiments.test_set(experiment, "anywhere").checksum != checksum


def test_the_axisymmetric_categories_are_set_apart(monkeypatch, randn):
    every = Shapes(randn(40, 1024, 3, dtype=torch.float32), torch.arange(40))
    monkeypatch.setattr(experiments, "experiment_shapes", lambda *_: every)
    observable = experiments.test_set("practice", "anywhere").observable
    assert (~observable).nonzero().flatten().tolist() == list(AXISYMMETRIC)
    assert len(AXISYMMETRIC) == 8


def test_the_first_pairs_keep_what_belongs_to_them(shapes):
    test = experiments.test_set("practice", "anywhere")
    first = test.first(2)
    assert same(first.pairs, test.pairs[:2])
    assert (first.name, first.checksum) == (test.name, test.checksum)
    assert torch.equal(first.labels, test.labels[:2])
    assert torch.equal(first.whole, test.whole[:2])
    assert len(first) == 2


# anyone's own pairs


@pytest.fixture
def save(tmp_path: Path, generator) -> Callable[..., Path]:
    """Writes two pairs as .npz, with changes: None leaves an array out."""
    rng = np.random.default_rng(0)
    arrays = {
        "source": rng.standard_normal((2, 20, 3)),
        "target": rng.standard_normal((2, 30, 3)),
        "R": random_rotation(2, generator=generator, dtype=torch.float64).numpy(),
        "t": rng.standard_normal((2, 3)),
    }

    def write(**changes: Any) -> Path:
        path = tmp_path / "pairs.npz"
        np.savez(path, **{key: value for key, value in (arrays | changes).items() if value is not None})
        return path

    return write


@pytest.mark.parametrize("number", [np.float64, np.float32])
@pytest.mark.parametrize("savez", [np.savez, np.savez_compressed])
def test_pairs_are_read_as_they_were_saved(number, savez, save, tmp_path):
    arrays = {key: value.astype(number) for key, value in np.load(save(more=np.zeros(3))).items()}
    savez(tmp_path / "again.npz", **arrays)
    pairs = read_pairs(str(tmp_path / "again.npz")).pairs
    assert len(pairs) == 2
    for n in range(2):
        for key, read in (("source", pairs.source[n]), ("target", pairs.target[n])):
            assert read.dtype == torch.float32
            np.testing.assert_array_equal(read.numpy(), arrays[key][n].astype(np.float32))
    np.testing.assert_array_equal(pairs.rotation.numpy(), arrays["R"].astype(np.float64))
    np.testing.assert_allclose(pairs.translation.numpy(), arrays["t"], rtol=1e-12)


def in_object_array(clouds: list[np.ndarray]) -> np.ndarray:
    array = np.empty(len(clouds), object)
    array[:] = clouds
    return array


def test_pairs_of_unequal_size_are_read_from_object_arrays(save):
    rng = np.random.default_rng(1)
    source, target = ([rng.standard_normal((size, 3)) for size in sizes] for sizes in ((5, 9), (7, 4)))
    path = save(source=in_object_array(source), target=in_object_array(target))
    pairs = read_pairs(path).pairs
    for clouds, read in ((source, pairs.source), (target, pairs.target)):
        for cloud, tensor in zip(clouds, read, strict=True):
            np.testing.assert_array_equal(tensor.numpy(), cloud.astype(np.float32))


class RunsCode:
    def __reduce__(self):
        return Path.touch, (Path("touched"),)


def test_an_object_array_that_would_run_code_is_refused(save, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="not arrays alone"):
        read_pairs(save(source=in_object_array([RunsCode(), RunsCode()])))
    assert not Path("touched").exists()


@pytest.fixture
def surveyed(generator) -> dict[str, np.ndarray]:
    """Two copies of a cloud 20 m wide in UTM coordinates, rotated about the origin of these."""
    rng = np.random.default_rng(2)
    source = rng.uniform(-10, 10, (2, 30, 3)) + np.array([448_262.0, 5_411_932.0, 112.0])
    rotation = random_rotation(2, generator=generator, dtype=torch.float64).numpy()
    translation = rng.uniform(-1, 1, (2, 3)) * 1e6
    target = np.einsum("nij,npj->npi", rotation, source) + translation[:, None]
    return {"source": source, "target": target, "R": rotation, "t": translation}


def test_clouds_far_off_the_origin_lose_no_digits(save, surveyed):
    pairs = read_pairs(save(**surveyed)).pairs
    for n in range(2):
        moved = pairs.source[n].double() @ pairs.rotation[n].T + pairs.translation[n]
        assert (moved - pairs.target[n].double()).abs().max() < 1e-5
        shape = surveyed["source"][n] - surveyed["source"][n].mean(0)
        np.testing.assert_allclose(pairs.source[n].numpy(), shape, atol=1e-5)


@pytest.fixture
def listed(tmp_path, surveyed) -> Callable[..., Path]:
    """Writes two pairs of unequal clouds as files and a JSON list of them, with changes to the first record."""

    def write(success: Any = None, bare: bool = False, **changes: Any) -> Path:
        records = []
        for n in range(2):
            truth = np.eye(4)
            truth[:3, :3], truth[:3, 3] = surveyed["R"][n], surveyed["t"][n]
            for side, count in (("source", 30 - n), ("target", 20 + n)):
                np.save(tmp_path / f"{side}{n}.npy", surveyed[side][n, :count])
            records.append({"source": f"source{n}.npy", "target": f"target{n}.npy", "transformation": truth.tolist()})
        records[0] |= changes
        content = records if bare else {"pairs": records, **({"success": success} if success else {})}
        (tmp_path / "pairs.json").write_text(json.dumps(content))
        return tmp_path / "pairs.json"

    return write


@pytest.mark.parametrize("bare", [False, True])
def test_a_list_of_files_is_read_with_every_cloud_about_its_centroid(bare, listed, surveyed):
    test = read_pairs(listed(bare=bare))
    assert [len(cloud) for cloud in test.pairs.source] == [30, 29]
    assert [len(cloud) for cloud in test.pairs.target] == [20, 21]
    assert test.within == (5.0, 0.05)
    for n in range(2):
        assert test.pairs.source[n].mean(0).abs().max() < 1e-5
        moved = test.pairs.source[n].double() @ test.pairs.rotation[n].T + test.pairs.translation[n]
        assert (moved[: len(test.pairs.target[n])][:20] - test.pairs.target[n].double()[:20]).abs().max() < 1e-5


def test_bounds_are_the_caller_s_or_the_file_s(listed):
    path = listed(success={"rotation_deg": 2, "centroid_shift": 0.3})
    assert read_pairs(path).within == (2, 0.3)
    assert read_pairs(path, (1.0, 0.1)).within == (1, 0.1)
    for bad in ((0.0, 1.0), (1.0, float("nan"))):
        with pytest.raises(InputError, match="positive"):
            read_pairs(path, bad)


BAD_LISTS = {
    "no transformation": ({"transformation": None}, "transformation of pair 1"),
    "a reflection": ({"transformation": np.diag([1, 1, -1, 1]).tolist()}, "transformation of pair 1: it mirrors"),
    "a missing file": ({"source": "nowhere.ply"}, r"nowhere\.ply"),
    "no name": ({"source": 3}, "3"),
}


@pytest.mark.parametrize(("changes", "message"), BAD_LISTS.values(), ids=BAD_LISTS)
def test_lists_of_another_form_are_refused_in_one_line(changes, message, listed):
    with pytest.raises(InputError, match=message) as caught:
        read_pairs(listed(**changes))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"pairs": 3}', '[{"source": "a.ply"}]', "[1]", "null"])
def test_json_that_lists_no_pairs_is_refused_in_one_line(text, tmp_path):
    (tmp_path / "pairs.json").write_text(text)
    with pytest.raises(InputError, match=r"pairs\.json: (is no list of pairs|lists no pairs)") as caught:
        read_pairs(tmp_path / "pairs.json")
    assert "\n" not in str(caught.value)


BAD_ARRAYS = {
    **{f"no {key}": ({key: None}, key) for key in ("source", "target", "R", "t")},
    "one cloud": ({"source": np.zeros((20, 3))}, r"source has shape \(20, 3\)"),
    "clouds of two coordinates": ({"source": np.zeros((2, 20, 2))}, r"source has shape \(2, 20, 2\)"),
    "targets of four coordinates": ({"target": np.zeros((2, 20, 4))}, r"target has shape \(2, 20, 4\)"),
    "more sources": ({"source": np.zeros((3, 20, 3))}, r"target has shape \(2, 30, 3\)"),
    "4x4": ({"R": np.stack([np.eye(4)] * 2)}, r"R has shape \(2, 4, 4\)"),
    "one rotation": ({"R": np.eye(3)}, r"R has shape \(3, 3\)"),
    "columns of t": ({"t": np.zeros((2, 3, 1))}, r"t has shape \(2, 3, 1\)"),
    "numbers without axes": ({"t": np.array(3.0)}, r"t has shape \(\)"),
    "no pairs": ({"source": np.zeros((0, 20, 3))}, "shape"),
    "no points": ({"source": np.zeros((2, 0, 3))}, "3 points"),
    "too few points for a rotation": ({"target": np.zeros((2, 2, 3))}, "3 points"),
    "not a number": ({"source": np.full((2, 20, 3), np.nan)}, "source holds NaN"),
    "infinity": ({"t": np.array([[0, 0, 0], [0, np.inf, 0]])}, "t holds NaN or infinite"),
    "beyond single precision": ({"t": np.full((2, 3), 1e300)}, "t holds NaN or infinite"),
    "scaled rotations": ({"R": np.stack([2 * np.eye(3)] * 2)}, "no rotations"),
    "reflections": ({"R": np.stack([-np.eye(3)] * 2)}, "no rotations"),
    "words": ({"t": np.array(["one", "two"])}, "cannot be read"),
    "objects": ({"t": np.array([None, 1], dtype=object)}, "cannot be read"),
}


@pytest.mark.parametrize(("changes", "message"), BAD_ARRAYS.values(), ids=BAD_ARRAYS)
def test_pairs_of_another_form_are_refused_in_one_line(changes, message, save):
    path = save(**changes)
    with pytest.raises(InputError, match=message) as caught:
        read_pairs(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[400] ^= 0xFF  # in the first array
    path.write_bytes(data)


def as_npy(path: Path) -> None:
    with path.open("wb") as file:
        np.save(file, np.zeros((2, 3)))


def as_folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


BAD_FILES = {
    "missing": lambda path: path.unlink(),
    "a folder": as_folder,
    "empty": lambda path: path.write_bytes(b""),
    "text": lambda path: path.write_text("0 0 0\n"),
    "one array": as_npy,
    "cut short": lambda path: path.write_bytes(path.read_bytes()[:-200]),
    "damaged": flip,
}


@pytest.mark.parametrize("spoil", BAD_FILES.values(), ids=BAD_FILES)
def test_a_file_that_holds_no_pairs_is_refused_in_one_line(spoil, save):
    path = save()
    spoil(path)
    with pytest.raises(InputError, match=r"pairs\.npz: ") as caught:
        read_pairs(path)
    assert "\n" not in str(caught.value)
