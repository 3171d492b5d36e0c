"""Files of environments as inputs of parts, which may run on other machines."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from nerg_mi.errors import NergError
from nerg_mi.files.safe_read import resolve_path
from nerg_mi.tasks.task import FileGroup

from .scene_loading import list_scene_files


@dataclass(frozen=True)
class PlannedFiles:
    """A scene file, mesh or field with all ``files`` that it refers to, and values of its `<default>`s.

    Identifies a part, and locates the files where the part runs.
    """

    files: FileGroup
    defaults: dict[str, str]

    @staticmethod
    def plan(path: str | Path, defaults: Mapping[str, str] | None = None, *extra_files: Path) -> PlannedFiles:
        """Return the scene file ``path`` with these values and additional files."""
        return PlannedFiles(
            FileGroup(Path(path), (*list_scene_files(path, defaults), *extra_files)), dict(defaults or {})
        )

    def checked_path(self) -> Path:
        """Return the path of the scene file.

        Raises `NergError` if it refers to other files than when the job was planned, as an absolute path may do on a
        worker.
        """
        planned = {resolve_path(path) for path in self.files.members}
        for file in list_scene_files(self.files.path, self.defaults):
            if resolve_path(file) not in planned:
                raise NergError(
                    f'the scene "{self.files.path.name}" reads "{file}", which is not the file that the job was '
                    "planned with; use paths relative to the scene, so that workers find the same files"
                )
        return self.files.path
