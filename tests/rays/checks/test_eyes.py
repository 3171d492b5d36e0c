from dataclasses import replace

import pytest

from tests.rays.checks.people import warnings_of, watch


def said(units="m", **distances):
    rays = watch(max(3, len(distances)), 400)
    about = {**rays.metadata, "eye_distance": distances}
    about["source_frame"] = {"units": units, "up": "z", "handedness": "right"}
    return warnings_of(replace(rays, metadata=about))


@pytest.mark.parametrize(
    "units, metres, remedy",
    [
        ("m", 63.0, "is the unit mm? (--units mm)"),
        ("m", 6.1, "is the unit cm? (--units cm)"),
        ("cm", 0.00062, "is the unit m? (--units m)"),
        ("mm", 0.065e-3, "is the unit m? (--units m)"),
        ("m", 0.126, "is about 0.5 m: scale"),
        ("cm", 0.0315, "is about 0.02 m: scale"),
    ],
)
def test_the_unit_by_the_eyes(units, metres, remedy):
    assert remedy in said(units, ann=metres, bo=metres * 1.02, cy=metres * 0.99)


def test_people_differ():
    assert said(ann=0.052, bo=0.076) == "" and "the eyes of bo are 82 mm apart" in said(ann=0.06, bo=0.082)
    # Half of several people are not all small.
    few, several = dict(ann=0.053, bo=0.054), dict(ann=0.053, bo=0.054, cy=0.053, di=0.052, ed=0.055)
    assert said(**few) == "" and "the eyes are 53 mm apart" in said(**several)
    # Nobody who is not there any more.
    assert said(ann=0.06, zoe=63.0) == "" and said() == ""
