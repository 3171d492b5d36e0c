"""Kernel densities on the sphere: exact, on a table, for a whole picture, and as an observer sees them."""
