"""Trajectories of Project Aria: poses of the glasses, world by world, and which way is up in them."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.files.bounded import plain
from nerg_mi.files.line_blocks import OnBadLine
from nerg_mi.rays.readers.parsing.pose_track import PoseTrack
from nerg_mi.rays.readers.parsing.tables import TableBlock, iterate_table

_TIME = "tracking_timestamp_us"
_PLACE = [f"t{axis}_world_device" for axis in "xyz"]
_TURN = [f"q{axis}_world_device" for axis in "xyzw"]
_GRAVITY = [f"gravity_{axis}_world" for axis in "xyz"]
_WORLDS = 1000  # a file of more is no trajectory
_EDGE = 1e-3  # seconds: so much before the first pose and after the last, a head is where it is then
_STRAIGHT = np.cos(np.radians(1.0))


def up_axis(path: Path) -> str:
    """The axis that points up in the trajectory ``path``, by the gravity of its first pose: x, y, z, -x, -y or -z.

    Raises `NergError` for a file without poses, or a gravity along no axis.
    """
    # Bad lines are told when the poses are read.
    for block in iterate_table(path, _GRAVITY, on_bad=lambda line, why: None):
        known = block.numbers[np.isfinite(block.numbers).all(axis=1)]
        if len(known):
            return _against(path, known[0])
    raise NergError(f"the trajectory {path} holds no poses with their gravity; have it made again by MPS")


def _against(path: Path, gravity: np.ndarray) -> str:
    """The name of the axis against ``gravity`` (3,)."""
    length = np.linalg.norm(gravity)
    shares = -gravity / length if length > 0 else np.zeros(3)
    k = int(np.abs(shares).argmax())
    if not abs(shares[k]) > _STRAIGHT:
        said = " ".join(f"{x:.3g}" for x in gravity)
        raise NergError(
            f"the gravity of the trajectory {path} ({said}) lies along no axis of its world, so that nobody knows "
            "which way is up; turn its poses and its gravity so that one axis points up"
        )
    return ("-" if shares[k] < 0 else "") + "xyz"[k]


@dataclass
class _World:
    """Poses of one world, as far as they are kept."""

    gravity: np.ndarray  # (3,) of its first pose
    poses: list[np.ndarray] = field(default_factory=list)  # (n, 8): seconds, place, quaternion x, y, z, w


class Trajectory:
    """Poses of the glasses in a recording, of which those around the times that are asked for are kept."""

    def __init__(self, path: Path, times: np.ndarray, on_bad: OnBadLine | None) -> None:
        """Read ``path`` for gaze at ``times`` (n,) seconds. Raises `NergError` for a file that is no trajectory."""
        self.path, self.lines = path, 0
        self._times = np.sort(times[np.isfinite(times)])
        self._worlds: dict[str, _World] = {}
        for block in iterate_table(path, [_TIME, *_PLACE, *_TURN, *_GRAVITY], ["graph_uid"], on_bad=on_bad):
            self._keep(block)
            self.lines += len(block.lines)
        self.tracks = {uid: track for uid, w in self._worlds.items() if (track := _track(w)) is not None}
        if not self.tracks:
            raise NergError(f"{path} holds {self.lines} poses; two of one world are needed to interpolate between")

    def up(self, world: str) -> str:
        """The axis that points up in ``world``, one of `tracks`."""
        return _against(self.path, self._worlds[world].gravity)

    def _keep(self, block: TableBlock) -> None:
        names, which = np.unique(block.texts[:, 0], return_inverse=True)
        for k, name in enumerate(names.tolist()):
            v = block.numbers[which == k]
            v = v[np.isfinite(v).all(axis=1)]
            if not len(v):
                continue
            world = self._worlds.setdefault(name, _World(v[0, 8:]))
            if len(self._worlds) > _WORLDS:
                raise NergError(
                    f"the trajectory {self.path} has more than {_WORLDS:,} worlds (graph_uid); have it made again "
                    "by MPS"
                )
            off = np.abs(v[:, 8:] - world.gravity).max()
            if off > 0.02 * np.linalg.norm(world.gravity):
                raise NergError(
                    f"the gravity of the world {plain(name, 40)} changes in the trajectory {self.path}, so that nobody "
                    "knows which way is up; have it made again by MPS"
                )
            v = v[np.argsort(v[:, 0], kind="stable")]
            v[:, 0] *= 1e-6
            # Of a thousand poses a second those around each gaze are needed, and a block's ends for gaze between two.
            near = np.searchsorted(v[:, 0], self._times[slice(*np.searchsorted(self._times, v[[0, -1], 0]))])
            kept = np.unique(np.clip(np.r_[0, near - 1, near, len(v) - 1], 0, len(v) - 1))
            world.poses.append(v[kept, :8])


def _track(world: _World) -> PoseTrack | None:
    from scipy.spatial.transform import Rotation

    v = np.concatenate(world.poses)
    length = np.linalg.norm(v[:, 4:], axis=1)
    v = v[np.isfinite(length) & (length > 1e-12)]
    if not len(v):
        return None
    return PoseTrack.of_samples(v[:, 0], Rotation.from_quat(v[:, 4:]).as_rotvec(), v[:, 1:4])


def poses_at(track: PoseTrack, t: np.ndarray, gap: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """As `PoseTrack.at`, with times up to a millisecond outside taken as the track's ends: ground truth has its gaze
    some microseconds before its poses."""
    ends = track.times[[0, -1]]
    near = np.clip(t, *ends)
    return track.at(np.where(np.abs(t - near) <= _EDGE, near, t), gap)
