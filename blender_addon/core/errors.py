"""Errors of the extension: what was wrong, what was got, what to do."""

from __future__ import annotations


def printable(text: str) -> str:
    """The text as Blender's properties can hold it: lone surrogates are escaped."""
    return text.encode("utf-8", "backslashreplace").decode("utf-8")


class GsoptError(Exception):
    """Any failure a person can mend; its text is shown in the panel."""

    def __str__(self) -> str:
        return printable(super().__str__())


class InputError(GsoptError):
    """A file or folder that cannot be used."""


class UsageError(GsoptError):
    """A setting that cannot be used, or a program that is missing."""
