"""A lens on images of other sizes."""

from nerg_mi.photos.cameras import Intrinsics


def test_a_resized_image_is_seen_through_the_same_lens():
    lens = Intrinsics(40, 20, 30.0, 31.0, 19.0, 11.0, 0.1, p2=0.01)
    half = lens.resized(20, 5)
    assert (half.width, half.height, half.fx, half.fy, half.cx, half.cy) == (20, 5, 15.0, 7.75, 9.5, 2.75)
    assert half.distortion == lens.distortion and half.resized(40, 20) == lens


def test_what_bends_the_picture():
    plain = Intrinsics(4, 4, 3.0, 3.0, 2.0, 2.0)
    assert not plain.is_distorted and plain.distortion == (0.0,) * 8
    assert Intrinsics(4, 4, 3.0, 3.0, 2.0, 2.0, k6=1e-3).is_distorted
    assert Intrinsics(4, 4, 3.0, 3.0, 2.0, 2.0, fisheye=True).is_distorted
