"""Names of frames and their times."""

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.rays.readers.scene_glasses import FrameNames

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
        with pytest.raises(NergError, match="image of the model"):
            names.times([name], "ann (2)", FRAMES, None, 1.7e18)
        return
    found = names.times([name, "IMG_77x.JPG"], "ann (2)", FRAMES, None, 1.7e18)
    assert np.allclose(found, [seconds, np.nan], equal_nan=True)


@pytest.mark.parametrize(
    "fps, shown",
    [
        # What FFmpeg's filter fps gives of frames numbered from 0 at 24.95 a second.
        (5.0, [2, 7, 12, 17, 22, 27, 32, 37, 42, 47, 52, 57]),
        (10.0, [1, 3, 6, 8, 11, 13, 16, 18, 21, 23, 26, 28]),
        (40.0, [0, 0, 1, 2, 2, 3, 4, 4, 5, 5, 6, 7]),
    ],
)
def test_a_steady_rate(fps, shown):
    frames = 0.5 + np.arange(60) / 24.95
    found = FrameNames("{frame0}").times([str(k) for k in range(12)], "", frames, fps, 0)
    assert np.allclose(found, frames[shown])
    assert np.allclose(FrameNames("{frame0}").times(["1", "6"], "", None, 2.0, 0), [0.5, 3.0])


@pytest.mark.parametrize(
    "pattern, name, frames, fps, message",
    [
        ("{frame1}", "0", FRAMES, None, "frame -1 of the video"),
        ("{frame1}", "0", FRAMES, 5.0, "frame -1 of the video"),
        ("{frame1}", "0", None, 5.0, "frame -1 of the video"),
        ("{frame1}", "5", FRAMES, None, "frame 4 of the video, counted from 0, which has 4"),
        ("{frame0}", "2", FRAMES, 5.0, r"frame 2 .* which has 4 \(5 a second were counted\)"),
        ("{frame0}", "5", None, None, "scene video.*--fps"),
    ],
)
def test_frames_that_there_are_not(pattern, name, frames, fps, message):
    with pytest.raises(NergError, match=message):
        FrameNames(pattern).times([name], "", frames, fps, 0)


@pytest.mark.parametrize("pattern", ["", "frame_*", "{frame0}_{s}", "{frame1}{frame1}", "{number}"])
def test_patterns_without_a_time(pattern):
    with pytest.raises(NergError, match="--frames"):
        FrameNames.parse(pattern)
