"""A method of one's own, named by its module."""

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from idam.errors import InputError, MissingDependencyError
from idam.lab.data.pairs import make_pairs
from idam.lab.evaluation.evaluate import evaluate
from idam.lab.evaluation.experiments import TestSet
from idam.lab.evaluation.methods import build_method

CLOUDS = np.zeros((5, 3), np.float32), np.ones((7, 3), np.float32)
SHIFTS = """
import numpy as np

def shift(source, target, scale: float = 1.0, model=None):
    answer = np.eye(4)
    answer[:3, 3] = scale * (target.mean(0) - source.mean(0)) + (0 if model is None else len(model))
    return answer

def plain(source, target):
    return [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]

def nothing(source, target):
    return None

def infinite(source, target):
    return np.full((4, 4), np.inf)

def short(source):
    return np.eye(4)

constant = 3
"""


@pytest.fixture
def mine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> Callable[[str], str]:
    """Writes a module into the current folder, and names a function of it."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    module = f"mine_{abs(hash(request.node.name))}"
    (tmp_path / f"{module}.py").write_text(SHIFTS)
    return lambda function: f"{module}:{function}"


def test_a_function_in_the_current_folder_is_a_method(mine):
    found = build_method(mine("shift"))(*CLOUDS)
    np.testing.assert_array_equal(found[:3, 3], [1, 1, 1])
    assert build_method(mine("plain"))(*CLOUDS).dtype == np.float64


def test_models_and_settings_are_passed_on_by_keyword(mine):
    np.testing.assert_array_equal(build_method(mine("shift"), "four", ["scale=2"])(*CLOUDS)[:3, 3], [6, 6, 6])


@pytest.mark.parametrize("jobs", [1, 2])
def test_it_is_a_row_under_its_own_name(jobs, mine, randn, generator):
    test = TestSet("mine", make_pairs(randn(2, 40, 3, dtype=torch.float32), generator), "1")
    (row,) = evaluate(test, [mine("shift")], settings=["scale=0.5"], jobs=jobs)
    assert (row.task.method, row.pairs) == (mine("shift"), 2)
    assert row.metrics.mae_t > 0


REFUSED = {
    "no module": ("nowhere_at_all:align", None, (), "cannot be imported.*ModuleNotFoundError"),
    "no function": ("MINE:missing", None, (), "cannot be imported.*missing"),
    "no name": ("MINE:", None, (), "cannot be imported"),
    "a number": ("MINE:constant", None, (), "no function"),
    "too few arguments": ("MINE:short", None, (), "source and target"),
    "a model it does not take": ("MINE:plain", "weights", (), "'model'"),
    "a setting it does not take": ("MINE:shift", None, ["size=3"], "with one of scale"),
    "no settings at all": ("MINE:plain", None, ["size=3"], "nothing to set"),
    "a setting of another type": ("MINE:shift", None, ["scale=big"], "no value"),
}


@pytest.mark.parametrize(("name", "model", "settings", "message"), REFUSED.values(), ids=REFUSED)
def test_what_cannot_be_called_is_refused_before_any_pair(name, model, settings, message, mine):
    with pytest.raises(InputError, match=message) as caught:
        build_method(name.replace("MINE:", mine("")), model, settings)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("function", ["nothing", "infinite"])
def test_an_answer_that_is_no_transform_is_refused(function, mine):
    with pytest.raises(InputError, match="4 x 4"):
        build_method(mine(function))(*CLOUDS)


def test_a_module_that_breaks_is_one_line_and_a_missing_package_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("breaks.py").write_text("1 / 0\n")
    with pytest.raises(InputError, match="ZeroDivisionError"):
        build_method("breaks:align")
    Path("lacks.py").write_text("from idam.errors import MissingDependencyError\nraise MissingDependencyError('pip')")
    with pytest.raises(MissingDependencyError, match="pip"):
        build_method("lacks:align")
