"""The page of results: a summary first, and how many pairs each row ran on."""

import importlib
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture
def page(monkeypatch, capsys) -> str:
    """The page that the committed records make."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    records = sorted(map(str, (ROOT / "docs" / "results").glob("*.json")))
    monkeypatch.setattr(sys, "argv", ["results.py", *records])
    importlib.import_module("results").main()
    return capsys.readouterr().out


def test_the_page_opens_with_one_table_and_one_picture(page):
    opening = page.split("\n## ")[0]
    assert opening.startswith("# Results\n\n|  | idam | idam with the paper's inference | IDAM in the paper |")
    assert opening.count("![") == 1
    (noise,) = (line for line in opening.splitlines() if line.startswith("| Gaussian noise"))
    assert "3.72 / 1.85 (gnn-idam)" in noise
    assert "4.32 / 2.05 (prnet)" in noise


def test_a_row_of_fewer_pairs_says_so_beside_its_name(page):
    section = page.split("## Unseen shapes")[1].split("\n## ")[0]
    assert "| go-icp, first 40 pairs |" in section
    assert "| icp | " in section


def test_the_committed_page_is_that_of_the_committed_records(page):
    assert (ROOT / "docs" / "results.md").read_text() == page
