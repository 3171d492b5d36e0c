"""Gaze fields: what a surface attracts and what an observer gives, as networks of two kinds, and ensembles of them."""
