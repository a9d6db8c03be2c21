"""What scans are called: files told apart by their folders, and which scan a name means."""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Integral
from pathlib import Path

from idam.errors import InputError

__all__ = ["find", "told_apart"]


def told_apart(files: Sequence[Path]) -> list[str]:
    """The shortest ends of files' paths that tell them apart; one that is given twice has the same name twice."""
    paths = [(file.parent.resolve() / file.name).parts for file in files]
    names = []
    for own in paths:
        length = 1
        while any(other[-length:] == own[-length:] and other != own for other in paths):
            length += 1
        names.append("/".join(own[-length:]))
    return names


def find(reference: str | int, names: Sequence[str]) -> int:
    """The number of the scan that a reference means, by its number, its name or its path.

    Raises:
        InputError: there is none, or several may be meant.
    """
    if isinstance(reference, Integral):
        if not 0 <= int(reference) < len(names):
            raise InputError(f"reference {reference}: there are scans 0 to {len(names) - 1}")
        return int(reference)
    if reference in names:
        return names.index(str(reference))
    meant = [name for name in names if may_mean(str(reference), name)]
    if len(meant) != 1:
        fault = f"may be {' or '.join(meant[:3])}" if meant else "is not among the scans"
        raise InputError(f"reference {reference!r} {fault}: name one of {', '.join(meant or names[:3])}")
    return names.index(meant[0])


def may_mean(reference: str, name: str) -> bool:
    """Whether a reference may mean the scan of a name: it is its path, or its name without folders or extension."""
    given = Path(reference).parts
    for own in (Path(name).parts, Path(name).with_suffix("").parts):
        length = min(len(own), len(given))
        if length and own[-length:] == given[-length:]:
            return True
    return False
