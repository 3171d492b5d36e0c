"""Reading and writing of radiance and gaze fields as checkpoints: architectures, size checks, and weights."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any, cast

import numpy as np

from nerg_mi.errors import NergError, parameter, sanitize
from nerg_mi.fields.encoding import HashGrid, HashGridConfig
from nerg_mi.fields.gaze_base import (
    MAX_WEIGHT,
    GazeNetwork,
    RaySupport,
    build_gaze_field,
    max_sizes_of,
    summarize_provenance,
)
from nerg_mi.fields.gaze_hits import HitKernel, ReaimedHits
from nerg_mi.fields.mlp import MLP
from nerg_mi.fields.occupancy import CascadeGrid, OccupancyGrid, RefinedGrid, unpack_bits
from nerg_mi.fields.radiance import EMPTY, Background, BackgroundConfig, RadianceConfig, RadianceNetwork
from nerg_mi.fields.voxels import VoxelArrays, VoxelColors, VoxelGrid
from nerg_mi.files.atomic import file_sha256, write_bytes
from nerg_mi.files.safe_read import describe_error
from nerg_mi.maths.arrays import copy_aligned
from nerg_mi.maths.geometry import box_from_dict
from nerg_mi.ranges import MAX_COORDINATE, POSITIVE_VALUES

from .checkpoint import decode_checkpoint, encode_checkpoint, read_checkpoint, read_metadata, write_checkpoint

# ---- Checks of the sizes in a checkpoint, before they are used ----
#
# The arrays of the file bound most sizes, but lists of layers and levels are created from the numbers alone.

_SIZE_LIMITS = {
    "width": 4096,
    "geometry": 4096,
    "density_hidden": 64,
    "color_hidden": 64,
    "hidden": 64,
    "sh_degree": 10,
}
"""Maximum values of the integers of an architecture, by name. Larger networks are not trained, and do not compile."""

MAX_GRID_RESOLUTION = 1 << 24  # maximum resolution of a grid; float32 cannot distinguish more cells
MAX_MEMBERS = 64  # maximum number of members of an ensemble
MAX_OCCUPANCY_CELLS = 1 << 26  # maximum number of cells of an occupancy grid over all levels: 400 along each edge


@contextmanager
def translate_build_errors(path: str | os.PathLike) -> Iterator[None]:
    """Convert errors of the block, which builds a field from the checkpoint ``path``, to a `NergError` that names
    the file.
    """
    remedy = "copy it again, or train it again"
    try:
        yield
    except NergError:
        raise
    except (KeyError, TypeError, ValueError, AttributeError, IndexError, OverflowError, MemoryError) as e:
        raise NergError(f'the checkpoint "{path}" contains no usable field: {describe_error(e)}; {remedy}') from e


def check_sizes(config: object, section: str = "architecture", limits: Mapping[str, int] = _SIZE_LIMITS) -> dict:
    """Check the sizes in a JSON configuration and return the configuration.

    Raises ``ValueError`` if a size is not an integer within its limits. Missing entries are not checked; the
    configuration class reports them. The limits of a ``grid`` are those of `HashGridConfig`.

    Parameters
    ----------
    config
        JSON object.
    section
        Name of the section in error messages.
    limits
        Maximum value by name; the minimum is 1.
    """
    if not isinstance(config, dict):
        raise ValueError(f'its "{section}" is not a JSON object')
    for name, value in config.items():
        if name in limits and not (
            isinstance(value, int) and not isinstance(value, bool) and 1 <= value <= limits[name]
        ):
            raise ValueError(
                f'"{name}" of its {section} must be a whole number from 1 to {limits[name]}, not '
                f"{sanitize(repr(value), 40)}"
            )
    if "finest" in config and not 1 <= read_number(config, "finest", section) <= MAX_GRID_RESOLUTION:
        raise ValueError(
            f'"finest" of its {section} must be in 1..{MAX_GRID_RESOLUTION}, not {sanitize(repr(config["finest"]), 40)}'
        )
    if "grid" in config:
        grid = config["grid"]
        if isinstance(grid, dict):
            HashGridConfig.check_kind(grid)
        check_sizes(grid, "grid", HashGridConfig.max_sizes)
    return config


def read_number(config: object, name: str, section: str) -> float:
    """Return the number ``name`` of the JSON object ``config``. Raises ``ValueError`` unless it is finite in
    single precision.
    """
    value = config[name] if isinstance(config, dict) else None
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) <= POSITIVE_VALUES.high:
        raise ValueError(f'"{name}" of its {section} must be a finite number, not {sanitize(repr(value), 40)}')
    return value


def check_occupancy(config: dict) -> dict:
    """Check the size in the JSON object of an occupancy grid and return the object. Raises ``ValueError`` if it
    is too large.
    """
    resolution, levels = read_number(config, "resolution", "occupancy"), 1
    read_number(config, "threshold", "occupancy")
    if "bound" in config:
        levels = 1 + math.ceil(math.log2(max(read_number(config, "bound", "occupancy"), 1)))
    if not (isinstance(resolution, int) and resolution >= 1 and levels * resolution**3 <= MAX_OCCUPANCY_CELLS):
        raise ValueError(
            '"resolution" of its occupancy must be a whole number of cells along an edge, with at most '
            f"{MAX_OCCUPANCY_CELLS:,} "
            f"cells in total, not {sanitize(repr(resolution), 40)}"
        )
    return config


# ---- Arrays ----
#
# Weights are checked when they are written and when they are read. They may be stored as fp16, which halves the size,
# and are fp32 in memory.


def to_stored_arrays(parameters: Mapping[str, Any], half: bool) -> dict[str, np.ndarray]:
    """Convert Dr.Jit arrays to NumPy arrays for a file, as fp16 if ``half``.

    Raises `NergError` for values that are not finite or exceed `MAX_WEIGHT`.
    """
    out = {}
    for name, value in parameters.items():
        value = value.numpy()
        with np.errstate(over="ignore"):  # values beyond fp16 raise an error below
            out[name] = value.astype(np.float16 if half else np.float32)
        if not np.all(np.abs(value) <= MAX_WEIGHT):
            raise NergError(
                f'the weight array "{name}" is not finite or exceeds {MAX_WEIGHT:g}: the training has diverged; '
                "train with a lower learning rate"
            )
        if not np.all(np.isfinite(out[name])):
            raise NergError(f'the weight array "{name}" exceeds the range of fp16; omit {parameter("half", True)}')
    return out


class StoredArrays:
    """The arrays of a checkpoint by name, and the parts of fields that are built from them on the backend ``ns``.

    All methods raise ``KeyError`` for a missing array and ``ValueError`` for an invalid one.
    """

    def __init__(self, tensors: Mapping[str, np.ndarray], ns: ModuleType):
        self._tensors, self.ns = tensors, ns

    def get_raw(self, name: str) -> np.ndarray:
        """Return the array ``name`` as it is stored."""
        return self._tensors[name]

    def get_array(self, name: str, *shape: int | None, max_value: float = MAX_WEIGHT) -> np.ndarray:
        """Return the array ``name`` as aligned fp32.

        Parameters
        ----------
        name
            Name of the array.
        shape
            Required shape; None for any length.
        max_value
            Maximum absolute value.
        """
        stored_shape = self._tensors[name].shape
        if len(stored_shape) != len(shape) or any(want not in (None, have) for want, have in zip(shape, stored_shape)):
            needed = " x ".join("any" if n is None else str(n) for n in shape)
            raise ValueError(
                f'the weight array "{name}" has shape {stored_shape}, but its configuration needs {needed}'
            )
        with np.errstate(over="ignore"):  # values beyond fp32 become infinite
            value = copy_aligned(self._tensors[name])
        if not np.all(np.isfinite(value)):
            raise ValueError(f'the weight array "{name}" is not finite')
        if np.abs(value).max(initial=0) > max_value:
            raise ValueError(
                f'the weight array "{name}" contains values beyond {max_value:g}, which training does not produce'
            )
        return value

    def build_grid(self, config: HashGridConfig, name: str = "grid") -> HashGrid:
        """Build the encoding ``name`` with the configuration ``config``."""
        arrays = {
            f"{name}.{key}": self._to_drjit(f"{name}.{key}", *shape) for key, shape in config.parameter_shapes().items()
        }
        return HashGrid.from_parameters(config, arrays, name)

    def build_network(self, name: str, sizes: list[int], normalized: bool = False) -> MLP:
        """Build the network ``name`` with layers of these ``sizes``; ``normalized``: with the gains and shifts of
        LayerNorm.
        """
        tensor = lambda key, *shape: self.ns.TensorXf(self.get_array(f"{name}.{key}", *shape))
        layers, norms = list(enumerate(zip(sizes, sizes[1:]))), None
        if normalized:
            norms = [
                {"gain": tensor(f"{i}.gain", n), "shift": tensor(f"{i}.shift", n), "bias": tensor(f"{i}.bias", m)}
                for i, (n, m) in layers
            ]
        return MLP([tensor(i, m, n) for i, (n, m) in layers], norms)

    def get_member(self, index: int, architecture: dict[str, Any]) -> tuple[dict[str, Any], StoredArrays]:
        """Return the checked architecture and the arrays of the member ``index`` of an ensemble."""
        member_tensors = {k.removeprefix(f"{index}."): v for k, v in self._tensors.items() if k.startswith(f"{index}.")}
        return check_sizes(architecture, limits=max_sizes_of(architecture)), StoredArrays(member_tensors, self.ns)

    def _to_drjit(self, name: str, *shape: int) -> Any:
        value = self.get_array(name, *shape)
        return self.ns.Float(value) if len(shape) == 1 else self.ns.TensorXf(value)


# ---- Radiance and gaze fields ----
#
# The kinds of gaze fields are registered in ``fields.gaze_base``.


def _decode_occupancy(arrays: StoredArrays, config: dict) -> OccupancyGrid | RefinedGrid | CascadeGrid:
    check_occupancy(config)
    bits, resolution, threshold = arrays.get_raw("occupancy.bits"), config["resolution"], config["threshold"]
    if "bound" in config:
        return CascadeGrid.from_packed(bits, resolution, config["bound"], arrays.ns, threshold)
    if "refined" not in config:
        return OccupancyGrid.from_packed(bits, resolution, arrays.ns, threshold)
    limit, missed = (read_number(config["refined"], name, "refined occupancy") for name in ("threshold", "missed"))
    cells = unpack_bits(bits, resolution)
    return RefinedGrid(cells, arrays.get_raw("occupancy.parts"), arrays.ns, limit, threshold, missed)


def encode_occupancy(grid: OccupancyGrid | RefinedGrid | CascadeGrid) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Convert ``grid`` to arrays of a checkpoint by name, and its metadata.

    For a refined grid, the arrays also contain the coarse cells, for readers that do not support refinement.
    """
    cells = grid.coarse
    tensors = {"occupancy.bits": cells.pack_bits()}
    config: dict[str, Any] = {"resolution": cells.resolution, "threshold": cells.threshold}
    if isinstance(cells, CascadeGrid):
        config["bound"] = cells.bound
    if isinstance(grid, RefinedGrid):
        tensors["occupancy.parts"] = grid.masks
        config["refined"] = {"threshold": grid.threshold, "missed": grid.missed_optical_depth}
    return tensors, config


