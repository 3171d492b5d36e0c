"""Radiance and gaze fields in and out of checkpoints: their architectures, checked sizes, and weights as arrays."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from nerg_mi.errors import NergError, sanitize
from nerg_mi.fields.encoding import Encoding, EncodingConfig, config_type, encoding_from_parameters
from nerg_mi.fields.gaze_base import MAX_WEIGHT, AnyGazeField, RaySupport, summarize_provenance, build_gaze_field, max_sizes_of
from nerg_mi.fields.mlp import MLP
from nerg_mi.fields.occupancy import CascadeGrid, OccupancyGrid, RefinedGrid, unpack_bits
from nerg_mi.fields.radiance import Background, BackgroundConfig, RadianceConfig, RadianceField
from nerg_mi.files.atomic import file_sha256
from nerg_mi.maths.arrays import copy_aligned
from nerg_mi.maths.geometry import box_from_dict
from nerg_mi.ranges import POSITIVE_VALUES

from .checkpoint import read_checkpoint, read_metadata, write_checkpoint

# ---- Sizes that a checkpoint claims for its field, checked before anything is built of them ----
#
# The file's arrays bound most sizes, but lists of layers and levels are made from the numbers alone.

_MOST = {"width": 4096, "geometry": 4096, "density_hidden": 64, "color_hidden": 64, "hidden": 64, "sh_degree": 10}
"""The largest whole numbers of an architecture, by name; beyond them no field is trained and no kernel compiles."""

MAX_GRID_RESOLUTION = 1 << 24  # the finest resolution of a grid: float32 tells no more cells apart
MAX_MEMBERS = 64  # members of an ensemble
MAX_OCCUPANCY_CELLS = 1 << 26  # cells of an occupancy grid, over all of its levels: 400 along each edge


@contextmanager
def translate_build_errors(path: str | os.PathLike) -> Iterator[None]:
    """Whatever a checkpoint's contents make the block raise that builds a field of them, as a `NergError` that names
    it."""
    remedy = "copy it again, or train it anew"
    try:
        yield
    except NergError:
        raise
    except KeyError as e:
        raise NergError(f'the checkpoint "{path}" lacks {sanitize(e)}, which its kind of field needs; {remedy}') from e
    except (TypeError, ValueError, AttributeError, IndexError, OverflowError, MemoryError) as e:
        raise NergError(f'the checkpoint "{path}" holds no usable field: {sanitize(e)}; {remedy}') from e


def check_sizes(config: object, section: str = "architecture", limits: Mapping[str, int] = _MOST) -> dict:
    """``about``, the JSON object of a configuration, where its sizes are whole numbers in their bounds, ``most``.

    The sizes of an encoding, its ``grid``, have the bounds that its kind gives. Raises ``ValueError`` otherwise; which
    entries there must be is for the configuration to say.
    """
    if not isinstance(config, dict):
        raise ValueError(f'its "{section}" is not a JSON object')
    for name, value in config.items():
        if name in limits and not (isinstance(value, int) and not isinstance(value, bool) and 1 <= value <= limits[name]):
            raise ValueError(
                f'"{name}" of its {section} must be a whole number from 1 to {limits[name]}, not {sanitize(repr(value), 40)}'
            )
    if "finest" in config and not 1 <= read_number(config, "finest", section) <= MAX_GRID_RESOLUTION:
        raise ValueError(f'"finest" of its {section} must lie in 1..{MAX_GRID_RESOLUTION}, not {sanitize(repr(config["finest"]), 40)}')
    if "grid" in config:
        grid = config["grid"]
        check_sizes(grid, "grid", config_type(grid).max_sizes if isinstance(grid, dict) else {})
    return config


def read_number(config: object, name: str, section: str) -> float:
    """The number ``name`` of the JSON object ``about``. Raises ``ValueError`` where it is none, or single precision
    cannot hold it."""
    value = config[name] if isinstance(config, dict) else None
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) <= POSITIVE_VALUES.high:
        raise ValueError(f'"{name}" of its {section} must be a finite number, not {sanitize(repr(value), 40)}')
    return value


def check_occupancy(config: dict) -> dict:
    """``about``, the JSON object of an occupancy grid, where its size is in bounds; raises ``ValueError`` otherwise."""
    resolution, levels = read_number(config, "resolution", "occupancy"), 1
    read_number(config, "threshold", "occupancy")
    if "bound" in config:
        levels = 1 + math.ceil(math.log2(max(read_number(config, "bound", "occupancy"), 1)))
    if not (isinstance(resolution, int) and resolution >= 1 and levels * resolution**3 <= MAX_OCCUPANCY_CELLS):
        raise ValueError(
            f'"resolution" of its occupancy must be a whole number of cells along an edge, {MAX_OCCUPANCY_CELLS:,} '
            f"cells at most, not {sanitize(repr(resolution), 40)}"
        )
    return config


# ---- Arrays ----
#
# Weights of fields as the arrays of a checkpoint: checked on their way in and on their way out.
#
# Weights may be stored in fp16 (half the size); they are fp32 once loaded.


def to_stored_arrays(parameters: Mapping[str, Any], half: bool) -> dict[str, np.ndarray]:
    """The Dr.Jit arrays ``parameters`` for a file, in fp16 if ``half``. Raises `NergError` for what is not finite, or
    beyond `LARGEST`."""
    out = {}
    for name, value in parameters.items():
        value = value.numpy()
        with np.errstate(over="ignore"):  # what exceeds fp16 is refused below, by name
            out[name] = value.astype(np.float16 if half else np.float32)
        if not np.all(np.abs(value) <= MAX_WEIGHT):
            raise NergError(
                f'the weight array "{name}" is not finite, or beyond {MAX_WEIGHT:g}, so that the training has diverged; '
                "train with a lower learning rate"
            )
        if not np.all(np.isfinite(out[name])):
            raise NergError(f'the weight array "{name}" exceeds what fp16 can hold; leave out --half')
    return out


class StoredArrays:
    """The arrays of a checkpoint by name, as parts of fields on the backend ``ns``.

    All methods raise ``KeyError`` for an array that is not there and ``ValueError`` for one that does not fit.
    """

    def __init__(self, tensors: Mapping[str, np.ndarray], ns: ModuleType):
        self._tensors, self.ns = tensors, ns

    def get_raw(self, name: str) -> np.ndarray:
        """The array ``name`` as it is stored."""
        return self._tensors[name]

    def get_array(self, name: str, *shape: int | None, max_value: float = MAX_WEIGHT) -> np.ndarray:
        """The array ``name`` in fp32, aligned, where it has the ``shape`` (None: of any length) and no value beyond
        ``largest``."""
        found = self._tensors[name].shape
        if len(found) != len(shape) or any(want not in (None, have) for want, have in zip(shape, found)):
            needed = " x ".join("any" if n is None else str(n) for n in shape)
            raise ValueError(f'the weight array "{name}" has the shape {found} where its configuration needs {needed}')
        with np.errstate(over="ignore"):  # what fp32 cannot hold is not finite
            value = copy_aligned(self._tensors[name])
        if not np.all(np.isfinite(value)):
            raise ValueError(f'the weight array "{name}" is not finite')
        if np.abs(value).max(initial=0) > max_value:
            raise ValueError(f'the weight array "{name}" holds values beyond {max_value:g}, as no training makes them')
        return value

    def build_grid(self, config: EncodingConfig, name: str = "grid") -> Encoding:
        """The encoding ``name`` of ``config``."""
        arrays = {f"{name}.{key}": self._dr(f"{name}.{key}", *shape) for key, shape in config.parameter_shapes().items()}
        return encoding_from_parameters(config, arrays, name)

    def build_network(self, name: str, sizes: list[int], normalized: bool = False) -> MLP:
        """The network ``name`` whose layers have these ``sizes``; ``normalized``: with LayerNorm's gains and shifts."""
        tensor = lambda key, *shape: self.ns.TensorXf(self.get_array(f"{name}.{key}", *shape))
        layers, norms = list(enumerate(zip(sizes, sizes[1:]))), None
        if normalized:
            norms = [
                {"gain": tensor(f"{i}.gain", n), "shift": tensor(f"{i}.shift", n), "bias": tensor(f"{i}.bias", m)}
                for i, (n, m) in layers
            ]
        return MLP([tensor(i, m, n) for i, (n, m) in layers], norms)

    def get_member(self, index: int, architecture: dict[str, Any]) -> tuple[dict[str, Any], StoredArrays]:
        """The checked architecture, and the arrays, of the member ``index`` of an ensemble."""
        own = {k.removeprefix(f"{index}."): v for k, v in self._tensors.items() if k.startswith(f"{index}.")}
        return check_sizes(architecture, limits=max_sizes_of(architecture)), StoredArrays(own, self.ns)

    def _dr(self, name: str, *shape: int) -> Any:
        value = self.get_array(name, *shape)
        return self.ns.Float(value) if len(shape) == 1 else self.ns.TensorXf(value)


