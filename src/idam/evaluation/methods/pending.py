"""Rows of the tables whose methods are not there yet."""

from __future__ import annotations

from collections.abc import Sequence

from idam.errors import MissingDependencyError
from idam.evaluation.methods import Method

__all__ = ["build"]


def build(model: str | None, settings: Sequence[str]) -> Method:
    """Raise MissingDependencyError: the learned rivals have their places in the tables, but no implementation."""
    raise MissingDependencyError("not yet: this method has its row here, but no implementation so far; leave it out")
