"""Figures beside the pictures of scenes: what is drawn of which files, one module a kind."""
