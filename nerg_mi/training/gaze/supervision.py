"""What a gaze field learns from: rays of attention, salience images, or both."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np

from nerg_mi.fields.gaze_base import RaySupport
from nerg_mi.photos.salience import SalienceView
from nerg_mi.rays.rays import Rays
from nerg_mi.training.geometry.places import GazePlace


@dataclass(frozen=True, eq=False)
class Supervision:
    """Rays and views, of which one may be missing."""

    # Rays of attention, in a frame of their own in metres; None: views alone.
    rays: Rays | None = None
    # Salience images, in the gaze field's frame.
    views: tuple[SalienceView, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "views", tuple(self.views))
        if self.rays is None and not self.views:
            raise ValueError("a gaze field learns from rays, from views or from both, and there is neither")

    def digest(self) -> dict[str, str | None]:
        """SHA-256 of what a training takes from ``rays`` and from ``views`` (JSON); None for what there is none of."""
        return {"rays": None if self.rays is None else digest_rays(self.rays), "views": digest_views(self.views)}

    def counts(self) -> dict[str, int]:
        """How many ``rays`` of how many ``people``, and how many salience images there are (JSON)."""
        rays = self.rays
        people = 0 if rays is None else len(np.unique(rays.person))
        return {"rays": 0 if rays is None else len(rays), "people": people, "salience_views": len(self.views)}

    def support(self, radius: float, place: GazePlace) -> RaySupport | None:
        """How many rays start around a position in the frame of ``place``, for probes of ``radius`` metres; None
        without rays."""
        if self.rays is None:
            return None
        return RaySupport.of(place.points_from_rays(self.rays.origin), radius * place.align.scale)


def digest_rays(rays: Rays) -> str:
    """SHA-256 of what a training takes from ``rays``."""
    return _sha256([rays.person, rays.origin, rays.direction])


def digest_views(views: tuple[SalienceView, ...] | list[SalienceView]) -> str | None:
    """SHA-256 of what a training takes from ``views``; None without any."""
    return _sha256([a for v in views for a in (v.camera.to_world, v.share, v.solid_angle)]) if views else None


def _sha256(arrays: list[np.ndarray]) -> str:
    return hashlib.sha256(b"".join(np.ascontiguousarray(a).tobytes() for a in arrays)).hexdigest()
