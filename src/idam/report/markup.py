"""What the pages share: templates, text that cannot become markup, and numbers as they are written."""

from __future__ import annotations

import html
import json
import math
import re
from importlib import resources
from typing import Any

__all__ = ["escape", "fill", "number", "plain_json", "rows", "template"]


def template(name: str) -> str:
    """A page of this folder, with each ``{{> FILE}}`` replaced by that file."""
    folder = resources.files("idam.report")
    text = folder.joinpath(name).read_text(encoding="utf-8")
    return re.sub(
        r"\{\{> ([\w.]+)\}\}", lambda match: folder.joinpath(match[1]).read_text(encoding="utf-8").rstrip(), text
    )


def fill(page: str, **fields: str) -> str:
    """Put each field in place of its ``{{name}}``, in one pass: what is put in is not searched again."""
    return re.sub(r"\{\{(\w+)\}\}", lambda match: fields[match[1]], page)


def escape(text: str) -> str:
    """Any text, even a file name that is not Unicode, for use in HTML."""
    return html.escape(text.encode("utf-8", "replace").decode("utf-8"))


def plain_json(value: Any) -> str:
    """JSON that cannot end the script element it stands in."""
    text = json.dumps(value, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def rows(pairs: list[tuple[str, str]]) -> str:
    """Labels and values as the rows of a table."""
    return "\n".join(f"<tr><th>{escape(label)}</th><td>{escape(value)}</td></tr>" for label, value in pairs)


def number(value: float, digits: int = 4) -> str:
    """A number of any unit and size to that many significant digits."""
    if not math.isfinite(value):
        return "n/a"
    magnitude = math.floor(math.log10(abs(value))) if value else 0
    style = f",.{max(0, digits - 1 - magnitude)}f" if -5 <= magnitude <= 9 else f".{digits - 1}e"
    return format(value, style).replace("-", "−")
