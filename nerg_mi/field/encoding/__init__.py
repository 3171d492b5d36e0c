"""Encodings of positions and directions, which the networks are given."""
