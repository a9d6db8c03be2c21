"""Fields of a dataclass set from text, as ``--set NAME=VALUE`` gives them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any, TypeVar

from idam.errors import InputError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    T = TypeVar("T", bound=DataclassInstance)

__all__ = ["with_settings"]


def with_settings(defaults: T, settings: Iterable[str]) -> T:
    """A copy of a dataclass with some fields set from text, each ``NAME=VALUE``; tuples by commas.

    Raises:
        InputError: no field has that name, or the value is not of its type.
    """
    known = {field.name: getattr(defaults, field.name) for field in fields(defaults)}
    values: dict[str, Any] = {}
    for setting in settings:
        name, separator, text = setting.partition("=")
        if name not in known or not separator:
            raise InputError(f"unknown setting {setting!r}: give NAME=VALUE with one of {', '.join(known)}")
        try:
            values[name] = _parse(text, known[name])
        except (ValueError, KeyError):
            raise InputError(
                f"setting {setting!r}: {text!r} is no value for it; without it, {name} is {known[name]!r}"
            ) from None
    return replace(defaults, **values)


def _parse(text: str, default: Any) -> Any:
    if isinstance(default, bool):
        return {"true": True, "false": False}[text.lower()]
    if isinstance(default, tuple):
        return tuple(float(number) for number in text.split(",") if number)
    return type(default)(text)
