"""Gaze on surfaces: meshes, what observers and tracked rays leave on them, smoothing along them, and files of it."""
