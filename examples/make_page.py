"""Write ``docs/examples.md`` from the numbered examples: each file's docstring, and the code below it.

``python examples/make_page.py`` in a clone.
"""

from __future__ import annotations

import ast
from pathlib import Path

FOLDER = Path(__file__).resolve().parent
PAGE = FOLDER.parent / "docs" / "examples.md"
HEAD = """# Examples

Each section is a file in [examples](../examples) that runs as it is, with the two scans of `idam demo`: a machine part
of 0.4 m, seen by a depth camera from two places 60 degrees apart. All run as tests. This page is made from them by
`python examples/make_page.py`.
"""


def examples() -> list[Path]:
    """The numbered examples, in order."""
    return sorted(FOLDER.glob("[0-9][0-9]_*.py"))


def section(path: Path) -> str:
    """The section of one example."""
    text = path.read_text(encoding="utf-8")
    tree = ast.parse(text)
    docstring, first = ast.get_docstring(tree), tree.body[0]
    assert docstring is not None
    title, _, prose = docstring.partition("\n")
    code = "\n".join(text.splitlines()[first.end_lineno :]).strip()
    return f"""
## {title.rstrip(".")}

[{path.name}](../examples/{path.name})

{prose.strip()}

```python
{code}
```
"""


def page() -> str:
    """The whole page."""
    return HEAD + "".join(section(path) for path in examples())


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    print(PAGE)
