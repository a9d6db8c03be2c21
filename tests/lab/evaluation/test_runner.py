"""Methods run over pairs: what is measured, timed, and shared between processes."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from idam.errors import InputError
from idam.lab.data.pairs import Pairs, make_pairs
from idam.lab.evaluation import runner
from idam.lab.evaluation.experiments import TestSet
from idam.lab.evaluation.metrics import Metrics, measure, modified_chamfer
from idam.lab.evaluation.runner import Row, Task, run


@pytest.fixture
def pairs(randn, generator) -> Pairs:
    return make_pairs(randn(5, 40, 3, dtype=torch.float32), generator)


@pytest.fixture
def test(pairs: Pairs) -> TestSet:
    return TestSet("five pairs", pairs, "1234")


@pytest.fixture
def given(monkeypatch):
    """Lets a function stand for every method."""

    def stand_in(method):
        monkeypatch.setattr(runner, "build_method", lambda *_: method)
        return Task("stand-in")

    return stand_in


def ignore() -> None:
    pass


def identity(*_: np.ndarray) -> np.ndarray:
    return np.eye(4)


def test_a_method_that_knows_the_truth_makes_no_error(pairs, test, given):
    seen = []

    def know(source: np.ndarray, target: np.ndarray) -> np.ndarray:
        transformation = np.eye(4)
        transformation[:3, :3], transformation[:3, 3] = pairs.rotation[len(seen)], pairs.translation[len(seen)]
        seen.append((source, target))
        return transformation

    row = run(given(know), test, ignore)
    assert row.metrics == Metrics(0, 0, 0, 0, 1, 0, 0)
    assert (row.task, row.pairs) == (Task("stand-in"), 5)
    for n, clouds in enumerate(seen):  # each pair by itself, as a user has them
        for cloud, expected in zip(clouds, (pairs.source, pairs.target), strict=True):
            assert cloud.dtype == np.float32
            np.testing.assert_array_equal(cloud, expected[n])


def test_a_method_that_does_nothing_errs_by_the_transforms(pairs, test, given):
    row = run(given(identity), test, ignore)
    nothing = torch.eye(3).expand(5, 3, 3), torch.zeros(5, 3)
    assert row.metrics == measure(*nothing, pairs.rotation, pairs.translation)
    assert row.metrics.recall < 1


def test_known_shapes_are_measured_with_and_without_axes_and_by_their_surface(pairs, given, randn):
    whole = randn(5, 40, 3, dtype=torch.float32)
    labels = torch.tensor([0, 5, 1, 6, 2])  # the second and fourth are axisymmetric
    row = run(given(identity), TestSet("practice", pairs, "1234", labels, whole), ignore)
    nothing = torch.eye(3).expand(5, 3, 3), torch.zeros(5, 3)
    seen = [0, 2, 4]
    assert row.observable == measure(*(part[seen] for part in (*nothing, pairs.rotation, pairs.translation)))
    assert row.observable != row.metrics
    assert row.chamfer == pytest.approx(modified_chamfer(pairs, whole, *nothing), rel=1e-6)


def test_symmetric_poses_are_counted_on_pairs_of_practice_alone(pairs, given, monkeypatch, randn):
    monkeypatch.setattr(runner, "right_up_to_symmetry", lambda *_: torch.tensor([True, False, True, True, True]))
    whole, labels = randn(5, 40, 3, dtype=torch.float32), torch.zeros(5)
    for name, expected in (("practice", 0.8), ("practice-any-rotation", 0.8), ("unseen-shapes", None)):
        assert run(given(identity), TestSet(name, pairs, "1", labels, whole), ignore).symmetric_recall == expected


def test_pairs_of_unknown_shapes_are_not(test, given):
    row = run(given(identity), test, ignore)
    assert row.observable is None
    assert row.chamfer is None


def test_progress_is_told_after_every_pair(test, given):
    told, done = [], []

    def method(*_: np.ndarray) -> np.ndarray:
        done.append(1)
        return np.eye(4)

    run(given(method), test, lambda: told.append(len(done)))
    assert told == [1, 2, 3, 4, 5]


def test_the_time_is_the_median_of_the_method_s_own(test, given, monkeypatch):
    clock, durations = SimpleNamespace(now=0.0), iter([1.0, 100.0, 3.0, 2.0, 50.0])

    def method(*_: np.ndarray) -> np.ndarray:
        clock.now += next(durations)
        return np.eye(4)

    def advance() -> None:
        clock.now += 1000.0

    monkeypatch.setattr(runner, "time", SimpleNamespace(perf_counter=lambda: clock.now))
    assert run(given(method), test, advance).seconds_per_pair == 3.0


def test_what_would_run_for_days_takes_the_first_pairs_alone(test, given, monkeypatch):
    calls = []
    task = given(lambda source, target: (calls.append(source), np.eye(4))[1])
    monkeypatch.setattr(runner, "LIMITS", {"stand-in": 2})
    row = run(task, test, ignore)
    assert len(calls) == row.pairs == 2


@pytest.mark.parametrize("jobs", [2, 9])
def test_several_processes_find_what_one_does(jobs, test, one_thread):
    task = Task("gnn-idam", "gnn-unseen-shapes", ("keep=0.9", "iterations=3"))
    advanced = []
    shared = run(task, test, lambda: advanced.append(1), jobs)
    alone = run(task, test, ignore)
    assert len(advanced) == 5
    assert shared.metrics.to_dict() == pytest.approx(alone.metrics.to_dict(), rel=1e-3, abs=1e-4)


def test_a_method_that_cannot_be_built_is_refused_before_any_process_starts(test):
    with pytest.raises(InputError, match="unknown method 'sift'"):
        run(Task("sift"), test, ignore, jobs=2)


METRICS = Metrics(rmse_r=1.0, mae_r=2.0, rmse_t=3.0, mae_t=4.0, recall=0.5, angle=6.0, distance=7.0)
ROWS = {
    "plain": Row(Task("icp"), 7, METRICS, 0.1),
    "full": Row(Task("gnn-idam", "a model", ("keep=1",)), 7, METRICS, 0.1, METRICS, 0.25, 0.75),
}


@pytest.mark.parametrize("row", ROWS.values(), ids=ROWS)
def test_a_row_survives_its_record(row):
    assert Row.from_dict(row.to_dict()) == row


def test_a_row_is_one_flat_record():
    assert ROWS["plain"].to_dict() == {
        "method": "icp",
        "model": None,
        "settings": [],
        "pairs": 7,
        "rmse_r": 1.0,
        "mae_r": 2.0,
        "rmse_t": 3.0,
        "mae_t": 4.0,
        "recall": 0.5,
        "angle": 6.0,
        "distance": 7.0,
        "seconds_per_pair": 0.1,
    }
