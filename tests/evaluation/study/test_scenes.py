"""The analytic scenes as volumes."""

import numpy as np

from nerg_mi.evaluation import study_scenes


def test_volumes_fill_the_unit_cube(rgb):
    for resolution in (0, 4):
        for name, volume in study_scenes.volumes(study_scenes.SCENES["slab"], resolution).items():
            box = volume.bbox()
            assert np.array_equal([box.min, box.max], [[0, 0, 0], [1, 1, 1]]), name
