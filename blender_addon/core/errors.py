"""Errors of the extension: what was wrong, what was got, what to do."""

from __future__ import annotations


class GsoptError(Exception):
    """Any failure a person can mend; its text is shown in the panel."""


class InputError(GsoptError):
    """A file or folder that cannot be used."""


class UsageError(GsoptError):
    """A setting that cannot be used, or a program that is missing."""
