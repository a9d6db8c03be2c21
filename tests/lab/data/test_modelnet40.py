"""Reading ModelNet40: hand-made files in its layout, and broken ones."""

import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from idam.errors import InputError, MissingDependencyError
from idam.lab.data.modelnet40 import experiment_shapes, load

ARCHIVE = "modelnet40_ply_hdf5_2048"


def h5py():
    return pytest.importorskip("h5py")


def write(path: Path, **datasets: np.ndarray) -> None:
    with h5py().File(path, "w") as file:
        for name, array in datasets.items():
            file[name] = array


def points(shapes: int, seed: int = 0, count: int = 2048) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((shapes, count, 3)).astype(np.float32)


def labels(*values: int) -> np.ndarray:
    return np.array(values, np.uint8)[:, None]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two training files and one test file, in the public layout."""
    folder = tmp_path / ARCHIVE
    folder.mkdir()
    content = {"train": [labels(0, 19, 20), labels(39, 5)], "test": [labels(19, 20, 3)]}
    for split, files in content.items():
        names = [f"ply_data_{split}{n}.h5" for n in range(len(files))]
        for n, (name, label) in enumerate(zip(names, files, strict=True)):
            write(folder / name, data=points(len(label), seed=n), label=label, normal=points(1))
        (folder / f"{split}_files.txt").write_text("".join(f"data/{ARCHIVE}/{name}\n" for name in names))
    return folder


def test_files_are_read_in_order_and_cut_to_1024_points(folder):
    shapes = load(folder, "train")
    assert len(shapes) == 5
    assert shapes.points.shape == (5, 1024, 3)
    assert shapes.points.dtype == torch.float32
    np.testing.assert_array_equal(shapes.points, np.concatenate([points(3, 0), points(2, 1)])[:, :1024])
    assert shapes.labels.tolist() == [0, 19, 20, 39, 5]
    assert shapes.labels.dtype == torch.int64


def test_the_folder_above_the_archive_will_do(folder):
    assert torch.equal(load(str(folder.parent), "test").points, load(folder, "test").points)


@pytest.mark.parametrize("experiment", ["unseen-shapes", "gaussian-noise"])
@pytest.mark.parametrize("split", ["train", "test"])
def test_unseen_shapes_are_of_all_categories(experiment, split, folder):
    assert torch.equal(experiment_shapes(experiment, folder, split).labels, load(folder, split).labels)


def test_unseen_categories_are_the_last_twenty(folder):
    train = experiment_shapes("unseen-categories", folder, "train")
    assert train.labels.tolist() == [0, 19, 5]
    assert torch.equal(train.points, load(folder, "train").points[[0, 1, 4]])
    assert experiment_shapes("unseen-categories", folder, "test").labels.tolist() == [20]


BROKEN = {
    "no such folder": lambda folder: folder.rename(folder.with_name("elsewhere")),
    "no index": lambda folder: (folder / "train_files.txt").unlink(),
    "an empty index": lambda folder: (folder / "train_files.txt").write_text("\n"),
    "a missing file": lambda folder: (folder / "ply_data_train1.h5").unlink(),
    "a file that is not HDF5": lambda folder: (folder / "ply_data_train1.h5").write_bytes(b"nonsense"),
    "no points": lambda folder: write(folder / "ply_data_train1.h5", label=labels(1)),
    "no labels": lambda folder: write(folder / "ply_data_train1.h5", data=points(1)),
    "fewer labels than shapes": lambda folder: write(folder / "ply_data_train1.h5", data=points(2), label=labels(1)),
    "points of two coordinates": lambda folder: write(
        folder / "ply_data_train1.h5", data=points(1)[..., :2], label=labels(1)
    ),
    "points in a row": lambda folder: write(folder / "ply_data_train1.h5", data=np.zeros(3), label=labels(1)),
    "too few points": lambda folder: write(folder / "ply_data_train1.h5", data=points(1, count=500), label=labels(1)),
}


@pytest.mark.parametrize("spoil", BROKEN.values(), ids=BROKEN)
def test_a_broken_folder_is_refused_in_one_line_that_names_it(spoil, folder):
    spoil(folder)
    with pytest.raises(InputError) as caught:
        load(folder, "train")
    assert str(folder) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_without_h5py_the_pip_command_is_given(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'idam\[train\]'"):
        load(tmp_path, "train")
