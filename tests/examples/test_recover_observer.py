"""Recovering an observer, at sizes that take seconds: what is found, not what is printed."""

import numpy as np

from examples import recover_observer


def test01_the_distance_of_pictures(rgb):
    a = np.random.default_rng(0).exponential(1, (16, 24)).astype(np.float32)
    b = np.roll(a, 1, axis=1)
    assert recover_observer.distance(rgb.TensorXf(a), rgb.TensorXf(a)).array[0] == 0
    assert recover_observer.distance(rgb.TensorXf(a), rgb.TensorXf(b)).array[0] > 0
    coarse = recover_observer.pooled(rgb.TensorXf(a), 8).numpy()
    assert np.allclose(coarse, a.reshape(2, 8, 3, 8).mean((1, 3)), rtol=1e-5)


def test02_an_observer_is_found_again(rgb):
    settings = recover_observer.Settings(size=(32, 24), steps=8, rate=0.04)
    picture, truth = recover_observer.Picture(settings.size), np.array([4.4, 2.8, 1.6])
    given = picture.given(truth, seed=1)
    path, losses = recover_observer.descend(picture, given, truth + (0.1, 0.15, 0.05), settings, (0, 0, 1), (8, 6, 2.5))
    end, least = recover_observer.answer(path, losses)
    assert np.linalg.norm(end - truth) < 0.5 * np.linalg.norm(path[0] - truth) and least < 0.6 * losses[0]


def test03_starts_stand_where_one_can_stand():
    from nerg_mi.scenes.store import layout, shoppers

    points = recover_observer.starting_points(5, 0)
    assert points.shape == (5, 3) and shoppers.floor_clearance(layout.build(0), points[:, :2]).min() > shoppers.BODY
    assert not np.array_equal(points, recover_observer.starting_points(5, 1))
