"""Sizes that a checkpoint claims for its field, checked before anything is built of them.

The file's arrays bound most sizes, but lists of layers and levels are made from the numbers alone.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

from nerg_mi.errors import NergError
from nerg_mi.fields.encoding import config_type
from nerg_mi.files.safe_read import plain
from nerg_mi.ranges import VALUES

_MOST = {"width": 4096, "geometry": 4096, "density_hidden": 64, "color_hidden": 64, "hidden": 64, "sh_degree": 10}
"""The largest whole numbers of an architecture, by name; beyond them no field is trained and no kernel compiles."""

FINEST = 1 << 24
"""The finest resolution of a grid: float32 tells no more cells apart."""

MEMBERS = 64
"""Members of an ensemble."""

OCCUPANCY_CELLS = 1 << 26
"""Cells of an occupancy grid, over all of its levels: 400 along each edge."""


@contextmanager
def building(path: str | os.PathLike) -> Iterator[None]:
    """Whatever a checkpoint's contents make the block raise that builds a field of them, as a `NergError` that names
    it."""
    remedy = "copy it again, or train it anew"
    try:
        yield
    except NergError:
        raise
    except KeyError as e:
        raise NergError(f'the checkpoint "{path}" lacks {plain(e)}, which its kind of field needs; {remedy}') from e
    except (TypeError, ValueError, AttributeError, IndexError, OverflowError, MemoryError) as e:
        raise NergError(f'the checkpoint "{path}" holds no usable field: {plain(e)}; {remedy}') from e


def check_sizes(about: object, what: str = "architecture", most: Mapping[str, int] = _MOST) -> dict:
    """``about``, the JSON object of a configuration, where its sizes are whole numbers in their bounds, ``most``.

    The sizes of an encoding, its ``grid``, have the bounds that its kind gives. Raises ``ValueError`` otherwise; which
    entries there must be is for the configuration to say.
    """
    if not isinstance(about, dict):
        raise ValueError(f'its "{what}" is not a JSON object')
    for name, value in about.items():
        if name in most and not (isinstance(value, int) and not isinstance(value, bool) and 1 <= value <= most[name]):
            raise ValueError(
                f'"{name}" of its {what} must be a whole number from 1 to {most[name]}, not {_short(value)}'
            )
    if "finest" in about and not 1 <= number(about, "finest", what) <= FINEST:
        raise ValueError(f'"finest" of its {what} must lie in 1..{FINEST}, not {_short(about["finest"])}')
    if "grid" in about:
        grid = about["grid"]
        check_sizes(grid, "grid", config_type(grid).limits if isinstance(grid, dict) else {})
    return about


def number(about: object, name: str, what: str) -> float:
    """The number ``name`` of the JSON object ``about``. Raises ``ValueError`` where it is none, or single precision
    cannot hold it."""
    value = about[name] if isinstance(about, dict) else None
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) <= VALUES.high:
        raise ValueError(f'"{name}" of its {what} must be a finite number, not {_short(value)}')
    return value


def check_occupancy(about: dict) -> dict:
    """``about``, the JSON object of an occupancy grid, where its size is in bounds; raises ``ValueError`` otherwise."""
    resolution, levels = number(about, "resolution", "occupancy"), 1
    number(about, "threshold", "occupancy")
    if "bound" in about:
        levels = 1 + math.ceil(math.log2(max(number(about, "bound", "occupancy"), 1)))
    if not (isinstance(resolution, int) and resolution >= 1 and levels * resolution**3 <= OCCUPANCY_CELLS):
        raise ValueError(
            f'"resolution" of its occupancy must be a whole number of cells along an edge, {OCCUPANCY_CELLS:,} '
            f"cells at most, not {_short(resolution)}"
        )
    return about


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 40 else text[:40] + "..."
