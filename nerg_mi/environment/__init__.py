"""Environments that participants see: trained fields, splats, meshes, scenes and hit points."""
