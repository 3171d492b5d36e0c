from dataclasses import replace

from tests.rays.checks.people import warnings_of, watch


def test_what_a_reader_complained_of_is_on_the_card():
    rays = watch(3, 400)
    assert warnings_of(rays) == ""
    found = ["the two accounts of ann's gaze differ by 7 degrees: check the calibration"]
    assert warnings_of(replace(rays, metadata={**rays.metadata, "complaints": found})) == found[0]
