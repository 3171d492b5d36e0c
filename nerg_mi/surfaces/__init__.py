"""Attention on surfaces: meshes and splats, attention of observers and gaze samples, and smoothing."""
