"""Readers of tracking data: rays files, tables, skeletons and the recordings of headsets."""

from __future__ import annotations

import contextlib
import gzip
import io
import json
from pathlib import Path

import numpy as np

from tests.fuzz.describe import Reader


def _rays():
    from nerg_mi.rays.rays import Rays

    rng = np.random.default_rng(0)
    d = rng.normal(size=(40, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    origin = rng.random((40, 3)) + [0, 0, 1.4]
    cohort = np.arange(40) % 2
    # A wide character: what shows it is imported before anything is damaged.
    rays = Rays(
        np.arange(40) * 0.02,
        np.arange(40) % 3,
        ("a", "b", "\u540d"),
        origin,
        d,
        np.ones(40),
        origin + 2 * d,
        cohort=cohort,
        cohorts=("x", "y"),
    )
    about = {
        "transform": np.eye(4).tolist(),
        "sources": [{"file": "a.csv", "sha256": "00" * 32}],
        "rows_read": 42,
        "tick": 1.0,
        "dropped": [{"reason": "blink", "file": "a.csv", "count": 2, "rows": [[3, 4]]}],
        "source_frame": {"up": "y", "handedness": "left", "units": "m"},
    }
    rays.metadata.update(about)
    where = {"position": {"radius": 0.25, "zones": 1, "zone_radius": 0.2, "test_centres": [[0.0, 0.0, 1.5]]}}
    return rays.noting(step="filter", kept=40, of=41, persons=["a"]).noting(
        step="split", side="test", kept=40, of=40, by=where
    )


def _shown(rays) -> None:
    """What the commands ask of rays: the card, a selection, pseudonyms."""
    from nerg_mi.cli.rays import _card
    from nerg_mi.rays.filters import select_mask
    from nerg_mi.rays.pseudonyms import pseudonymise

    with contextlib.redirect_stdout(io.StringIO()):
        _card(rays, Path("rays.npz"))
    rays.select(select_mask(rays, time=(0, 1), with_hit=True))
    pseudonymise(rays, bytes(16))


def _rays_file(name: str, *kinds: str) -> Reader:
    def read(folder: Path) -> None:
        from nerg_mi.rays.rays import Rays

        _shown(Rays.load(folder / name))

    return Reader(f"rays {name}", lambda folder: _rays().save(folder / name), {name: kinds}, read)


def _make_metadata(folder: Path) -> None:
    rays = _rays()
    about = {"version": 1, **rays.metadata, "persons": list(rays.persons), "cohorts": list(rays.cohorts)}
    (folder / "metadata.json").write_text(json.dumps(about))


def _read_metadata(folder: Path) -> None:
    from dataclasses import replace

    from nerg_mi.rays.metadata import read_metadata

    about = read_metadata((folder / "metadata.json").read_bytes(), folder / "metadata.json")
    persons, cohorts = about.pop("persons"), about.pop("cohorts", [])
    _shown(replace(_rays(), metadata=about, persons=persons, cohorts=cohorts))


_MAP = "origin=x,y,z direction=a,b,c t=t person=who confidence=conf hit=h,i,j"


def _table() -> str:
    rows = [
        f"{0.02 * k},{'ann' if k % 2 else 'bo'},0.{k},1,1.6,1,0.{k},0,1,{k},2,{'' if k % 3 else k}" for k in range(20)
    ]
    return "\n".join(["t,who,x,y,z,a,b,c,conf,h,i,j", *rows]) + "\n"


def _tables(name: str, make, *kinds: str, **options) -> Reader:
    def read(folder: Path) -> None:
        from nerg_mi.rays.readers.table import rays_from_table

        _shown(rays_from_table([folder / name], _MAP, **options))

    said = " skipping" if options else ""
    return Reader(f"table {name}{said}", lambda folder: make(folder / name), {name: kinds}, read)


def _make_parquet(path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    names = [c for c in "t x y z a b c conf h i j".split()]
    columns = {name: np.arange(60.0) / 50 for name in names}
    pq.write_table(pa.table({**columns, "conf": np.ones(60), "who": ["ann", "bo"] * 30}), path)


def _make_skeleton(path: Path) -> None:
    from nerg_mi.rays.readers.parsing.skeleton_file import write_skeleton
    from nerg_mi.rays.readers.skeleton22 import keypoints_from_head

    body = keypoints_from_head(np.array([[0.1 * k, 0, 1.65] for k in range(6)]), np.tile([0.0, 1.0, 0.0], (6, 1)))
    write_skeleton(path, ["ann", "bo"] * 3, np.arange(6), body, decimals=2)


def _skeletons(name: str, *kinds: str, skip: bool = False) -> Reader:
    def read(folder: Path) -> None:
        from nerg_mi.rays.readers.parsing.skeleton_file import read_skeleton
        from nerg_mi.rays.readers.skeleton22 import rays_from_skeleton

        _shown(rays_from_skeleton(folder / name, tick=0.1, skip_bad_lines=skip))
        if not skip:
            read_skeleton(folder / name)

    return Reader(
        f"skeleton {name}{' skipping' if skip else ''}",
        lambda folder: _make_skeleton(folder / name),
        {name: kinds},
        read,
    )


def _recording(preset: str, files: dict[str, str], **options) -> Reader:
    def make(folder: Path) -> None:
        for name, text in files.items():
            (folder / name).write_bytes(
                gzip.compress(text.encode(), mtime=0) if name.endswith(".gz") else text.encode()
            )

    def read(folder: Path) -> None:
        from nerg_mi.rays.readers.vr_supermarket import PRESETS

        _shown(PRESETS[preset].read([folder / list(files)[-1]], **options))

    kinds = {name: ("gzip",) if name.endswith(".gz") else ("text",) for name in files}
    return Reader(f"preset {preset}", make, kinds, read)


def _lines(head: list[str] | None, row, separator: str = ",") -> str:
    lines = [separator.join(map(str, row(k))) for k in range(8)]
    return "\n".join([*([separator.join(head)] if head else []), *lines]) + "\n"


_VR = [
    f"ctw_{i}{j}" for i in range(3) for j in range(4)
] + "ray_x ray_y ray_z eye_x eye_y eye_z xc yc zc opennessl opennessr time".split()
_UNITY = "time id gaze_origin_x gaze_origin_y gaze_origin_z gaze_dir_x gaze_dir_y gaze_dir_z status".split()
_LOCAL = [
    "time",
    *(f"head_pos_{a}" for a in "xyz"),
    *(f"head_rot_{a}" for a in "xyzw"),
    *(f"gaze_dir_{a}" for a in "xyz"),
]
_POSES = ["timestamp", *(f"{what}_{axis}" for what in ("rotation", "translation") for axis in "xyz")]
_GAZE = [
    "gaze_timestamp",
    "confidence",
    *(f"gaze_normal{e}_{a}" for e in "01" for a in "xyz"),
    *(f"eye_center{e}_3d_{a}" for e in "01" for a in "xyz"),
]

_PRESETS = [
    _recording(
        "vr_supermarket",
        {
            "user1.csv.gz": _lines(
                _VR, lambda k: [1, 0, 0, k, 0, 1, 0, 1.6, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 1, k, 0.9, 0.8, 0.02 * k]
            )
        },
    ),
    _recording("unity", {"ann.csv": _lines(_UNITY, lambda k: [0.02 * k, "ann", 0, 1.6, k, 0, 0, 1, "VALID"])}),
    _recording("unity_local", {"ann.csv": _lines(_LOCAL, lambda k: [0.02 * k, 0, 1.6, k, 0, 0, 0, 1, 0, 0.1, 1])}),
    _recording("unity_head", {"ann.csv": _lines(_LOCAL[:8], lambda k: [0.02 * k, 0, 1.6, k, 0, 0, 0, 1])}),
    _recording(
        "varjo",
        {
            "ann.csv": _lines(
                [
                    "CaptureTime",
                    "HMDPosition",
                    "HMDRotation",
                    "CombinedGazePosition",
                    "CombinedGazeForward",
                    "GazeStatus",
                ],
                lambda k: [k * 10**7, "(0, 1.6, 0)", "(0, 0, 0, 1)", "(0, 0, 0)", "(0, 0, 1)", "VALID"],
                ";",
            )
        },
        skip_bad_lines=True,
    ),
    _recording(
        "hololens",
        {"a_head_hand_eye.csv": _lines(None, lambda k: [k * 10**5, *[0] * 850, 1, 0, 1.6, 0, 1, 0, 0, 1, 0, 2])},
    ),
    _recording(
        "pupil",
        {
            "head_pose_tracker_poses.csv": _lines(_POSES, lambda k: [0.02 * k, 0, 0, 0.1, k, 1, 1]),
            "gaze_positions.csv": _lines(_GAZE, lambda k: [0.02 * k, 0.9, *[0, 0.1, 1] * 4]),
        },
        marker=0.05,
    ),
]


def _make_salt(folder: Path) -> None:
    (folder / "salt").write_bytes(bytes(range(32)))


def _read_salt(folder: Path) -> None:
    from nerg_mi.rays.pseudonyms import read_salt

    read_salt(folder / "salt")


TRACKING = [
    _rays_file("rays.npz", "zip"),
    _rays_file("rays.parquet"),
    Reader("rays metadata", _make_metadata, {"metadata.json": ("json",)}, _read_metadata),
    _tables("gaze.csv", lambda path: path.write_text(_table()), "text"),
    _tables("gaze.csv", lambda path: path.write_text(_table()), "text", skip_bad_lines=True),
    _tables("gaze.csv.gz", lambda path: path.write_bytes(gzip.compress(_table().encode(), mtime=0)), "gzip"),
    _tables("gaze.parquet", _make_parquet),
    _skeletons("day.csv", "text"),
    _skeletons("day.csv", "text", skip=True),
    _skeletons("day.csv.gz", "gzip"),
    *_PRESETS,
    Reader("salt", _make_salt, {"salt": ()}, _read_salt),
]
