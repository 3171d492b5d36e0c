"""What readers of glasses with a scene camera share: a folder a recording, read against the poses of its camera."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Generic, TypeVar

from nerg_mi.errors import NergError
from nerg_mi.rays.readers.builder import RaysBuilder
from nerg_mi.rays.readers.frames import Frame

from .scene_gaze import GazeBlock, Recording, SceneGaze, SceneOptions

R = TypeVar("R", bound=Recording)
"""What a reader knows of a recording."""


class SceneReader(ABC, Generic[R]):
    """A reader of folders, each a recording of glasses whose scene camera's poses are known in the place.

    A format says what its file of the gaze is called, opens a recording, and gives its gaze block by block in the scene
    camera's frame; whose rays that are in the place is worked out here (`nerg_mi.rays.readers.protocol.Reader`).
    """

    gaze_file: str
    """Name of the file of the gaze in the folder."""

    accounts: str = ""
    """The two accounts of one gaze that are compared, as "pixels and angles"; empty where there is one."""

    world = "the place's, whose axis `--up` points up"
    Options = SceneOptions

    @abstractmethod
    def open(self, folder: Path, builder: RaysBuilder) -> R:
        """What is known of the recording in ``folder``; each file that is read is named to ``builder.source``."""

    @abstractmethod
    def blocks(self, gaze: Path, recording: R, builder: RaysBuilder) -> Iterable[GazeBlock]:
        """The rows of the file ``gaze`` of an open recording."""

    def frame(self, files: Sequence[Path], options: SceneOptions) -> Frame:
        return options.frame

    def read(self, files: Sequence[Path], options: SceneOptions, builder: RaysBuilder) -> None:
        _check_recordings(files, options)
        about: list[dict[str, Any]] = []
        for given in files:
            folder, gaze = _recording_folder(given, self.gaze_file)
            recording = self.open(folder, builder)
            scene = SceneGaze(options, recording, builder, about)
            builder.source(gaze, f"{recording.person}/{gaze.name}")
            for block in self.blocks(gaze, recording, builder):
                scene.add(block)
            scene.finish(self.accounts)


def _recording_folder(given: Path, gaze: str) -> tuple[Path, Path]:
    """The folder of a recording and the file of its gaze, where either was ``given``; ``gaze``: the file's name."""
    path = given / gaze if given.is_dir() else given
    if not path.is_file():
        raise NergError(f"there is no {path}; give the folder of a recording, or the {gaze} in it")
    return path.parent, path


def _check_recordings(files: Sequence[Path], options: SceneOptions) -> None:
    """Raise `NergError` for several recordings whose frames the model's names do not tell apart."""
    if len(files) > 1 and (options.frames is None or not options.frames.of_recording):
        raise NergError(
            "frames of several recordings are told apart by {recording} in their names (--frames); import them one by "
            'one, or name them as in --frames "{recording}/frame_{frame1}"'
        )
