"""Encodings of positions and directions, which the networks are given."""

# What is there without being asked for registers itself here.
from . import hashgrid  # noqa: F401
