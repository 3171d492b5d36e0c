"""Readers of tracking: one module a device or kind of file, and what they share."""
