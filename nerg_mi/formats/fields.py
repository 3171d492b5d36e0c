"""Radiance and gaze fields in and out of checkpoint files.

A new kind of gaze field is one entry of ``GAZE_KINDS``.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

from nerg_mi.field.background import Background, BackgroundConfig
from nerg_mi.field.cascades import CascadeGrid
from nerg_mi.field.gaze.ensemble import GazeEnsemble
from nerg_mi.field.gaze.log_density import LogGazeConfig, LogGazeField
from nerg_mi.field.gaze.product import GazeConfig, GazeField
from nerg_mi.field.gaze.support import RaySupport
from nerg_mi.field.occupancy import OccupancyGrid
from nerg_mi.field.radiance import RadianceConfig, RadianceField
from nerg_mi.files.bounded import plain
from nerg_mi.maths.box import Box

from .architecture import MEMBERS, building, check_occupancy, check_sizes, number
from .arrays import StoredArrays, stored
from .checkpoint import read_checkpoint, write_checkpoint


def _occupancy(arrays: StoredArrays, about: dict) -> OccupancyGrid | CascadeGrid:
    check_occupancy(about)
    bits, resolution, threshold = arrays.raw("occupancy.bits"), about["resolution"], about["threshold"]
    if "bound" in about:
        return CascadeGrid.from_packed(bits, resolution, about["bound"], arrays.ns, threshold)
    return OccupancyGrid.from_packed(bits, resolution, arrays.ns, threshold)


def save_radiance(field: RadianceField, path: str | Path, provenance: dict, half: bool = False) -> None:
    """Write ``field``; ``provenance`` (JSON) says what it was trained on and with."""
    tensors = stored(field.parameters(), half)
    metadata = {
        "architecture": field.config.to_dict(),
        "box": field.box.to_dict(),
        "color_space": field.color_space,
        "march_step": field.march_step,
        "units": {"length": "scene unit", "density": "1 / scene unit"},
        "provenance": provenance,
    }
    if field.occupancy is not None:
        tensors["occupancy.bits"] = field.occupancy.packed()
        metadata["occupancy"] = {"resolution": field.occupancy.resolution, "threshold": field.occupancy.threshold}
        if isinstance(field.occupancy, CascadeGrid):
            metadata["occupancy"]["bound"] = field.occupancy.bound
    if field.background is not None:
        metadata["background"] = field.background.config.to_dict()
    write_checkpoint(path, "radiance", tensors, metadata)


def load_radiance(path: str | Path, ns: ModuleType) -> tuple[RadianceField, dict[str, Any]]:
    """The field in ``path`` on backend ``ns`` (see ``field.backend.namespace``), and its metadata.

    Raises `NergError` for a file that holds none.
    """
    tensors, meta = read_checkpoint(path, "radiance")
    with building(path):
        arrays, config = StoredArrays(tensors, ns), RadianceConfig.from_dict(check_sizes(meta["architecture"]))
        step = meta["march_step"]
        if step is not None and not 0 < number(meta, "march_step", "metadata"):
            raise ValueError(f'its "march_step" must be positive, not {step}')
        background = None
        if "background" in meta:
            behind = BackgroundConfig.from_dict(check_sizes(meta["background"], "background"))
            background = Background(
                behind, arrays.grid(behind.grid, "background_grid"), arrays.net("background_net", behind.sizes)
            )
        field = RadianceField(
            config,
            Box(**meta["box"]),
            arrays.grid(config.grid),
            arrays.net("density_net", config.density_sizes),
            arrays.net("color_net", config.color_sizes),
            _occupancy(arrays, meta["occupancy"]) if "occupancy" in meta else None,
            meta["color_space"],
            step,
            background,
        )
    return field, meta


class GazeKind(NamedTuple):
    """How one kind of gaze field is stored."""

    # The class of its fields.
    field: type
    # The JSON object of a field's sizes, with its kind (a product has none).
    architecture: Callable[[Any], dict[str, Any]]
    # From the arrays of a file, that JSON object and the box to the field.
    read: Callable[[StoredArrays, dict[str, Any], Box], Any]


def _read_product(arrays: StoredArrays, about: dict[str, Any], box: Box) -> GazeField:
    config = GazeConfig.from_dict(about)
    layernorm = config.trunk == "layernorm"
    return GazeField(
        config,
        box,
        arrays.grid(config.grid),
        arrays.net("position_net", config.position_sizes, layernorm),
        arrays.net("direction_net", config.direction_sizes, layernorm),
        arrays.net("emit_head", [config.width, 1]),
        arrays.net("capture_head", [config.width, 1]),
    )


def _read_log_density(arrays: StoredArrays, about: dict[str, Any], box: Box) -> LogGazeField:
    config = LogGazeConfig.from_dict(about)
    return LogGazeField(
        config,
        box,
        arrays.grid(config.grid),
        arrays.net("emit_net", config.emit_sizes),
        arrays.net("capture_net", config.capture_sizes),
        arrays.ns.Float(arrays.array("escaped", 1)),
        arrays.ns.TensorXf(arrays.array("prior", config.prior, 2 * config.prior)),
    )


def _read_ensemble(arrays: StoredArrays, about: dict[str, Any], box: Box) -> GazeEnsemble:
    members = about["members"]
    if len(members) > MEMBERS:
        raise ValueError(f"it has {len(members)} members, and at most {MEMBERS} are read")
    parts = [arrays.member(i, member) for i, member in enumerate(members)]
    if any(about.get("kind") == "ensemble" for about, _ in parts):
        raise ValueError("a member of its ensemble is an ensemble")
    return GazeEnsemble([_read_gaze(own, about, box) for about, own in parts])


GAZE_KINDS = {
    "product": GazeKind(GazeField, lambda field: field.config.to_dict(), _read_product),
    "log_density": GazeKind(LogGazeField, lambda field: field.config.to_dict(), _read_log_density),
    "ensemble": GazeKind(
        GazeEnsemble,
        lambda field: {"kind": "ensemble", "members": [m.config.to_dict() for m in field.members]},
        _read_ensemble,
    ),
}
"""Kinds of gaze fields by the ``kind`` of a checkpoint's architecture; one without is a product."""


