"""One table: rows chosen, saved as they finish, and not computed twice."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from rich.console import Console

from idam.errors import InputError, MissingDependencyError
from idam.lab.data.pairs import make_pairs
from idam.lab.evaluation import runner
from idam.lab.evaluation.evaluate import evaluate
from idam.lab.evaluation.experiments import TestSet
from idam.lab.evaluation.methods import ABLATION, METHODS, rows_of
from idam.lab.evaluation.paper import PAPER
from idam.lab.evaluation.record import Missing
from idam.lab.evaluation.runner import Task
from idam.lab.evaluation.table import results_table


@pytest.fixture
def test(randn, generator) -> TestSet:
    return TestSet("unseen-shapes", make_pairs(randn(3, 40, 3, dtype=torch.float32), generator), "1234")


@pytest.fixture
def built(monkeypatch) -> list[tuple]:
    """Stands in for every method; what was built, and how often each registered."""
    calls: list[tuple] = []

    def build(*what):
        def register(*_: np.ndarray) -> np.ndarray:
            calls.append(what)
            if what[0] == "breaks":
                raise InputError("a pair it cannot take")
            return np.eye(4)

        if what[0] in ("fpfh-ransac", "go-icp"):
            raise MissingDependencyError("not yet: later")
        return register

    monkeypatch.setattr(runner, "build_method", build)
    return calls


@pytest.fixture
def ablated(tmp_path, monkeypatch) -> Path:
    """A folder of weights of the ablation, which stand-ins for methods do not open."""
    folder = tmp_path / "ablation"
    folder.mkdir()
    for name in ABLATION:
        (folder / f"gnn-{name}.safetensors").touch()
    monkeypatch.setenv("IDAM_ABLATION", str(folder))
    return folder


@pytest.mark.parametrize("named", [True, False])
def test_the_ablation_s_rows_take_their_weights_from_one_folder(named, test, built, ablated, monkeypatch):
    if named:
        monkeypatch.delenv("IDAM_ABLATION")
    rows = evaluate(dataclasses.replace(test, name="ablation"), model=str(ablated) if named else None)
    assert [row.task.model for row in rows] == [str(ablated / f"gnn-{name}.safetensors") for name in ABLATION]


def test_without_them_the_command_that_makes_them_is_named_before_any_work(test, built, tmp_path):
    for model in (None, str(tmp_path / "nowhere"), str(tmp_path / "mine.safetensors")):
        with pytest.raises(InputError, match=r"no such weights.*benchmarks/ablation\.py FOLDER.*IDAM_ABLATION"):
            evaluate(dataclasses.replace(test, name="ablation"), model=model)
    assert built == []


def test_all_rows_are_computed_and_those_that_cannot_be_say_why(test, built, tmp_path):
    rows = evaluate(test, output=tmp_path / "out.json")
    assert [row.task.method for row in rows] == rows_of("unseen-shapes")
    assert [row.task.method for row in rows if isinstance(row, Missing)] == ["go-icp", "fpfh-ransac"]
    saved = json.loads((tmp_path / "out.json").read_text())
    assert [row["method"] for row in saved["rows"]] == rows_of("unseen-shapes")
    assert next(row for row in saved["rows"] if row["method"] == "fpfh-ransac")["missing"] == "not yet: later"
    assert saved["checksum"] == "1234"


def test_a_row_asked_for_that_cannot_be_computed_is_an_error(test, built):
    with pytest.raises(MissingDependencyError, match="not yet"):
        evaluate(test, ["icp", "go-icp"])
    assert built == []  # before any work


def test_the_network_s_rows_take_the_weights_of_their_experiment(test, built):
    evaluate(test, ["gnn-idam", "fpfh-idam-paper", "icp", "register"])
    assert [what[1] for what in built[::3]] == ["gnn-unseen-shapes", "fpfh-unseen-shapes-paper", None, None]


def test_named_weights_go_to_the_rows_that_take_any(test, built):
    evaluate(test, ["gnn-idam", "icp", "register", "register-90"], model="mine")
    assert [what[1] for what in built[::3]] == ["mine", None, "mine", "mine"]


def test_a_finished_row_is_saved_before_the_next_begins(test, built, tmp_path):
    with pytest.raises(InputError, match="cannot take"):
        evaluate(test, ["icp", "breaks"], output=tmp_path / "out.json")
    (row,) = json.loads((tmp_path / "out.json").read_text())["rows"]
    assert row["method"] == "icp"


def test_resuming_computes_what_is_missing_alone(test, built, tmp_path):
    output = tmp_path / "out.json"
    first = evaluate(test, ["icp", "gnn-idam"], output=output)
    built.clear()
    rows = evaluate(test, ["icp", "kiss-matcher", "gnn-idam"], output=output, resume=True)
    assert [what[0] for what in built] == ["kiss-matcher"] * 3
    assert [rows[0], rows[2]] == first
    assert [row["method"] for row in json.loads(output.read_text())["rows"]] == ["icp", "kiss-matcher", "gnn-idam"]


def test_resuming_computes_again_what_had_fewer_pairs_or_other_settings(test, built, tmp_path):
    output = tmp_path / "out.json"
    evaluate(test.first(2), ["icp"], output=output)
    built.clear()
    evaluate(test, ["icp"], output=output, resume=True)
    assert len(built) == 3
    evaluate(test, ["icp"], settings=["icp_distance=1"], output=output, resume=True)
    assert len(built) == 6


def not_json(path: Path) -> None:
    path.write_text("method,rmse\n")


def other_json(path: Path) -> None:
    path.write_text("[]")


def of_other_pairs(path: Path) -> None:
    path.write_text(path.read_text().replace("1234", "5678"))


SPOILT = {"not JSON": not_json, "no record": other_json, "other pairs": of_other_pairs}


@pytest.mark.parametrize("spoil", SPOILT.values(), ids=SPOILT)
def test_a_file_that_cannot_be_gone_on_with_is_refused_and_kept(spoil, test, built, tmp_path):
    output = tmp_path / "out.json"
    evaluate(test, ["icp"], output=output)
    spoil(output)
    kept = output.read_bytes()
    with pytest.raises(InputError, match="--resume"):
        evaluate(test, ["icp", "fgr"], output=output, resume=True)
    assert output.read_bytes() == kept


def test_settings_need_one_method_and_resuming_a_file(test, built):
    for methods in (None, ["icp", "fgr"]):
        with pytest.raises(InputError, match="one --method"):
            evaluate(test, methods, settings=["icp_distance=1"])
    with pytest.raises(InputError, match="--json"):
        evaluate(test, ["icp"], resume=True)


@pytest.mark.parametrize("experiment", PAPER)
def test_the_paper_s_figures_stand_beside_ours(experiment, test, built, ablated):
    name = rows_of(experiment)[-1] if experiment == "ablation" else "icp"
    (row,) = evaluate(TestSet(experiment, test.pairs, "1234"), [name])
    console = Console(width=200)
    with console.capture() as capture:
        console.print(results_table(experiment, [row, Missing(Task("fgr"), "not yet: later")]))
    shown = capture.get()
    for figure in PAPER[experiment][name]:
        assert f"({figure:g})" in shown
    assert f"{row.metrics.rmse_r:.3f} (" in shown
    assert "not yet" in shown


def test_every_row_of_the_paper_is_one_of_ours_or_a_rival():
    assert all(rows.keys() <= METHODS.keys() | {"pointnetlk", "dcp", "prnet"} for rows in PAPER.values())


def test_weights_for_methods_without_any_are_refused(test, built):
    with pytest.raises(InputError, match="icp, fpfh-ransac takes no weights: leave --model out"):
        evaluate(test, ["icp", "fpfh-ransac"], model="mine")
    assert built == []


def test_other_bounds_are_not_gone_on_with(test, built, tmp_path):
    output = tmp_path / "out.json"
    (row,) = evaluate(test, ["icp"], output=output)
    loose = dataclasses.replace(test, within=(180.0, 10.0))
    with pytest.raises(InputError, match="other pairs or bounds"):
        evaluate(loose, ["icp"], output=output, resume=True)
    (other,) = evaluate(loose, ["icp"], output=output)
    assert (row.metrics.recall, other.metrics.recall) == (0, 1)
    assert json.loads(output.read_text())["recall_within"] == [180, 10]


def test_every_method_is_in_one_table_or_the_other():
    assert rows_of("ablation") == list(ABLATION)
    assert rows_of("gaussian-noise") == [name for name in METHODS if name not in ABLATION]
