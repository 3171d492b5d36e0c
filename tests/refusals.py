"""Checks of errors by what they carry, in place of their words."""

from __future__ import annotations

from collections.abc import Callable

from nerg_mi.errors import NergError


def mentions(*names: str) -> Callable[[NergError], bool]:
    """Return the check that an error mentions the parameters ``names``."""
    return lambda error: set(names) <= set(error.parameters)
