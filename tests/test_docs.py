"""The documentation's Python blocks run, and its command lines name commands and options that exist."""

from __future__ import annotations

import re
import shlex
import shutil
from importlib import resources
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import typer

from idam import cli

ROOT = Path(__file__).resolve().parents[1]
PAGES = ["README.md", "docs/guide.md"]
"""Those whose Python runs here, block after block; that of docs/examples.md is run by test_examples."""
LINKED = [*PAGES, "docs/examples.md", "docs/numbers.md", "docs/architecture.md"]


@pytest.fixture
def scans(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder, with the shipped scans in it under the names that the pages use."""
    with resources.as_file(resources.files("idam.demo")) as demo:
        for name, role in (("scan1.ply", "source.ply"), ("scan2.ply", "target.ply")):
            shutil.copy(demo / role, tmp_path / name)
    monkeypatch.chdir(tmp_path)
    return tmp_path


class Block(NamedTuple):
    """A fenced block of a page."""

    line: int
    """Number of its first line."""
    needs: str
    """The package that it needs besides the core, or nothing: ``<!-- needs NAME -->`` stands in the line before."""
    text: str


def blocks(page: str, *languages: str) -> list[Block]:
    text = (ROOT / page).read_text(encoding="utf-8")
    fenced = re.finditer(r"^(?:<!-- needs (\w+) -->\n)?```(\w*)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    return [
        Block(text.count("\n", 0, each.start(3)) + 1, each[1] or "", each[3]) for each in fenced if each[2] in languages
    ]


@pytest.mark.parametrize("page", PAGES)
def test_python_blocks_run_one_after_the_other(scans: Path, page: str) -> None:
    namespace: dict[str, Any] = {"__name__": "__main__"}
    found = blocks(page, "python")
    assert found
    for line, needs, block in found:
        if needs and find_spec(needs) is None:
            continue
        # the line breaks before it make the line numbers of a traceback the page's own
        exec(compile("\n" * (line - 1) + block, str(ROOT / page), "exec"), namespace)


def command_lines() -> list[list[str]]:
    lines = [line for page in PAGES for block in blocks(page, "", "sh") for line in block.text.splitlines()]
    commands = [re.search(r"\bidam [a-z].*", line.partition("#")[0]) for line in lines]
    return [re.split(r"[>;|&]", found[0])[0].split() for found in commands if found]


def test_command_lines_name_what_there_is() -> None:
    root: Any = typer.main.get_command(cli.app)
    assert command_lines()
    for program, name, *words in command_lines():
        assert program == "idam"
        command = root.commands[name]
        known = {option for parameter in command.params for option in parameter.opts}
        assert {word for word in words if word.startswith("-")} <= known, shlex.join([program, name, *words])


@pytest.mark.parametrize("page", LINKED)
def test_links_lead_somewhere(page: str) -> None:
    text = (ROOT / page).read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)#:]+)\)", text):
        assert ((ROOT / page).parent / target).exists(), target
