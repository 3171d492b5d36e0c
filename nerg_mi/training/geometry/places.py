"""Where people looked around: what a gaze field's depths are traced in, and what it is told where there is nothing."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from nerg_mi.errors import MissingFile, NergError
from nerg_mi.field.gaze.log_density import LogGazeConfig
from nerg_mi.field.gaze.product import GazeConfig
from nerg_mi.files.checksum import file_sha256
from nerg_mi.formats.volumes import write_volume
from nerg_mi.maths.box import Box
from nerg_mi.rays.rays import Rays
from nerg_mi.rendering.mesh_file import check_vol
from nerg_mi.transport.media.field import FieldMedium
from nerg_mi.transport.media.volume import VolumeMedium
from nerg_mi.transport.place import Place

from .hit_extent import hit_extent
from .hit_geometry import volume_dict, voxelise_hits

# How far people without any geometry are taken to look.
_NOWHERE = 2.0


@dataclass(frozen=True, eq=False)
class GazePlace:
    """``medium``: what ``transport.trace.trace_depth`` traces, None where nothing is known; ``box``: where a gaze field
    lives; ``about``: for the provenance (JSON); ``kind``: ``field``, ``scene``, ``hits`` or ``none``."""

    medium: object
    box: Box
    kind: str
    about: dict = field(default_factory=dict)

    def told(self, config: GazeConfig | LogGazeConfig) -> GazeConfig | LogGazeConfig:
        """``config`` of a gaze field that knows what such a place is: one of hit points has holes, which were seen
        through by nobody that it was made from; no place has no surfaces. Raises ``ValueError`` for a field that needs
        surfaces."""
        if isinstance(config, LogGazeConfig):
            return replace(
                config,
                escaped="nearest" if self.kind == "hits" else "constant",
                geometry="none" if self.kind == "none" else "surface",
            )
        if self.kind == "none":
            raise NergError(
                "a gaze field of this recipe needs surfaces; without any geometry only the default recipe trains"
            )
        return config


def place_of_field(path: Path, ns) -> GazePlace:
    """A trained radiance field."""
    from nerg_mi.formats.fields import load_radiance

    radiance, _ = load_radiance(path, ns)
    return GazePlace(FieldMedium(radiance), radiance.box, "field", {"field_file": _file(path)})


def place_of_scene(path: Path) -> GazePlace:
    """The shapes of a Mitsuba scene, and the field or volume of its integrator where that is a ``nerg``."""
    from nerg_mi.rendering.pictures import load_scene

    scene = load_scene(path)
    place = Place(getattr(scene.integrator(), "medium", None), scene)
    bounds = [] if place.medium is None else [place.medium.bounds()]
    if place.scene is not None:
        bounds.append(place.corners())
    if not bounds:
        raise NergError(f'the scene "{path}" has neither shapes nor a field in which people could have looked around')
    lower, upper = np.min([b[0] for b in bounds], axis=0), np.max([b[1] for b in bounds], axis=0)
    # A plane has no thickness, and a field needs some.
    pad = 0.01 * max(upper - lower)
    return GazePlace(place, Box(tuple(lower - pad), tuple(upper + pad)), "scene", {"scene_file": _file(path)})


def place_of_hits(rays: Rays, path: Path, voxel: float | None = None) -> GazePlace:
    """A volume made of the rays' hit points, written to ``path`` (.vol); ``voxel``: edge of its voxels in metres, by
    default what `hit_extent` chooses."""
    extent = hit_extent(rays, voxel)
    density, box = voxelise_hits(rays, extent=extent)
    write_volume(path, density, box.lower, box.upper)
    size = {
        "shape": list(extent.shape),
        "solid": round(float((density > 0).mean()), 4),
        "voxel": extent.voxel,
        "beyond": round(extent.beyond, 4),
    }
    return place_of_volume(path, size)


def place_of_volume(path: Path, about: dict | None = None) -> GazePlace:
    """A volume that ``place_of_hits`` has written. Raises `NergError` for one that is missing or damaged."""
    import mitsuba as mi

    if not path.is_file():
        raise MissingFile(f'the place of hit points "{path}" does not exist; it is written beside the gaze field')
    check_vol(path)
    box = np.fromfile(path, "<f4", 6, offset=24)
    # Mitsuba makes some box of any six numbers.
    if not (np.isfinite(box).all() and (box[:3] < box[3:]).all()):
        raise NergError(f'the place of hit points "{path}" has no box with a lower and an upper corner; make it anew')
    medium = VolumeMedium(mi.load_dict(volume_dict(path)))
    lower, upper = medium.bounds()
    return GazePlace(
        medium,
        Box(tuple(lower.tolist()), tuple(upper.tolist())),
        "hits",
        {"geometry_file": {**_file(path), **(about or {})}},
    )


def place_of_nothing(origins: np.ndarray) -> GazePlace:
    """No geometry: everything is two metres away from whoever looks from one of ``origins`` (N, 3)."""
    lower, upper = origins.min(axis=0) - _NOWHERE, origins.max(axis=0) + _NOWHERE
    return GazePlace(None, Box(tuple(lower.tolist()), tuple(upper.tolist())), "none", {"geometry": "none"})


def _file(path: Path) -> dict:
    return {"file": path.name, "sha256": file_sha256(path)}
