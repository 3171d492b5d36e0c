"""A small recording of each reader: what its contract and the fuzzer are tried on. A new reader needs one here."""

from __future__ import annotations

import gzip
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.rays.readers.columns import ColumnMap
from nerg_mi.rays.readers.skeleton import keypoints_from_head, write_skeleton
from tests.rays.readers import headset_examples as headsets
from tests.rays.readers import scene_examples as scenes
from tests.rays.readers.c3d_examples import write_heads


@dataclass(frozen=True)
class Example:
    """Files by name, as text or as a function that writes one; the last of them is what is given to the reader."""

    files: dict[str, str | Callable[[Path], None]]
    options: dict[str, Any] = field(default_factory=dict)

    def make(self, folder: Path) -> Path:
        """Write the files into ``folder``; the path to give to the reader."""
        for name, content in self.files.items():
            if callable(content):
                content(folder / name)
            elif name.endswith(".gz"):
                (folder / name).write_bytes(gzip.compress(content.encode(), mtime=0))
            else:
                (folder / name).write_text(content)
        return self.given(folder)

    def given(self, folder: Path) -> Path:
        """The path to give to the reader, of files that lie in ``folder``."""
        return folder / list(self.files)[-1]

    def options_in(self, folder: Path) -> dict[str, Any]:
        """The options, files among them as they lie in ``folder``."""
        return {name: folder / v if isinstance(v, Path) else v for name, v in self.options.items()}


def lines(head: list[str] | None, row: Callable[[int], list], separator: str = ",", count: int = 8) -> str:
    """A table of ``count`` rows, with a header or without."""
    rows = [separator.join(map(str, row(k))) for k in range(count)]
    return "\n".join([*([separator.join(head)] if head else []), *rows]) + "\n"


def write_walk(path: Path) -> None:
    """Two people's skeletons."""
    body = keypoints_from_head(np.array([[0.1 * k, 0, 1.65] for k in range(6)]), np.tile([0.0, 1.0, 0.0], (6, 1)))
    write_skeleton(path, ["ann", "bo"] * 3, np.arange(6), body, decimals=2)


MAP = "origin=x,y,z direction=a,b,c t=t person=who confidence=conf hit=h,i,j"
TABLE = lines(
    "t,who,x,y,z,a,b,c,conf,h,i,j".split(","),
    lambda k: [f"{0.02 * k},{'ann' if k % 2 else 'bo'},0.{k},1,1.6,1,0.{k},0,1,{k},2,{'' if k % 3 else k}"],
    count=20,
)

_SUPERMARKET = [f"ctw_{i}{j}" for i in range(3) for j in range(4)]
_SUPERMARKET += "ray_x ray_y ray_z eye_x eye_y eye_z xc yc zc opennessl opennessr time".split()
_UNITY = "time id gaze_origin_x gaze_origin_y gaze_origin_z gaze_dir_x gaze_dir_y gaze_dir_z status".split()
_LOCAL = ["time", *(f"head_pos_{a}" for a in "xyz"), *(f"head_rot_{a}" for a in "xyzw")]
_LOCAL += [f"gaze_dir_{a}" for a in "xyz"]
_VARJO = "CaptureTime HMDPosition HMDRotation CombinedGazePosition CombinedGazeForward GazeStatus".split()
_POSES = ["timestamp", *(f"{what}_{axis}" for what in ("rotation", "translation") for axis in "xyz")]
_GAZE = ["gaze_timestamp", "confidence", *(f"gaze_normal{e}_{a}" for e in "01" for a in "xyz")]
_GAZE += [f"eye_center{e}_3d_{a}" for e in "01" for a in "xyz"]

ARIA_POSES = ["graph_uid", "tracking_timestamp_us", "utc_timestamp_ns", *(f"t{a}_world_device" for a in "xyz")]
ARIA_POSES += [f"q{a}_world_device" for a in "xyzw"] + [f"gravity_{a}_world" for a in "xyz"] + ["quality_score"]
_ARIA_GAZE = "tracking_timestamp_us yaw_rads_cpf pitch_rads_cpf depth_m".split()
_NAVGS = [
    f"{what}{a}" for what in ("Position", "Quaternion", "GazeQ") for a in ("XYZ" if what == "Position" else "XYZW")
]


def aria_pose(us: int, world: str = "w", place=(0, 0, 1.6), gravity=(0, 0, -9.81), turn=(0.5, 0.5, -0.5, 0.5)) -> list:
    """A row of a trajectory of Aria's; by default the wearer stands upright."""
    return [world, us, -1, *place, *turn, *gravity, 1.0]


_ARIA_EYES = [f"{what}_{side}_eye_cpf" for side in ("left", "right") for what in ("tx", "ty", "tz")]
_ARIA_POSES = {"aria_trajectory.csv": lines(ARIA_POSES, lambda k: aria_pose(10_000 * k, world=f"w{k > 6}"))}
_ARIA_GEN2 = "tracking_timestamp_us yaw_rads_cpf pitch_rads_cpf left_pitch_rads_cpf right_pitch_rads_cpf".split()
_ARIA_VERGENCE = "tracking_timestamp_us left_yaw_rads_cpf right_yaw_rads_cpf pitch_rads_cpf depth_m".split()

