"""The errors of gsopt and their exit codes.

Every message states what was wrong, what was given, and what to do about it.
"""

from __future__ import annotations

import reprlib

MAX_MESSAGE = 2000
"""Characters of a message; its middle is left out beyond."""
_SHORT = reprlib.Repr()
_SHORT.maxlevel, _SHORT.maxstring, _SHORT.maxother = 3, 80, 80


class GsoptError(Exception):
    """Base of every error a caller can cause. `exit_code` is what `gsopt` exits with."""

    exit_code = 1

    def __init__(self, message: str = "") -> None:
        half = MAX_MESSAGE // 2
        super().__init__(message if len(message) <= MAX_MESSAGE else f"{message[:half]} [...] {message[-half:]}")


class UsageError(GsoptError):
    """A flag or an argument is wrong (exit code 2)."""

    exit_code = 2


class SettingError(UsageError):
    """A setting is wrong. The message names settings as config.json does, in backticks: `optimizer.lr_last`."""


class InputError(GsoptError):
    """A file, a folder or a tensor given to us is missing, broken or hostile (exit code 3)."""

    exit_code = 3


class NumericalError(GsoptError):
    """A value stopped being finite; the last good state was saved (exit code 4)."""

    exit_code = 4


class MissingDependency(GsoptError):
    """An optional package is not installed; the message carries the pip line that installs it (exit code 2)."""

    exit_code = 2


class InputWarning(UserWarning):
    """A file was read, but not all of it could be used; `gsopt` prints the message as one line on stderr."""


def shortened(value: object) -> str:
    """A value of a file as messages repeat it: at most 80 characters, however long or deeply nested it is."""
    return _SHORT.repr(value)[:80]


def refused(error: OSError) -> str:
    """The message for what the operating system refused; long names are shortened."""
    name = "" if error.filename is None else f", got {shortened(str(error.filename))}"
    return (
        f"The system refused a file or connection: {error.strerror or error}{name}. Check names, space and permissions."
    )
