"""Alignment: the similarity from the tracking frame to the scene."""
