"""Radiance and gaze fields in and out of checkpoint files.

Weights may be stored in fp16 (half the size); they are fp32 once loaded.
"""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.field.backend import aligned
from nerg_mi.field.background import Background, BackgroundConfig
from nerg_mi.field.cascades import CascadeGrid
from nerg_mi.field.encoding.hashgrid import HashGrid
from nerg_mi.field.gaze.ensemble import GazeEnsemble
from nerg_mi.field.gaze.log_density import LogGazeConfig, LogGazeField
from nerg_mi.field.gaze.product import GazeConfig, GazeField
from nerg_mi.field.gaze.support import RaySupport
from nerg_mi.field.mlp import MLP
from nerg_mi.field.occupancy import OccupancyGrid
from nerg_mi.field.radiance import RadianceConfig, RadianceField
from nerg_mi.files.bounded import plain
from nerg_mi.maths.box import Box

from .architecture import MEMBERS, building, check_occupancy, check_sizes, number
from .checkpoint import read_checkpoint, write_checkpoint


def _dump(parameters: dict, half: bool) -> dict[str, np.ndarray]:
    out = {}
    for name, value in parameters.items():
        value = value.numpy()
        with np.errstate(over="ignore"):  # what exceeds fp16 is refused below, by name
            stored = value.astype(np.float16 if half else np.float32)
        if not np.all(np.isfinite(stored)):
            if np.all(np.isfinite(value)):
                raise NergError(f'the weight array "{name}" exceeds what fp16 can hold; leave out --half')
            raise NergError(
                f'the weight array "{name}" is not finite, so that the training has diverged; train with a lower learning rate'
            )
        out[name] = stored
    return out


def _finite(tensors: dict, name: str, shape: tuple[int | None, ...]) -> np.ndarray:
    """The array ``name``, aligned. Raises ``ValueError`` where it has not the ``shape`` (None: of any length)."""
    found = tensors[name].shape
    if len(found) != len(shape) or any(want not in (None, have) for want, have in zip(shape, found)):
        said = " x ".join("any" if n is None else str(n) for n in shape)
        raise ValueError(f'the weight array "{name}" has the shape {found} where its configuration needs {said}')
    with np.errstate(over="ignore"):  # what fp32 cannot hold is not finite
        value = aligned(tensors[name])
    if not np.all(np.isfinite(value)):
        raise ValueError(f'the weight array "{name}" is not finite')
    return value


def _net(tensors: dict, name: str, sizes: list[int], ns: ModuleType, normalized: bool = False) -> MLP:
    array = lambda key, *shape: ns.TensorXf(_finite(tensors, f"{name}.{key}", shape))
    layers, norms = list(enumerate(zip(sizes, sizes[1:]))), None
    if normalized:
        norms = [
            {"gain": array(f"{i}.gain", n), "shift": array(f"{i}.shift", n), "bias": array(f"{i}.bias", m)}
            for i, (n, m) in layers
        ]
    return MLP([array(i, m, n) for i, (n, m) in layers], norms)


def _grid(tensors: dict, config, ns: ModuleType, name: str = "grid") -> HashGrid:
    return HashGrid(config, ns.Float(_finite(tensors, f"{name}.table", (config.offsets()[-1] * config.features,))))


def _occupancy(tensors: dict, about: dict, ns: ModuleType) -> OccupancyGrid | CascadeGrid:
    check_occupancy(about)
    bits, resolution, threshold = tensors["occupancy.bits"], about["resolution"], about["threshold"]
    if "bound" in about:
        return CascadeGrid.from_packed(bits, resolution, about["bound"], ns, threshold)
    return OccupancyGrid.from_packed(bits, resolution, ns, threshold)


def save_radiance(field: RadianceField, path: str | Path, provenance: dict, half: bool = False) -> None:
    """Write ``field``; ``provenance`` (JSON) says what it was trained on and with."""
    tensors = _dump(field.parameters(), half)
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


