"""Mendings: faults that once existed, how each is brought back, and the tests that must then fail."""

from __future__ import annotations

from . import house, outputs, readers, scenes, trainings

MENDINGS = (*outputs.MENDINGS, *trainings.MENDINGS, *scenes.MENDINGS, *readers.MENDINGS, *house.MENDINGS)
"""All of them, in the order of the table on the page."""
