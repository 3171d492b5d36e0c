"""Shared fixtures of the tests of lists of Gaussians."""

from __future__ import annotations

import pytest

from nerg_mi.transport import splat_lists, splat_medium


@pytest.fixture
def any_number(monkeypatch):
    """Lists for any number of Gaussians and rays."""
    monkeypatch.setattr(splat_lists, "MIN_GAUSSIANS", 1)
    monkeypatch.setattr(splat_lists, "MIN_RAYS_PER_GAUSSIAN", 0)


@pytest.fixture
def sorted_hits(monkeypatch):
    """So many hits wait that the order along rays is that of their peaks."""
    monkeypatch.setattr(splat_lists, "NUM_WAITING", 24)


@pytest.fixture
def no_tree(monkeypatch):
    """No ray searches the tree, which is not even built."""

    def refuse(*args):
        raise AssertionError("the tree was searched or built")

    monkeypatch.setattr(splat_lists.SplatLists, "find_next", refuse)
    monkeypatch.setattr(splat_medium, "build_tree", refuse)
