"""Which models a registration uses: a descriptor, and a network of the paper where one is named."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from idam import rigid
from idam.clouds.pyramid import PairLevel
from idam.describe.invariant import Descriptor
from idam.errors import InputError, MissingDependencyError
from idam.rigid import Array
from idam.weights import DEFAULT, SPARSE, find, is_descriptor, load_descriptor

__all__ = ["Models", "resolve"]


@dataclass(frozen=True)
class Models:
    """What answers.

    Attributes:
        name: of the models, as :func:`resolve` takes it.
        descriptor: makes the features that points are matched by.
        sparse: another that sparse clouds are matched by where that does not settle the matter; None where
            another descriptor than the default one is named.
        idam: a network of the paper, or None.
        exchanged: whether what is searched as the source is the caller's target. The network is asked for the caller's
            source all the same: of the pairs that it was taught the source stands as the data's shapes do, and it may
            count on that (``gnn-practice`` does).
    """

    name: str
    descriptor: Descriptor
    sparse: Descriptor | None = None
    idam: Any = None
    exchanged: bool = False

    @property
    def descriptors(self) -> tuple[Descriptor, ...]:
        """All descriptors, in the order they are asked."""
        return (self.descriptor,) if self.sparse is None else (self.descriptor, self.sparse)

    def asked(self, clouds: PairLevel) -> Callable[[Array], Array] | None:
        """The network's answer to a pair of clouds, as a function of a guess (4, 4); None without a network."""
        if self.idam is None:
            return None
        from idam.network.propose import propose

        if self.exchanged:
            return lambda guess: rigid.inverse(propose(self.idam, clouds.target, clouds.source, rigid.inverse(guess)))
        return lambda guess: propose(self.idam, clouds.source, clouds.target, guess)

    def reversed(self) -> Models:
        """For clouds that are searched the other way round."""
        return replace(self, exchanged=not self.exchanged)


def resolve(model: str | os.PathLike[str], device: str | None = None) -> Models:
    """The models of a name: a descriptor's, a network's, or both as ``DESCRIPTOR+NETWORK``.

    Raises:
        InputError: there is no such model, or a device is given where nothing runs on one.
        MissingDependencyError: a network is named, and PyTorch is not installed.
    """
    first, plus, second = _text(model).partition("+")
    if not plus and is_descriptor(first):
        if device not in (None, "cpu"):
            raise InputError(
                f"device {device!r} has no effect: {find(first).stem} runs on the CPU, without PyTorch; leave it out, "
                "or name a network of the paper such as gnn-unseen-shapes"
            )
        second_look = load_descriptor(SPARSE) if find(first) == find(DEFAULT) else None
        return Models(find(first).stem, load_descriptor(first), second_look)
    descriptor, network = (first, second) if plus else (DEFAULT, first)
    if is_descriptor(network) or not is_descriptor(descriptor):
        raise InputError(f"model {_text(model)!r}: give DESCRIPTOR+NETWORK, such as general+gnn-unseen-shapes")
    try:
        from idam.network.pretrained import cached_model
    except ImportError as error:
        raise MissingDependencyError(
            f"model {network!r} is a network of the paper and needs PyTorch: pip install 'idam[torch]'"
        ) from error
    name = f"{find(descriptor).stem}+{find(network).stem}"
    return Models(name, load_descriptor(descriptor), idam=cached_model(network, device))


def _text(model: Any) -> str:
    try:
        return str(os.fspath(model))
    except TypeError:
        raise InputError(f"model must be a name or a path, not of the type {type(model).__name__}") from None
