from nerg_mi.rays.direction_checks import walking_agreement
from nerg_mi.rays.quality import CHECKS, check_table
from tests.rays.checks.people import walk, warnings_of


def test_nothing_to_say_of_a_plausible_walk():
    assert warnings_of(walk()) == "" and warnings_of(walk(hit=False)) == ""
    assert (walking_agreement(walk())[:2] > 0.5).all()


def test_what_they_are_called():
    """A check is called as its function; what it looks for stands in the manual."""
    assert len({check.name for check in CHECKS}) == len(CHECKS) and all(check.looks_for for check in CHECKS)
    for check in CHECKS:
        assert check.find.__name__ == f"check_{check.name}"
        assert f"| {check.name} | {check.looks_for} |" in check_table()
