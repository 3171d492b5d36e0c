"""Scenes with gaze for other programs: what is exchanged, and the file formats that it is written in.

To add a format, write a module with a function that writes an `ExchangeScene`, and enter it in `FORMATS`.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from nerg_mi.errors import NergError, import_extra
from nerg_mi.fields.splats import Splats
from nerg_mi.files.atomic import check_writable, replace_atomically

# ---- Contents ----
#
# Positions are in the frame and units of the scene. Colours are linear RGB in 0..1.


@dataclass(frozen=True, eq=False)
class ExchangeMesh:
    """A triangle mesh: ``vertices`` (V, 3), ``faces`` (F, 3), and for its vertices ``colors`` (V, 3) and ``values``
    (V,), such as attention, or None. ``label`` names the values with their unit."""

    name: str
    vertices: np.ndarray
    faces: np.ndarray
    colors: np.ndarray | None = None
    values: np.ndarray | None = None
    label: str = ""


@dataclass(frozen=True, eq=False)
class ExchangePoints:
    """Points of a field: ``positions`` (N, 3), linear ``colors`` (N, 3), and ``values`` (N,) or None, which ``label``
    names."""

    name: str
    positions: np.ndarray
    colors: np.ndarray
    values: np.ndarray | None = None
    label: str = ""


@dataclass(frozen=True, eq=False)
class ExchangeRays:
    """Gaze of a participant over time: ``times`` (N,) in seconds, ascending, ``origins`` and ``ends`` (N, 3).

    ``tracking`` tells what the directions are, as `nerg_mi.tracking.rays.TRACKING`.
    """

    participant: str
    times: np.ndarray
    origins: np.ndarray
    ends: np.ndarray
    tracking: str = "unknown"

    @property
    def origin_name(self) -> str:
        """Name of the object at the origins: ``heads`` for directions of heads, otherwise ``eyes``."""
        return "heads" if self.tracking == "head" else "eyes"


@dataclass(frozen=True, eq=False)
class ExchangeFixations:
    """Fixations of a participant: start ``times`` and ``durations`` (N,) in seconds, ``positions`` (N, 3), ``kinds``
    (N,), and their ``definition`` with its parameters."""

    participant: str
    times: np.ndarray
    durations: np.ndarray
    positions: np.ndarray
    kinds: np.ndarray
    definition: Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class ExchangeCamera:
    """A perspective camera: pose ``to_world`` (4, 4) of OpenGL (right, up, backwards), horizontal ``fov`` in degrees,
    and the size of its image in pixels."""

    name: str
    to_world: np.ndarray
    fov: float
    width: int
    height: int


@dataclass(frozen=True, eq=False)
class ExchangeScene:
    """A scene with gaze. ``up``: vertical axis, "y" or "z"; ``meters_per_unit``: length of a unit in metres. The names
    of participants are unique in ``rays`` and in ``fixations``."""

    meshes: tuple[ExchangeMesh, ...] = ()
    points: tuple[ExchangePoints, ...] = ()
    splats: Splats | None = None
    rays: tuple[ExchangeRays, ...] = ()
    fixations: tuple[ExchangeFixations, ...] = ()
    cameras: tuple[ExchangeCamera, ...] = ()
    up: str = "z"
    meters_per_unit: float = 1.0

    def name_participants(self, allowed: Callable[[str], str]) -> dict[str, str]:
        """Return an identifier by ``allowed`` for each participant."""
        participants = list(dict.fromkeys(g.participant for g in (*self.rays, *self.fixations)))
        return dict(zip(participants, unique_names(participants, allowed)))


# ---- Formats ----

Write = Callable[[ExchangeScene, Path], None]
"""Writes a scene to an existing file, whose suffix is that of the format."""


class Format(NamedTuple):
    """The function that writes a format, and the library that it needs."""

    write: str  # module:function
    library: str
    reason: str  # as of `nerg_mi.errors.import_extra`
    extra: str


_RERUN = Format("nerg_mi.formats.exchange_rerun:write_rerun", "rerun", "a Rerun recording needs rerun-sdk", "rerun")
_USD = Format("nerg_mi.formats.exchange_usd:write_usd", "pxr.Usd", "a USD scene needs usd-core", "usd")
FORMATS: dict[str, Format] = {".rrd": _RERUN, ".usdc": _USD, ".usda": _USD, ".usd": _USD}
"""Formats by the suffix of their files."""


def check_exchange(path: str | os.PathLike) -> Format:
    """Return the format of the file ``path``, before the work on its content.

    Raises `NergError` for another suffix and for a file that cannot be written, and `ImportError` without the format's
    library.
    """
    check_writable(path, *FORMATS)
    chosen = FORMATS[Path(path).suffix.lower()]
    import_extra(chosen.library, chosen.reason, chosen.extra)
    return chosen


def write_exchange(scene: ExchangeScene, path: str | os.PathLike) -> None:
    """Write ``scene`` atomically in the format of the suffix of ``path``.

    Raises `NergError` for another suffix and for an empty scene, and `ImportError` without the format's library.
    """
    chosen = check_exchange(path)
    if not (scene.meshes or scene.points or scene.splats or scene.rays or scene.cameras):
        raise NergError(f'there is nothing to write to "{path}"; name a scene, a mesh, splats or rays')
    module, _, function = chosen.write.partition(":")
    write: Write = getattr(import_module(module), function)
    with replace_atomically(path) as temporary:
        write(scene, temporary)


def unique_names(names: list[str], allowed: Callable[[str], str]) -> list[str]:
    """Return ``names`` as identifiers by ``allowed``, with numbers where they would be equal."""
    out: list[str] = []
    for name in map(allowed, names):
        number, unique = 2, name
        while unique in out:
            number, unique = number + 1, f"{name}_{number}"
        out.append(unique)
    return out
