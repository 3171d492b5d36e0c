"""Presets: recordings whose columns, frame and validity marks are known.

Each is a function of files; :data:`PRESETS` names them for the command line.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.rays.rays import Rays

from . import unity as headsets
from .builder import RaysBuilder
from .frames import to_rays_frame
from .parsing.tables import iterate_table
from .skeleton22 import rays_from_skeleton
from .table import Paths, person_from_filename


def vr_supermarket(paths: Paths, *, min_openness: float = 0.5, skip_bad_lines: bool = False) -> Rays:
    """Eye gaze of people in a VR supermarket, one gzip CSV a person, 50 Hz.

    Recorded with "Fixation-based Self-calibration for Eye Tracking in VR
    Headsets" (github: ryuryu0226). ``ctw_ij`` is camera-to-world in Unity's
    world (y up, left-handed, metres), whose camera looks along minus column 2;
    ``ray`` and ``eye`` are in the camera frame with +z forward, so with R, t of
    that matrix: direction = R (rx, ry, -rz), origin = t + R (ex, ey, -ez).
    ``xc, yc, zc`` is where the combined gaze met the shop.

    A row is kept when both eyes are open by more than ``min_openness``; the
    smaller openness becomes the confidence. A missing hit is NaN. The person is
    ``userN`` of the file name. Rays come out mirrored to (x, z, y): right-handed
    with z up.
    """
    matrix = [f"ctw_{i}{j}" for i in range(3) for j in range(4)]
    names = [
        *matrix,
        "ray_x",
        "ray_y",
        "ray_z",
        "eye_x",
        "eye_y",
        "eye_z",
        "xc",
        "yc",
        "zc",
        "opennessl",
        "opennessr",
        "time",
    ]
    frame = {"up": "y", "handedness": "left", "units": "m"}
    builder = RaysBuilder(
        transform=to_rays_frame(**frame),
        preset="vr_supermarket",
        source_frame=frame,
        min_openness=min_openness,
        skip_bad_lines=skip_bad_lines,
    )
    for path in map(Path, paths):
        builder.source(path)
        user = re.search(r"user\d+", path.name)
        for values, _, lines in iterate_table(path, names, on_bad=builder.on_bad):
            pose = values[:, :12].reshape(-1, 3, 4)
            flip = np.array([1.0, 1.0, -1.0])  # +z forward to the camera of the matrix
            rotate = lambda v: np.einsum("nij,nj->ni", pose[:, :, :3], v * flip)
            openness = np.minimum(values[:, 21], values[:, 22])
            builder.add(
                values[:, 23],
                user.group() if user else person_from_filename(path),
                pose[:, :, 3] + rotate(values[:, 15:18]),
                rotate(values[:, 12:15]),
                rows=lines,
                confidence=np.clip(openness, 0.0, 1.0),
                hit=values[:, 18:21],
                drop={f"an eye is closed (openness at most {min_openness:g})": openness <= min_openness},
            )
    return builder.build()


@dataclass(frozen=True)
class Preset:
    """A known recording: ``read(paths, **options)`` returns its rays; each knows ``skip_bad_lines`` (see
    `RaysBuilder`), and the ``options`` named here."""

    summary: str
    read: Callable[..., Rays]
    options: tuple[str, ...] = ()


PRESETS = {
    "skeleton22": Preset(
        "22-keypoint skeletons, id|time|[66 floats], metres, z up: ears to nose",
        rays_from_skeleton,
        ("tick", "keypoints", "pitch"),
    ),
    "vr_supermarket": Preset("VR supermarket eye gaze, one CSV a person (Unity frame)", vr_supermarket),
    "unity": Preset(
        "Unity logs of gaze in the world: gaze_origin_*, gaze_dir_* (or gaze_direction_*, gaze_forward_*)",
        headsets.unity,
        ("tick",),
    ),
    "unity_local": Preset(
        "Unity logs of gaze in the head's frame, beside head_pos_* and head_rot_*", headsets.unity_local, ("tick",)
    ),
    "unity_head": Preset("Unity logs of heads: head_pos_*, head_rot_*", headsets.unity_head, ("tick",)),
    "varjo": Preset("the log of Varjo's eye tracking example for Unity", headsets.varjo),
    "hololens": Preset("*_head_hand_eye.csv of HoloLens 2's StreamRecorder", headsets.hololens),
    "pupil": Preset(
        "Pupil Core exports with the head pose tracker's", headsets.pupil, ("marker", "up", "min_confidence")
    ),
}


def preset(name: str) -> Preset:
    """The preset of this name. Raises `NergError` naming those there are."""
    if name not in PRESETS:
        raise NergError(f'there is no preset "{name}"; choose one of {", ".join(PRESETS)}, or give a column map')
    return PRESETS[name]
