"""Environments that participants see (trained fields, splats, meshes, scenes, hit points), the Mitsuba scenes that show
them, and their rendering."""
