"""Gaussian splats as a medium: what rays meet of them, nearest first."""
