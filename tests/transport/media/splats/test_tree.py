import numpy as np
import pytest

from nerg_mi.transport.splat_medium import build_tree


@pytest.mark.parametrize("count", [1, 2, 3, 7, 8, 1000])
def test_every_box_is_in_one_leaf_and_in_all_above_it(count):
    rng = np.random.default_rng(count)
    lower = rng.normal(size=(count, 3))
    upper = lower + rng.uniform(0, 0.3, (count, 3))
    tree = build_tree(lower, upper)
    assert sorted(tree.order) == list(range(count)) and count <= tree.leaves < 2 * count + (count == 1)
    leaf = tree.nodes[tree.leaves :]
    held = leaf[:, 0] < 1e29
    assert sorted(tree.places[held]) == list(range(count))
    for node, place in zip(np.flatnonzero(held) + tree.leaves, tree.places[held]):
        i = tree.order[place]
        while node:
            assert (tree.nodes[node, :3] <= lower[i]).all() and (upper[i] <= tree.nodes[node, 3:6]).all()
            node //= 2


def test_boxes_of_one_place_are_no_trouble():
    tree = build_tree(np.zeros((9, 3)), np.ones((9, 3)))
    assert sorted(tree.order) == list(range(9)) and tree.nodes[1, :6].round(3).tolist() == [0, 0, 0, 1, 1, 1]


def test_what_holds_nothing_is_no_box():
    tree = build_tree(np.zeros((5, 3)), np.ones((5, 3)))
    empty = tree.nodes[tree.leaves :][~np.isin(np.arange(8), np.flatnonzero(tree.nodes[tree.leaves :, 0] < 1))]
    assert len(empty) == 3 and (empty[:, :6] == np.float32(1e30)).all()


def test_halves_are_those_along_the_longest_side():
    x = np.arange(8.0)
    lower = np.stack([0 * x, x[::-1], 0 * x], axis=1)
    tree = build_tree(lower, lower)
    assert tree.nodes[1, 6] == 1 and tree.order.tolist() == list(range(7, -1, -1))
