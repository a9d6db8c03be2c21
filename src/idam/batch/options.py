"""The options of a batch: keyword arguments of ``register`` that hold for all pairs."""

from __future__ import annotations

import hashlib
import inspect
import types
from collections.abc import Iterable, Mapping
from typing import Any, get_args, get_origin, get_type_hints

from idam import __version__
from idam.errors import InputError
from idam.weights import find

__all__ = ["check_options", "job_of", "parse_options"]


def parse_options(settings: Iterable[str]) -> dict[str, Any]:
    """Options from text, each ``NAME=VALUE``; ``none`` stands for None.

    Raises:
        InputError: there is no such option, or the value is not of its type.
    """
    from idam.registration import register

    hints = get_type_hints(register)
    known = _defaults()
    options = {}
    for setting in settings:
        name, separator, text = setting.partition("=")
        if name not in known or not separator:
            raise InputError(f"unknown setting {setting!r}: give NAME=VALUE with one of {', '.join(known)}")
        try:
            options[name] = _parse(text, hints[name])
        except ValueError:
            raise InputError(
                f"setting {setting!r}: {text!r} is no value for it; without it, {name} is {known[name]!r}"
            ) from None
    return options


def _parse(text: str, hint: Any) -> Any:
    kinds = get_args(hint) if get_origin(hint) is not None or isinstance(hint, types.UnionType) else (hint,)
    if type(None) in kinds and text.lower() == "none":
        return None
    kind = next((kind for kind in (int, float) if kind in kinds), str)
    return kind(text)


def check_options(options: Mapping[str, Any]) -> None:
    """Refuse options before any pair is registered with them.

    Raises:
        InputError: one is unknown or out of range, or there is no such model.
    """
    from idam import registration
    from idam.models import resolve

    values = {**_defaults(), **options}
    unknown = [name for name in values if name not in _defaults()]
    if unknown:
        raise InputError(f"unknown option {unknown[0]!r}: the ones for all pairs are {', '.join(_defaults())}")
    names = ("max_angle", "voxel_size", "max_correspondence_distance", "refine", "seed")
    registration.check_options(*(values[name] for name in names))
    resolve(values["model"], values["device"])


def _defaults() -> dict[str, Any]:
    """The options that hold for a whole batch, with their defaults."""
    from idam.registration import register

    parameters = inspect.signature(register).parameters.values()
    return {p.name: p.default for p in parameters if p.kind is p.KEYWORD_ONLY and p.name != "init"}


def job_of(options: Mapping[str, Any]) -> dict[str, Any]:
    """What rows depend on beside the pairs: idam's version, every option, and the weights themselves."""
    values = {**_defaults(), **options}
    weights = b"".join(find(part).read_bytes() for part in values["model"].split("+"))
    return {"idam": __version__, "weights": hashlib.sha256(weights).hexdigest(), **values}
