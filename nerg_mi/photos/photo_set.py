"""Sets of posed photos: loading and data frames."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from nerg_mi.errors import MissingFile, sanitize
from nerg_mi.files import html
from nerg_mi.files.dataframes import make_dataframe
from nerg_mi.files.safe_read import is_regular_file, resolve_path
from nerg_mi.files.values import FilePath, to_path

from .colmap import describe_other_models, find_pose_source, read_colmap, read_image_names
from .posed import PosedImages
from .transforms import read_transforms

PHOTO_SUFFIXES = (".png", ".jpg", ".jpeg", ".exr")
"""Suffixes of photos, in lower case."""


@dataclass(frozen=True, repr=False, eq=False)
class Photos(PosedImages):
    """Posed photos: the poses and lenses of their cameras, and where their files are.

    >>> import nerg_mi as nerg
    >>> loaded = nerg.Photos.load(photos)  # photos: a folder of posed photos
    >>> loaded
    <Photos transforms.json: photos 4, cameras span 0.1 x 1.8 x 0.1 units>
    >>> loaded.to_dataframe().shape
    (4, 7)
    """

    @classmethod
    def load(cls, path: FilePath, allow_outside: bool = False) -> Photos:
        """Load the poses and lenses of photos. Images are not read.

        Parameters
        ----------
        path : path
            Their folder, its transforms.json, or a COLMAP model.
        allow_outside : bool
            Whether files outside of the folder may be used. For a COLMAP model, this is the folder that contains its
            images.

        Raises
        ------
        NergError
            The file does not exist or is damaged, or none of its frames can be used.
        """
        source = find_pose_source(to_path(path))
        if source.is_file():
            return cls(**vars(read_transforms(source, allow_outside)))
        folders = [source, *list(resolve_path(source).parents)[:3]]
        images = next((f / "images" for f in folders if (f / "images").is_dir()), None)
        root, notes = None, describe_other_models(source)
        if images is None or not any(p.suffix.lower() in PHOTO_SUFFIXES for p in images.rglob("*")):
            names = read_image_names(source)
            root = next((f for f in folders if any(is_regular_file(f / name, "image") for name in names)), None)
            if root is not None:
                images, notes = root, [*notes, f'the photos are in "{sanitize(root)}", and not in a folder "images"']
        if images is None:
            raise MissingFile(
                f'there is no folder "images" next to or above the COLMAP model "{source}"; put the photos there'
            )
        masks = (root or images.parent) / "masks"
        posed = read_colmap(source, images, masks if masks.is_dir() else None, allow_outside, root)
        return replace(cls(**vars(posed)), notes=[*posed.notes, *notes])

    @classmethod
    def open(cls, photos: Photos | FilePath, allow_outside: bool = False) -> Photos:
        """Return photos unchanged, or `load` them from their file."""
        return photos if isinstance(photos, Photos) else cls.load(photos, allow_outside)

    @property
    def centers(self) -> np.ndarray:
        """Positions of the cameras (N, 3), in the units of the file."""
        return np.array([frame.to_world[:3, 3] for frame in self.frames], np.float64).reshape(-1, 3)

    def to_dataframe(self, library: str | None = None) -> Any:
        """Return a data frame with one row for each photo: its name, and the position and the viewing direction of its
        camera. ``library`` is as in `make_dataframe`."""
        axes = np.array([-frame.to_world[:3, 2] for frame in self.frames], np.float64).reshape(-1, 3)
        columns: dict[str, Any] = {"photo": [frame.name for frame in self.frames]}
        columns |= {name: self.centers[:, k] for k, name in enumerate("xyz")}
        return make_dataframe({**columns, **{f"d{name}": axes[:, k] for k, name in enumerate("xyz")}}, library)

    def _facts(self) -> list[tuple[str, str]]:
        extent = " x ".join(f"{x:.3g}" for x in np.ptp(self.centers, axis=0))
        rows = [("photos", f"{len(self.frames):,}"), ("cameras span", f"{extent} units")]
        counts = {
            "with depth": sum(frame.depth is not None for frame in self.frames),
            "not used": len(self.unused),
            "surface points": 0 if self.points is None else len(self.points),
        }
        return rows + [(name, f"{count:,}") for name, count in counts.items() if count]

    def __len__(self) -> int:
        return len(self.frames)

    def __repr__(self) -> str:
        return f"<Photos {self.path.name}: {', '.join(f'{name} {value}' for name, value in self._facts())}>"

    def _repr_html_(self) -> str:
        return html.key_value_table([("file", self.path.name), *self._facts()])
