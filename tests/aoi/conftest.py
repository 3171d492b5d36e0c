"""Fixtures of this folder."""

from tests.field_in_box import camera, files, scene  # noqa: F401
