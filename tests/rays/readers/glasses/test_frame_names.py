"""Names of frames and their times."""

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.rays.readers.glasses.frame_names import FrameNames

FRAMES = np.array([0.5, 0.54, 0.57, 0.61])


@pytest.mark.parametrize(
    "pattern, name, seconds",
    [
        ("frame_{frame1}", "images/frame_00002.jpg", 0.54),
        ("frame_{frame0}", "frame_2.png", 0.57),
        ("{frame0}", "a/b/c/0003", 0.61),
        ("scene/*_{frame1}", "x/scene/neon_take2_0001.jpeg", 0.5),
        ("{recording}/{frame1}", "images/ann (2)/4.jpg", 0.61),
        ("t{s}", "t12.25.jpg", 12.75),
        ("t{s}", "t3.jpg", 3.5),
        ("{ns}", "1700000000250000000.png", 0.25),
        ("frame_{frame1}", "images/photo_00002.jpg", None),
        ("frame_{frame1}", "images/myframe_00002.jpg", None),
        ("f.{frame1}", "fx2.jpg", None),
    ],
)
def test_times(pattern, name, seconds):
    names = FrameNames.parse(pattern)
    assert str(names) == pattern and names.of_recording == ("recording" in pattern)
    if seconds is None:
        with pytest.raises(NergError, match="no image of the model is called"):
            names.times([name], "ann (2)", FRAMES, None, 1.7e18)
        return
    found = names.times([name, "IMG_77x.JPG"], "ann (2)", FRAMES, None, 1.7e18)
    assert np.allclose(found, [seconds, np.nan], equal_nan=True)


def test_a_steady_rate():
    assert np.allclose(FrameNames("{frame1}").times(["1", "6"], "", FRAMES, 5.0, 0), [0.5, 1.5])
    assert np.allclose(FrameNames("{frame0}").times(["1", "6"], "", None, 2.0, 0), [0.5, 3.0])


@pytest.mark.parametrize(
    "pattern, name, frames, fps, message",
    [
        ("{frame1}", "0", FRAMES, None, "frame -1 of the video"),
        ("{frame1}", "0", FRAMES, 5.0, "frame -1 of the video"),
        ("{frame1}", "5", FRAMES, None, "frame 4 of the video, counted from 0, which has 4"),
        ("{frame0}", "5", None, None, "--fps"),
    ],
)
def test_frames_that_there_are_not(pattern, name, frames, fps, message):
    with pytest.raises(NergError, match=message):
        FrameNames(pattern).times([name], "", frames, fps, 0)


@pytest.mark.parametrize("pattern", ["", "frame_*", "{frame0}_{s}", "{frame1}{frame1}", "{number}"])
def test_patterns_without_a_time(pattern):
    with pytest.raises(NergError, match="--frames is .*; write the names"):
        FrameNames.parse(pattern)
