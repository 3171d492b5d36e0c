"""Radiance and gaze fields in and out of checkpoint files.

Which kinds of gaze fields there are is known to ``fields.gaze_base``.
"""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from nerg_mi.fields.gaze_base import AnyGazeField, RaySupport, basis_of, build, limits_of
from nerg_mi.fields.occupancy import CascadeGrid, OccupancyGrid, RefinedGrid, unpacked
from nerg_mi.fields.radiance import Background, BackgroundConfig, RadianceConfig, RadianceField
from nerg_mi.files.atomic import file_sha256
from nerg_mi.maths.geometry import box_of
from nerg_mi.ranges import VALUES

from .architecture import MEMBERS, building, check_occupancy, check_sizes, number
from .arrays import StoredArrays, stored
from .checkpoint import read_checkpoint, read_metadata, write_checkpoint


def _occupancy(arrays: StoredArrays, about: dict) -> OccupancyGrid | RefinedGrid | CascadeGrid:
    check_occupancy(about)
    bits, resolution, threshold = arrays.raw("occupancy.bits"), about["resolution"], about["threshold"]
    if "bound" in about:
        return CascadeGrid.from_packed(bits, resolution, about["bound"], arrays.ns, threshold)
    if "refined" not in about:
        return OccupancyGrid.from_packed(bits, resolution, arrays.ns, threshold)
    limit, missed = (number(about["refined"], name, "refined occupancy") for name in ("threshold", "missed"))
    cells = unpacked(bits, resolution)
    return RefinedGrid(cells, arrays.raw("occupancy.parts"), arrays.ns, limit, threshold, missed)


def occupancy_arrays(grid: OccupancyGrid | RefinedGrid | CascadeGrid) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """``grid`` as arrays of a checkpoint, by name, and what its metadata say. Of a refined one the cells that it
    refines stand there too, as readers that know no parts expect them."""
    cells = grid.coarse
    tensors = {"occupancy.bits": cells.packed()}
    about: dict[str, Any] = {"resolution": cells.resolution, "threshold": cells.threshold}
    if isinstance(cells, CascadeGrid):
        about["bound"] = cells.bound
    if isinstance(grid, RefinedGrid):
        tensors["occupancy.parts"] = grid.masks
        about["refined"] = {"threshold": grid.threshold, "missed": grid.missed}
    return tensors, about


def save_radiance(field: RadianceField, path: str | Path, provenance: dict, half: bool = False) -> None:
    """Write ``field``; ``provenance`` (JSON) says what it was trained on and with."""
    tensors = stored(field.parameters(), half)
    metadata = {
        "architecture": field.config.to_dict(),
        "box": field.box.to_dict(),
        "color_space": field.color_space,
        "march_step": field.march_step,
        **({"march_growth": field.march_growth} if field.march_growth else {}),
        "units": {"length": "scene unit", "density": "1 / scene unit"},
        "provenance": provenance,
    }
    if field.occupancy is not None:
        arrays, metadata["occupancy"] = occupancy_arrays(field.occupancy)
        tensors |= arrays
    if field.background is not None:
        metadata["background"] = field.background.config.to_dict()
    write_checkpoint(path, "radiance", tensors, metadata)


def load_radiance(path: str | Path, ns: ModuleType) -> tuple[RadianceField, dict[str, Any]]:
    """The field in ``path`` on backend ``ns`` (see ``fields.mlp.namespace``), and its metadata.

    Raises `NergError` for a file that holds none.
    """
    tensors, meta = read_checkpoint(path, "radiance")
    with building(path):
        arrays, config = StoredArrays(tensors, ns), RadianceConfig.from_dict(check_sizes(meta["architecture"]))
        step = meta["march_step"]
        if step is not None and not 0 < number(meta, "march_step", "metadata"):
            raise ValueError(f'its "march_step" must be positive, not {step}')
        growth = number(meta, "march_growth", "metadata") if "march_growth" in meta else 0.0
        if not 0 <= growth <= 1:
            raise ValueError(f'its "march_growth" must lie in [0, 1], not {growth}')
        background = None
        if "background" in meta:
            behind = BackgroundConfig.from_dict(check_sizes(meta["background"], "background"))
            background = Background(
                behind, arrays.grid(behind.grid, "background_grid"), arrays.net("background_net", behind.sizes)
            )
        field = RadianceField(
            config,
            box_of(meta["box"]),
            arrays.grid(config.grid),
            arrays.net("density_net", config.density_sizes),
            arrays.net("color_net", config.color_sizes),
            _occupancy(arrays, meta["occupancy"]) if "occupancy" in meta else None,
            meta["color_space"],
            step,
            background,
            growth,
        )
    return field, meta


def is_field(path: str | Path, sha256: object) -> bool:
    """Whether ``path`` is the file of this checksum, or a radiance field that was made of it by refining its bound."""
    if file_sha256(path) == sha256:
        return True
    return (
        Path(path).suffix == ".safetensors" and sha256 is not None and read_metadata(path).get("refined_from") == sha256
    )


def save_gaze(field: AnyGazeField, path: str | Path, provenance: dict, half: bool = False) -> None:
    """Write ``field``, with its support where it has one; ``provenance`` (JSON) says what it was trained on and
    with."""
    c, tensors = field.config, stored(field.parameters(), half)
    metadata = {
        "architecture": field.architecture(),
        "output": {"activation": c.activation, "normalized": c.normalized},
        "box": field.box.to_dict(),
        "units": {"length": "scene unit", "gaze": "1 / steradian"},
        "provenance": provenance,
    }
    if field.support is not None:
        # Counts and positions: never in fp16.
        tensors["support.cells"], metadata["support"] = field.support.cells, {"radius": field.support.radius}
    write_checkpoint(path, "gaze", tensors, metadata)


def load_gaze(path: str | Path, ns: ModuleType) -> tuple[AnyGazeField, dict[str, Any]]:
    """The gaze field in ``path`` on backend ``ns``, with its support, and its metadata.

    Raises `NergError` for a file that holds none.
    """
    tensors, meta = read_checkpoint(path, "gaze")
    with building(path):
        arrays, about = StoredArrays(tensors, ns), meta["architecture"]
        check_sizes(about, most=limits_of(about))
        if len(about.get("members", ())) > MEMBERS:
            raise ValueError(f"it has {len(about['members'])} members, and at most {MEMBERS} are read")
        field = build(about, box_of(meta["box"]), arrays)
        if "support" in meta:
            field.support = RaySupport(
                arrays.array("support.cells", None, 5, largest=VALUES.high), meta["support"]["radius"]
            )
        field.basis = basis_of(meta["provenance"]) if isinstance(meta.get("provenance"), dict) else None
    return field, meta
