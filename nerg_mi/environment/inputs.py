"""Inputs of commands in any order: an environment, a gaze field and rays, recognised by their content."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from nerg_mi.errors import NergError
from nerg_mi.fields.splats import Splats
from nerg_mi.tracking.dataset import RayDataset
from nerg_mi.tracking.rays import Rays

from .contents import DensityGrid, is_trimesh
from .environment import Environment
from .kinds import ROLES, detect_kind
from .scene import Scene
from .trained import TrainedField


class Inputs(NamedTuple):
    """Inputs by their role, in memory or as files (`Path`); None without one."""

    environment: Any = None
    gaze: Any = None
    rays: Any = None

    def prefer_files(self) -> Inputs:
        """Return these inputs, with objects that have a file replaced by it."""
        return Inputs(*(_get_file(value) or value for value in self))


_NAMES = {"environment": "environments", "gaze": "gaze fields", "rays": "rays"}


def sort_inputs(inputs: object) -> Inputs:
    """Return one input, or several in any order, by their roles.

    Raises `NergError` if two of them have the same role, and for anything else.
    """
    by_role: dict[str, Any] = {}
    for item in inputs if isinstance(inputs, (list, tuple)) else [inputs]:
        role, value = find_role(item), Path(item) if isinstance(item, (str, os.PathLike)) else item
        if role in by_role:
            raise NergError(f"{name_input(by_role[role])} and {name_input(value)} are both {_NAMES[role]}; give one")
        by_role[role] = value
    return Inputs(**by_role)


def _get_file(value: Any) -> Path | None:
    return value.path if isinstance(value, (Environment, TrainedField, Scene)) else None


def find_role(item: object) -> str:
    """Return what an input is, by its content: "environment", "gaze" or "rays". Raises `NergError` for anything
    else."""
    if isinstance(item, (str, os.PathLike)):
        return ROLES.get(detect_kind(Path(item)), "environment")
    if isinstance(item, (Rays, RayDataset)):
        return "rays"
    if isinstance(item, TrainedField):
        return "gaze" if item.kind == "gaze" else "environment"
    if isinstance(item, (Environment, Scene, Splats, DensityGrid, Mapping)) or is_trimesh(item):
        return "environment"
    import mitsuba as mi

    if mi.variant() is not None and isinstance(item, mi.Object):
        return "environment"
    raise NergError(
        "inputs must be environments, gaze fields and rays (of a data frame by Rays.from_dataframe), in memory or as "
        f"files, got {type(item).__name__}"
    )


def name_input(item: object) -> str:
    """Return what messages call an input: its file in quotes, or its class."""
    return f'"{item}"' if isinstance(item, (str, os.PathLike)) else f"the {type(item).__name__} in memory"