def load_radiance(path: str | Path, ns: ModuleType) -> tuple[RadianceField, dict]:
    """The field in ``path`` on backend ``ns`` (see ``field.backend.namespace``), and its metadata."""
    tensors, meta = read_checkpoint(path, "radiance")
    with building(path):
        config, occupancy, background = RadianceConfig.from_dict(check_sizes(meta["architecture"])), None, None
        step = meta["march_step"]
        if step is not None and not 0 < number(meta, "march_step", "metadata"):
            raise ValueError(f'its "march_step" must be positive, not {step}')
        if "occupancy" in meta:
            occupancy = _occupancy(tensors, meta["occupancy"], ns)
        if "background" in meta:
            behind = BackgroundConfig.from_dict(check_sizes(meta["background"], "background"))
            background = Background(
                behind,
                _grid(tensors, behind.grid, ns, "background_grid"),
                _net(tensors, "background_net", behind.sizes, ns),
            )
        field = RadianceField(
            config,
            Box(**meta["box"]),
            _grid(tensors, config.grid, ns),
            _net(tensors, "density_net", config.density_sizes, ns),
            _net(tensors, "color_net", config.color_sizes, ns),
            occupancy,
            meta["color_space"],
            step,
            background,
        )
    return field, meta


def save_gaze(
    field: GazeField | LogGazeField | GazeEnsemble, path: str | Path, provenance: dict, half: bool = False
) -> None:
    """Write ``field``, with its support where it has one; ``provenance`` (JSON) says what it was trained on and
    with."""
    c, tensors = field.config, _dump(field.parameters(), half)
    members = [m.config.to_dict() for m in getattr(field, "members", ())]
    metadata = {
        "architecture": {"kind": "ensemble", "members": members} if members else c.to_dict(),
        "output": {"activation": c.activation, "normalized": c.normalized},
        "box": field.box.to_dict(),
        "units": {"length": "scene unit", "gaze": "1 / steradian"},
        "provenance": provenance,
    }
    if field.support is not None:
        # Counts and positions: never in fp16.
        tensors["support.cells"], metadata["support"] = field.support.cells, {"radius": field.support.radius}
    write_checkpoint(path, "gaze", tensors, metadata)


def load_gaze(path: str | Path, ns: ModuleType) -> tuple[GazeField | LogGazeField | GazeEnsemble, dict]:
    """The gaze field in ``path`` on backend ``ns``, with its support, and its metadata."""
    tensors, meta = read_checkpoint(path, "gaze")
    with building(path):
        about, box = meta["architecture"], Box(**meta["box"])
        if about.get("kind") == "ensemble":
            if len(about["members"]) > MEMBERS:
                raise ValueError(f"it has {len(about['members'])} members, and at most {MEMBERS} are read")
            own = lambda i: {k.removeprefix(f"{i}."): v for k, v in tensors.items() if k.startswith(f"{i}.")}
            field = GazeEnsemble([_gaze(own(i), member, box, ns) for i, member in enumerate(about["members"])])
        else:
            field = _gaze(tensors, about, box, ns)
        if "support" in meta:
            field.support = RaySupport(_finite(tensors, "support.cells", (None, 5)), meta["support"]["radius"])
    return field, meta


def _gaze(tensors: dict, about: dict, box: Box, ns: ModuleType) -> GazeField | LogGazeField:
    kind = check_sizes(about).get("kind", "product")
    if kind == "log_density":
        return _log_gaze(tensors, LogGazeConfig.from_dict(about), box, ns)
    if kind != "product":
        raise ValueError(f'it is a gaze field of the kind "{plain(kind, 40)}", which this version does not know')
    config = GazeConfig.from_dict(about)
    sizes = {
        "position_net": config.position_sizes,
        "direction_net": config.direction_sizes,
        "emit_head": [config.width, 1],
        "capture_head": [config.width, 1],
    }
    layernorm = lambda name: config.trunk == "layernorm" and not name.endswith("head")
    nets = {name: _net(tensors, name, size, ns, layernorm(name)) for name, size in sizes.items()}
    return GazeField(config, box, _grid(tensors, config.grid, ns), **nets)


def _log_gaze(tensors: dict, config: LogGazeConfig, box: Box, ns: ModuleType) -> LogGazeField:
    return LogGazeField(
        config,
        box,
        _grid(tensors, config.grid, ns),
        _net(tensors, "emit_net", config.emit_sizes, ns),
        _net(tensors, "capture_net", config.capture_sizes, ns),
        ns.Float(_finite(tensors, "escaped", (1,))),
        ns.TensorXf(_finite(tensors, "prior", (config.prior, 2 * config.prior))),
    )
