"""Glasses that people wear in the place itself, and what places their gaze there: trajectories and scene cameras."""
