"""Optimisation of radiance and gaze fields."""
