"""Poses of photos that have none: structure from motion, by COLMAP (package pycolmap, extra ``poses``)."""
