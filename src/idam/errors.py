"""What idam raises when the input, not the program, is at fault."""

__all__ = ["InputError", "MissingDependencyError"]


class InputError(ValueError):
    """The input cannot be used: the message is one line that says what is wrong and how to mend it."""


class MissingDependencyError(ImportError):
    """An optional package is needed for what was asked: the message holds the pip command that brings it."""
