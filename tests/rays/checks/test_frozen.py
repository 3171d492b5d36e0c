from tests.rays.checks.people import change, warnings_of, watch


def test_who_lost_the_eyes_and_when():
    rays = watch()
    assert warnings_of(rays) == ""
    rows = slice(3000, 6000)
    whole = change(rays, rows, direction=rays.direction[3000])
    assert "the gaze of bo (100 % of the rays) stands still" in warnings_of(whole)
    assert "--without-person" in warnings_of(whole)
    part = change(rays, slice(4000, 5000), direction=rays.direction[4000])
    assert "bo (33 % of the rays)" in warnings_of(part) and "--from, --to" in warnings_of(part)
    # A moment is not worth a word.
    assert "stands still" not in warnings_of(change(rays, slice(4000, 4100), direction=rays.direction[4000]))
