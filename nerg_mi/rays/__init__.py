"""Gaze samples as rays: sets and datasets of rays, readers of tracking files, filters and splits, and quality
checks."""
