"""The numbered examples run, and the page of them is what they say."""

from __future__ import annotations

import runpy
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

FOLDER = Path(__file__).resolve().parents[1] / "examples"
MADE: dict[str, Any] = runpy.run_path(str(FOLDER / "make_page.py"))
NEEDS = {"12_network.py": "torch"}
"""What an example needs besides the core."""


def test_page_is_made_from_the_examples() -> None:
    assert MADE["PAGE"].read_text(encoding="utf-8") == MADE["page"](), "run: python examples/make_page.py"


def test_examples_are_numbered_without_a_gap() -> None:
    assert [int(path.name[:2]) for path in MADE["examples"]()] == list(range(1, len(MADE["examples"]()) + 1))


@pytest.mark.parametrize("path", MADE["examples"](), ids=lambda path: path.stem)
def test_example_runs(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    needed = NEEDS.get(path.name)
    if needed and find_spec(needed) is None:
        pytest.skip(f"needs {needed}")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [str(path)])
    runpy.run_path(str(path), run_name="__main__")
