"""Mendings: faults that once existed, how each is brought back, and the tests that must then fail."""

from __future__ import annotations

from . import outputs, scenes

MENDINGS = (*outputs.MENDINGS, *scenes.MENDINGS)
"""All of them, in the order of the table on the page."""
