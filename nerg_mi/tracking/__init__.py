"""Gaze samples as rays: sets and datasets of rays, readers of tracking files, filters and splits, quality checks,
probes, and kernel densities of directions."""
