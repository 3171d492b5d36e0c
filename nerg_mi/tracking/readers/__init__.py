"""Readers of tracking data: one module per device or file format, and their common parts."""
