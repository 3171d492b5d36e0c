from nerg_mi.rays.checks.walking import walking_agreement
from tests.rays.checks.people import walk, warnings_of


def test_nothing_to_say_of_a_plausible_walk():
    assert warnings_of(walk()) == "" and warnings_of(walk(hit=False)) == ""
    assert (walking_agreement(walk())[:2] > 0.5).all()