# ---- Radiance and gaze fields in and out of checkpoint files ----
#
# Which kinds of gaze fields there are is known to ``fields.gaze_base``.


def _occupancy(arrays: StoredArrays, about: dict) -> OccupancyGrid | RefinedGrid | CascadeGrid:
    check_occupancy(about)
    bits, resolution, threshold = arrays.get_raw("occupancy.bits"), about["resolution"], about["threshold"]
    if "bound" in about:
        return CascadeGrid.from_packed(bits, resolution, about["bound"], arrays.ns, threshold)
    if "refined" not in about:
        return OccupancyGrid.from_packed(bits, resolution, arrays.ns, threshold)
    limit, missed = (read_number(about["refined"], name, "refined occupancy") for name in ("threshold", "missed"))
    cells = unpack_bits(bits, resolution)
    return RefinedGrid(cells, arrays.get_raw("occupancy.parts"), arrays.ns, limit, threshold, missed)


def encode_occupancy(grid: OccupancyGrid | RefinedGrid | CascadeGrid) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """``grid`` as arrays of a checkpoint, by name, and what its metadata say. Of a refined one the cells that it
    refines stand there too, as readers that know no parts expect them."""
    cells = grid.coarse
    tensors = {"occupancy.bits": cells.pack_bits()}
    about: dict[str, Any] = {"resolution": cells.resolution, "threshold": cells.threshold}
    if isinstance(cells, CascadeGrid):
        about["bound"] = cells.bound
    if isinstance(grid, RefinedGrid):
        tensors["occupancy.parts"] = grid.masks
        about["refined"] = {"threshold": grid.threshold, "missed": grid.missed_optical_depth}
    return tensors, about


