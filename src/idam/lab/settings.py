"""Values set from text, as ``--set NAME=VALUE`` gives them."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any, TypeVar

from idam.errors import InputError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    T = TypeVar("T", bound=DataclassInstance)

__all__ = ["parsed", "with_settings"]


def with_settings(defaults: T, settings: Iterable[str], only: Collection[str] | None = None) -> T:
    """A copy of a dataclass with some fields set from text, each ``NAME=VALUE``; tuples by commas.

    Args:
        defaults: the dataclass.
        settings: the texts.
        only: fields that may be set, where the others would change nothing; None for all.

    Raises:
        InputError: no such field may be set, or the value is not of its type.
    """
    names = [field.name for field in fields(defaults) if only is None or field.name in only]
    return replace(defaults, **parsed({name: getattr(defaults, name) for name in names}, settings))


def parsed(known: Mapping[str, Any], settings: Iterable[str]) -> dict[str, Any]:
    """Values by name from texts ``NAME=VALUE``, each of the type of the known one.

    Raises:
        InputError: no name is known, or the value is not of its type.
    """
    values: dict[str, Any] = {}
    for setting in settings:
        name, separator, text = setting.partition("=")
        if name not in known or not separator:
            names = f"give NAME=VALUE with one of {', '.join(known)}" if known else "there is nothing to set here"
            raise InputError(f"unknown setting {setting!r}: {names}")
        try:
            values[name] = _parse(text, known[name])
        except (ValueError, KeyError):
            raise InputError(
                f"setting {setting!r}: {text!r} is no value for it; without it, {name} is {known[name]!r}"
            ) from None
    return values


def _parse(text: str, default: Any) -> Any:
    if isinstance(default, bool):
        return {"true": True, "false": False}[text.lower()]
    if isinstance(default, tuple):
        return tuple(float(number) for number in text.split(",") if number)
    return type(default)(text)