def _read_gaze(arrays: StoredArrays, about: dict[str, Any], box: Box) -> GazeField | LogGazeField | GazeEnsemble:
    kind = check_sizes(about).get("kind", "product")
    if not isinstance(kind, str) or kind not in GAZE_KINDS:
        raise ValueError(f'it is a gaze field of the kind "{plain(kind, 40)}", which this version does not know')
    return GAZE_KINDS[kind].read(arrays, about, box)


def save_gaze(
    field: GazeField | LogGazeField | GazeEnsemble, path: str | Path, provenance: dict, half: bool = False
) -> None:
    """Write ``field``, with its support where it has one; ``provenance`` (JSON) says what it was trained on and
    with."""
    kind = next(kind for kind in GAZE_KINDS.values() if kind.field is type(field))
    c, tensors = field.config, stored(field.parameters(), half)
    metadata = {
        "architecture": kind.architecture(field),
        "output": {"activation": c.activation, "normalized": c.normalized},
        "box": field.box.to_dict(),
        "units": {"length": "scene unit", "gaze": "1 / steradian"},
        "provenance": provenance,
    }
    if field.support is not None:
        # Counts and positions: never in fp16.
        tensors["support.cells"], metadata["support"] = field.support.cells, {"radius": field.support.radius}
    write_checkpoint(path, "gaze", tensors, metadata)


def load_gaze(path: str | Path, ns: ModuleType) -> tuple[GazeField | LogGazeField | GazeEnsemble, dict[str, Any]]:
    """The gaze field in ``path`` on backend ``ns``, with its support, and its metadata.

    Raises `NergError` for a file that holds none.
    """
    tensors, meta = read_checkpoint(path, "gaze")
    with building(path):
        arrays = StoredArrays(tensors, ns)
        field = _read_gaze(arrays, meta["architecture"], Box(**meta["box"]))
        if "support" in meta:
            field.support = RaySupport(arrays.array("support.cells", None, 5), meta["support"]["radius"])
    return field, meta