def save_radiance(field: RadianceField, path: str | Path, provenance: dict, half: bool = False) -> None:
    """Write ``field``; ``provenance`` (JSON) says what it was trained on and with."""
    tensors = to_stored_arrays(field.parameters(), half)
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
        arrays, metadata["occupancy"] = encode_occupancy(field.occupancy)
        tensors |= arrays
    if field.background is not None:
        metadata["background"] = field.background.config.to_dict()
    write_checkpoint(path, "radiance", tensors, metadata)


def load_radiance(path: str | Path, ns: ModuleType) -> tuple[RadianceField, dict[str, Any]]:
    """The field in ``path`` on backend ``ns`` (see ``fields.mlp.namespace``), and its metadata.

    Raises `NergError` for a file that holds none.
    """
    tensors, meta = read_checkpoint(path, "radiance")
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
            behind = BackgroundConfig.from_dict(check_sizes(meta["background"], "background"))
            background = Background(
                behind, arrays.build_grid(behind.grid, "background_grid"), arrays.build_network("background_net", behind.sizes)
            )
        field = RadianceField(
            config,
            box_from_dict(meta["box"]),
            arrays.build_grid(config.grid),
            arrays.build_network("density_net", config.density_sizes),
            arrays.build_network("color_net", config.color_sizes),
            _occupancy(arrays, meta["occupancy"]) if "occupancy" in meta else None,
            meta["color_space"],
            step,
            background,
            growth,
        )
    return field, meta


def matches_checksum(path: str | Path, sha256: object) -> bool:
    """Whether ``path`` is the file of this checksum, or a radiance field that was made of it by refining its bound."""
    if file_sha256(path) == sha256:
        return True
    return (
        Path(path).suffix == ".safetensors" and sha256 is not None and read_metadata(path).get("refined_from") == sha256
    )


def save_gaze(field: AnyGazeField, path: str | Path, provenance: dict, half: bool = False) -> None:
    """Write ``field``, with its support where it has one; ``provenance`` (JSON) says what it was trained on and
    with."""
    c, tensors = field.config, to_stored_arrays(field.parameters(), half)
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
    with translate_build_errors(path):
        arrays, about = StoredArrays(tensors, ns), meta["architecture"]
        check_sizes(about, limits=max_sizes_of(about))
        if len(about.get("members", ())) > MAX_MEMBERS:
            raise ValueError(f"it has {len(about['members'])} members, and at most {MAX_MEMBERS} are read")
        field = build_gaze_field(about, box_from_dict(meta["box"]), arrays)
        if "support" in meta:
            field.support = RaySupport(
                arrays.get_array("support.cells", None, 5, max_value=POSITIVE_VALUES.high), meta["support"]["radius"]
            )
        field.basis = summarize_provenance(meta["provenance"]) if isinstance(meta.get("provenance"), dict) else None
    return field, meta
