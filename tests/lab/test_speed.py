"""benchmarks/speed.py: single pairs and batches in one run, medians with their spread, and how times grow."""

import importlib
import json
import sys

import numpy as np
import pytest

from idam.lab.evaluation.methods import METHODS
from idam.lab.figures.timings import read_timings


@pytest.fixture
def speed(monkeypatch):
    module = importlib.import_module("benchmarks.speed")
    monkeypatch.setattr(module, "BATCH_POINTS", 96)
    return module


def test_networks_are_timed_alone_and_in_batches(speed, monkeypatch, tmp_path, capsys):
    path = tmp_path / "speed.json"
    words = ["--points", "96", "192", "--repeats", "3", "--methods", "icp", "gnn-idam-paper", "--batch", "2"]
    monkeypatch.setattr(sys, "argv", ["benchmarks/speed.py", *words, "--json", str(path)])
    speed.main()
    record = json.loads(path.read_text())
    assert record["command"].endswith(f"--batch 2 --json {path}")
    batched = record["batched"]
    assert (batched["pairs"], batched["points"], list(batched["median_ms"])) == (2, 96, ["gnn-idam-paper"])
    for medians, quartiles in (
        (record["median_ms"]["96"], record["quartiles_ms"]["96"]),
        (record["median_ms"]["192"], record["quartiles_ms"]["192"]),
        (batched["median_ms"], batched["quartiles_ms"]),
    ):
        for name, median in medians.items():
            assert 0 < quartiles[name][0] <= median <= quartiles[name][1]
    assert set(read_timings(path).milliseconds) == {"icp", "gnn-idam-paper"}
    assert "2 at once" in capsys.readouterr().out


def test_the_first_input_warms_up_and_a_batch_counts_by_its_pairs(speed):
    given = []
    times = speed.measure({"it": lambda a, b: given.append((a, b))}, [(n, -n) for n in range(4)])
    assert given == [(0, 0), (1, -1), (2, -2), (3, -3)]
    assert len(times["it"]) == 3
    median, quartiles = speed.summarise({"it": [10.0, 20.0, 30.0, 40.0, 50.0]}, pairs=10)
    assert median == {"it": 3.0}
    assert quartiles == {"it": [2.0, 4.0]}


def test_pairs_overlap_and_are_drawn_by_their_seed(speed):
    source, target = speed.make_pair(300, 4)
    assert source.shape == target.shape == (300, 3)
    again = speed.make_pair(300, 4)
    assert np.array_equal(source, again[0])
    assert not np.array_equal(source, speed.make_pair(300, 5)[0])


def test_networks_in_batches_are_rows_of_the_tables(speed):
    assert set(speed.NETWORKS) == {"gnn-idam", "gnn-idam-paper", "fpfh-idam", "fpfh-idam-paper"} <= set(METHODS)