_VOXEL_ARRAYS = ("blocks", "masks", "log_density")


def encode_voxels(voxels: VoxelGrid) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Convert ``voxels`` to arrays of a checkpoint by name, and its metadata."""
    arrays, config = voxels.to_arrays(), {"resolution": voxels.resolution}
    tensors = {f"voxels.{name}": getattr(arrays, name) for name in _VOXEL_ARRAYS}
    if voxels.colors is not None:
        tensors["voxels.colors"], config["colors"] = voxels.colors.numbers, voxels.colors.edge
        tensors["voxels.color_basis"] = voxels.colors.net.weights[0].numpy()
    return tensors, config


def _decode_voxels(arrays: StoredArrays, config: dict) -> VoxelGrid:
    resolution = read_number(config, "resolution", "voxels")
    blocks, masks, log_density = (arrays.get_raw(f"voxels.{name}") for name in _VOXEL_ARRAYS)
    if (blocks.dtype, masks.dtype, log_density.dtype) != (np.uint32, np.uint32, np.float16):
        raise ValueError("the arrays of its voxels have other types than uint32 and float16")
    colors = None
    if "colors" in config:
        basis = arrays.get_array("voxels.color_basis", None, None)
        edge = cast("int", read_number(config, "colors", "voxels"))
        colors = VoxelColors(edge, arrays.get_raw("voxels.colors"), basis, arrays.ns)
    return VoxelGrid(VoxelArrays(cast("int", resolution), blocks, masks, log_density), arrays.ns, colors)


def save_radiance(
    field: RadianceNetwork, path: str | Path, provenance: dict, half: bool = False, origin: str | None = None
) -> None:
    """Write ``field``. Other parameters as for `encode_radiance`."""
    write_bytes(path, encode_radiance(field, provenance, half, origin))


def encode_radiance(field: RadianceNetwork, provenance: dict, half: bool = False, origin: str | None = None) -> bytes:
    """Encode ``field`` as a checkpoint. ``provenance`` (JSON) describes the training data and settings; ``half`` stores
    the weights as fp16; ``origin`` is the checksum of the file that the field was compiled or refined from.
    """
    parameters = {name: value for name, value in field.parameters().items() if not name.startswith("voxels.")}
    tensors = to_stored_arrays(parameters, half)
    metadata = {
        "architecture": field.config.to_dict(),
        "box": field.box.to_dict(),
        "color_space": field.color_space,
        "march_step": field.march_step,
        **({"march_growth": field.march_growth} if field.march_growth else {}),
        "units": {"length": "scene unit", "density": "1 / scene unit"},
        "provenance": provenance,
        **({"refined_from": origin} if origin else {}),
    }
    if field.occupancy is not None:
        arrays, metadata["occupancy"] = encode_occupancy(field.occupancy)
        tensors |= arrays
    if field.voxels is not None:
        arrays, metadata["voxels"] = encode_voxels(field.voxels)
        tensors |= arrays
    if field.background is not None:
        metadata["background"] = field.background.config.to_dict()
    return encode_checkpoint("radiance", tensors, metadata)


def load_radiance(path: str | Path, ns: ModuleType) -> tuple[RadianceNetwork, dict[str, Any]]:
    """Read the field in ``path`` on the backend ``ns`` (see ``fields.mlp.namespace``), and its metadata, to which
    "half" is added: whether the weights are fp16.

    Raises `NergError` if the file contains no radiance field.
    """
    return _build_radiance(*read_checkpoint(path, "radiance"), path, ns)


def decode_radiance(data: bytes, ns: ModuleType) -> tuple[RadianceNetwork, dict[str, Any]]:
    """As `load_radiance`, of the result of `encode_radiance`."""
    return _build_radiance(*decode_checkpoint(data), "in memory", ns)


def _build_radiance(
    tensors: dict[str, np.ndarray], meta: dict, path: str | Path, ns: ModuleType
) -> tuple[RadianceNetwork, dict[str, Any]]:
    meta["half"] = any(tensor.dtype == np.float16 for tensor in tensors.values())
    if meta.get("provenance", {}).get("quality") == "poor":
        _warn_once(
            f'the radiance field "{path}" predicts photos badly that it was not trained on (quality "poor" in its '
            "provenance): its surfaces may be wrong; see the warnings of its training"
        )
    with translate_build_errors(path):
        arrays, config = StoredArrays(tensors, ns), RadianceConfig.from_dict(check_sizes(meta["architecture"]))
        step = meta["march_step"]
        if step is not None and not 0 < read_number(meta, "march_step", "metadata"):
            raise ValueError(f'its "march_step" must be positive, not {step}')
        growth = read_number(meta, "march_growth", "metadata") if "march_growth" in meta else 0.0
        if not 0 <= growth <= 1:
            raise ValueError(f'its "march_growth" must lie in [0, 1], not {growth}')
        background = None
        if "background" in meta:
            background_config = BackgroundConfig.from_dict(check_sizes(meta["background"], "background"))
            background = Background(
                background_config,
                arrays.build_grid(background_config.grid, "background_grid"),
                arrays.build_network("background_net", background_config.sizes),
            )
        field = RadianceNetwork(
            config,
            box_from_dict(meta["box"]),
            arrays.build_grid(config.grid),
            arrays.build_network("density_net", config.density_sizes),
            arrays.build_network("color_net", config.color_sizes),
            _decode_occupancy(arrays, meta["occupancy"]) if "occupancy" in meta else None,
            meta["color_space"],
            step,
            background,
            growth,
        )
        if "voxels" in meta:
            field.voxels = _decode_voxels(arrays, meta["voxels"])
    if field.is_empty:
        _warn_once(f'the radiance field "{path}" {EMPTY}')
    return field, meta


@cache
def _warn_once(text: str) -> None:
    """Log a warning once per process."""
    import mitsuba as mi

    log: Any = mi.Log  # missing in the stubs
    log(mi.LogLevel.Warn, text)


def matches_checksum(path: str | Path, sha256: object) -> bool:
    """Return whether ``path`` has this checksum, or is a radiance field that was refined or compiled from the file
    with this checksum.
    """
    if file_sha256(path) == sha256:
        return True
    return (
        Path(path).suffix == ".safetensors" and sha256 is not None and read_metadata(path).get("refined_from") == sha256
    )


def save_gaze(field: GazeNetwork, path: str | Path, provenance: dict, half: bool = False) -> None:
    """Write ``field`` with its support and its re-aimed hits, if any.

    ``provenance`` (JSON) describes the training data and settings.
    """
    config, tensors = field.config, to_stored_arrays(field.parameters(), half)
    metadata = {
        "architecture": field.architecture(),
        "output": {"activation": config.activation, "normalized": config.normalized},
        "box": field.box.to_dict(),
        "units": {"length": "scene unit", "gaze": "1 / steradian"},
        "provenance": provenance,
    }
    if field.support is not None:
        # Counts and positions are never stored as fp16.
        tensors["support.cells"], metadata["support"] = field.support.cells, {"radius": field.support.radius}
    if field.hits is not None:
        tensors["hits.origins"], tensors["hits.points"] = field.hits.origins, field.hits.points
        metadata["hits"] = {"kernels": [list(kernel) for kernel in field.hits.kernels]}
    write_checkpoint(path, "gaze", tensors, metadata)


def _read_hits(arrays: StoredArrays, metadata: object) -> ReaimedHits:
    get = lambda name: arrays.get_array(f"hits.{name}", None, 3, max_value=MAX_COORDINATE)
    # Files of earlier versions have one kernel, whose numbers are entries of their own.
    rows = metadata["kernels"] if isinstance(metadata, dict) and "kernels" in metadata else [metadata]
    if not isinstance(rows, list):
        raise ValueError('"kernels" of its re-aimed hits must be a list')
    names = HitKernel._fields
    parameters = [dict(zip(names, row, strict=True)) if isinstance(row, list) else row for row in rows]
    kernels = [HitKernel(*(read_number(row, name, "re-aimed hits") for name in names)) for row in parameters]
    return ReaimedHits(get("origins"), get("points"), kernels)


def load_gaze(path: str | Path, ns: ModuleType) -> tuple[GazeNetwork, dict[str, Any]]:
    """Read the gaze field in ``path`` on the backend ``ns``, with its support and its re-aimed hits, and its
    metadata with "half" as of `load_radiance`.

    Raises `NergError` if the file contains no gaze field.
    """
    tensors, meta = read_checkpoint(path, "gaze")
    meta["half"] = any(tensor.dtype == np.float16 for tensor in tensors.values())
    with translate_build_errors(path):
        arrays, architecture = StoredArrays(tensors, ns), meta["architecture"]
        check_sizes(architecture, limits=max_sizes_of(architecture))
        if len(architecture.get("members", ())) > MAX_MEMBERS:
            raise ValueError(f"it has {len(architecture['members'])} members; the limit is {MAX_MEMBERS}")
        field = build_gaze_field(architecture, box_from_dict(meta["box"]), arrays)
        if "support" in meta:
            field.support = RaySupport(
                arrays.get_array("support.cells", None, 5, max_value=POSITIVE_VALUES.high), meta["support"]["radius"]
            )
        if "hits" in meta:
            field.hits = _read_hits(arrays, meta["hits"])
            if not field.config.normalized:
                raise ValueError("it has re-aimed hits, but its gaze field is not normalised")
        field.basis = summarize_provenance(meta["provenance"]) if isinstance(meta.get("provenance"), dict) else None
    return field, meta
