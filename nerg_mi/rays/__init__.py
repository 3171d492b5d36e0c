"""Gaze samples as rays: sets and datasets of them, their readers, filters and splits, and the checks of their
quality."""