VARIANTS = {
    "aria": [
        Example(
            _ARIA_POSES | {"generalized_gaze.csv": lines(_ARIA_VERGENCE, lambda k: [9000 * k, 0.1, 0.12, -0.2, 1.5])}
        ),
        Example(
            _ARIA_POSES
            | {
                "eyegaze.csv": lines(
                    [*_ARIA_GEN2, *_ARIA_EYES], lambda k: [9000 * k, 0.1, -0.2, -0.2, -0.2, 0.03, 0, 0, -0.03, 0, 0]
                )
            }
        ),
    ]
}
"""Recordings of other kinds that readers tell apart by what is in the files: for the fuzzer besides `EXAMPLES`."""

_SCENE = {"poses": Path("transforms.json"), "frames": scenes.FRAMES}

EXAMPLES = {
    "skeleton": Example({"day.csv": write_walk}, {"tick": 0.1}),
    "c3d": Example({"ann.c3d": write_heads}),
    "unity": Example({"ann.csv": lines(_UNITY, lambda k: [0.02 * k, "ann", 0, 1.6, k, 0, 0, 1, "VALID"])}),
    "unity_local": Example({"ann.csv": lines(_LOCAL, lambda k: [0.02 * k, 0, 1.6, k, 0, 0, 0, 1, 0, 0.1, 1])}),
    "unity_head": Example({"ann.csv": lines(_LOCAL[:8], lambda k: [0.02 * k, 0, 1.6, k, 0, 0, 0, 1])}),
    "varjo": Example(
        {
            "ann.csv": lines(
                _VARJO, lambda k: [k * 10**7, "(0, 1.6, 0)", "(0, 0, 0, 1)", "(0, 0, 0)", "(0, 0, 1)", "VALID"], ";"
            )
        }
    ),
    "hololens": Example(
        {"a_head_hand_eye.csv": lines(None, lambda k: [k * 10**5, *[0] * 850, 1, 0, 1.6, 0, 1, 0, 0, 1, 0, 2])}
    ),
    "arett": Example(headsets.ARETT),
    "sranipal": Example(headsets.SRANIPAL),
    "openxr": Example(headsets.OPENXR),
    "quest": Example(headsets.QUEST),
    "pupil": Example(
        {
            "head_pose_tracker_poses.csv": lines(_POSES, lambda k: [0.02 * k, 0, 0, 0.1, k, 1, 1]),
            "gaze_positions.csv": lines(_GAZE, lambda k: [0.02 * k, 0.9, *[0, 0.1, 1] * 4]),
        },
        {"marker": 0.05},
    ),
    "qualisys": Example(
        {
            "ann_g.tsv": lines(
                ["X Pos", "Y Pos", "Z Pos", "X Vec", "Y Vec", "Z Vec"],
                lambda k: [10 * k, "" if k == 3 else 0, 1600, 0.1 * k, 1, -0.2],
                "\t",
            ).join(["GAZE_VECTOR_NAME\tann\nNO_OF_SAMPLES\t8\nFREQUENCY\t100\nSTART_OFFSET\t0.5\n", ""])
        }
    ),
    "motive": Example({"ann.csv": headsets.MOTIVE}),
    "neon_mocap": Example(
        {
            "gaze_in_mocap_space.csv": lines(
                ["", "timestamp [ns]", *(f"gaze_{what}_{a}" for what in ("origin", "dir") for a in "XYZ")],
                lambda k: [k, 1_700_000_000_000_000_000 + 10**7 * k, 0, 10 * k, 1600, 0.1, 1, -0.2],
            )
        },
        {"up": "z"},
    ),
    "aria": Example(
        {
            "closed_loop_trajectory.csv": lines(ARIA_POSES, lambda k: aria_pose(10_000 * k, place=(0.01 * k, 0, 1.6))),
            "general_eye_gaze.csv": lines(_ARIA_GAZE, lambda k: [10_000 * k + 500, 0.1, -0.2, "" if k % 2 else 1.5]),
        }
    ),
    "eyenavgs": Example(
        {
            "scene_setting.csv": 'Scene_Name,Quaternion,Scale,Initial_Position\nroom,"0, 0, 0, 1",2,"0, 0.8, 0"\n',
            "user1_room.csv": lines(
                ["ViewIndex", *_NAVGS, "Timestamp"],
                lambda k: [k % 2, 0.1 * k, 0.8, 0, 0, 0.1 * (k // 2), 0, 1, 0.1, 0.02 * k, 0, 1, 14 * (k // 2)],
            ),
        }
    ),
    "vr_supermarket": Example(
        {
            "user1.csv.gz": lines(
                _SUPERMARKET,
                lambda k: [1, 0, 0, k, 0, 1, 0, 1.6, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 1, k, 0.9, 0.8, 0.02 * k],
            )
        }
    ),
    "neon": Example(scenes.NEON, _SCENE),
    "tobii3": Example(scenes.TOBII, _SCENE),
    "glassestools": Example(scenes.GLASSESTOOLS, _SCENE),
    "table": Example({"gaze.csv": TABLE}, {"columns": ColumnMap.parse(MAP)}),
}
