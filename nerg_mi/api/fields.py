"""Fields and gaze samples in memory, and the Mitsuba variant that they belong to."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any, Generic, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from nerg_mi.errors import NergError
from nerg_mi.fields.gaze_base import AnyGazeField, read_tracking, tracking_suffix
from nerg_mi.fields.radiance import RadianceField
from nerg_mi.files.html import key_value_table
from nerg_mi.formats.fields import load_radiance, save_gaze, save_radiance
from nerg_mi.rays.rays import Rays

# ---- The active Mitsuba variant ----


def activate_mitsuba() -> ModuleType:
    """Import Mitsuba with a variant active.

    An active variant is kept. Otherwise ``cuda_ad_rgb`` is activated if it works, and ``llvm_ad_rgb`` if not, as in the
    command `nerg`.

    Returns
    -------
    module
        ``mitsuba``.

    Raises
    ------
    NergError
        A scalar variant is active.
    """
    import mitsuba as mi

    variant = mi.variant()
    if variant is None:
        from nerg_mi.rendering.scene import activate_variant

        activate_variant()
    elif variant.startswith("scalar"):
        raise NergError(
            f'fields do not support scalar variants such as "{variant}"; '
            'call mi.set_variant("llvm_ad_rgb") or mi.set_variant("cuda_ad_rgb") first'
        )
    return mi


def get_array_module() -> ModuleType:
    """Return the Dr.Jit array types of the active variant (`nerg_mi.fields.mlp.namespace`)."""
    from nerg_mi.fields.mlp import namespace

    return namespace(activate_mitsuba().variant())


# ---- Fields and gaze samples in memory ----


FilePath: TypeAlias = str | Path
Network = TypeVar("Network", RadianceField, AnyGazeField)


@dataclass(frozen=True, eq=False, repr=False)
class TrainedField(Generic[Network]):
    """A radiance field or a gaze field in memory.

    Attributes
    ----------
    network : RadianceField or gaze field
        The field (`nerg_mi.fields`). Its arrays belong to the variant that was active when it was created.
    provenance : mapping
        Training data, options and scores, as stored in the file.
    name : str
        Name of the file.
    path : Path or None
        The checkpoint; None if the field is not saved.
    """

    network: Network
    provenance: Mapping[str, Any] = field(default_factory=dict)
    name: str = "in memory"
    path: Path | None = None

    @property
    def kind(self) -> str:
        """``radiance`` or ``gaze``."""
        return "radiance" if isinstance(self.network, RadianceField) else "gaze"

    @property
    def bounds(self) -> NDArray[np.float64]:
        """Lower and upper corner (2, 3) of the bounding box of the field, in its own units."""
        return np.array([self.network.box.lower, self.network.box.upper], np.float64)

    @property
    def num_weights(self) -> int:
        """Number of trained weights."""
        parameters = self.network.parameters()
        return sum(int(np.prod(value.shape)) for name, value in parameters.items() if not name.startswith("voxels."))

    def save(self, path: FilePath, half: bool = False) -> Path:
        """Write a checkpoint (.safetensors) atomically.

        Parameters
        ----------
        path : path
            File to write.
        half : bool
            Whether to store the weights as fp16 instead of fp32.

        Returns
        -------
        Path
            The file.

        Raises
        ------
        NergError
            The weights are not finite or exceed fp16, or the file cannot be written.
        """
        path = Path(path)
        if path.suffix.lower() != ".safetensors":
            raise NergError(f'fields are saved as .safetensors; change the file name extension of "{path}"')
        if isinstance(self.network, RadianceField):
            save_radiance(self.network, path, dict(self.provenance), half)
        else:
            save_gaze(self.network, path, dict(self.provenance), half)
        return path

    def __repr__(self) -> str:
        lower, upper = (", ".join(f"{x:.3g}" for x in corner) for corner in self.bounds)
        members = 1 if isinstance(self.network, RadianceField) else len(self.network.members)
        what = f"{self.kind} field" if members == 1 else f"ensemble of {members} gaze fields"
        name = f"{self.name}{tracking_suffix(self.provenance)}"
        return f"<{what} {name}: {self.num_weights:,} weights, box ({lower}) to ({upper})>"

    def _repr_html_(self) -> str:
        lower, upper = (", ".join(f"{x:.3g}" for x in corner) for corner in self.bounds)
        rows = [(f"{self.kind} field", self.name), ("weights", f"{self.num_weights:,}")]
        rows.append(("box", f"({lower}) to ({upper})"))
        facts = dict(self.provenance)
        if self.provenance.get("rays"):
            facts["tracking"] = read_tracking(self.provenance)
        rows += [(key.replace("_", " "), str(v)) for key, v in facts.items() if isinstance(v, (str, int))]
        rows += [
            (key, ", ".join(f"{k} {_format(v)}" for k, v in values.items()))
            for key, values in self.provenance.items()
            if key in ("validation", "mix")
        ]
        return key_value_table(rows)


def _format(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def load_field(path: FilePath) -> TrainedField[RadianceField]:
    """Load a radiance field: density and colour of an environment.

    Parameters
    ----------
    path : path
        A checkpoint written by ``nerg train radiance``, `train_radiance` or ``nerg import``.

    Returns
    -------
    TrainedField
        The field, for `make_scene`.

    Raises
    ------
    NergError
        The file does not exist, is damaged, or contains something else.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> from importlib.resources import files
    >>> store = files("nerg_mi.scenes.store")
    >>> field = nerg.load_field(store / "store.safetensors")
    >>> field.bounds.tolist()
    [[-0.1, -0.1, -0.1], [8.1, 6.1, 3.1]]
    """
    network, metadata = load_radiance(as_path(path), get_array_module())
    return TrainedField(network, metadata.get("provenance", {}), Path(path).name, Path(path))


def load_rays(path: FilePath) -> Rays:
    """Load recorded gaze samples.

    Parameters
    ----------
    path : path
        A file (.npz or .parquet) written by ``nerg rays import``, `import_rays` or `Rays.save`, or a dataset (.rays) of
        at most 50 million samples.

    Returns
    -------
    Rays
        The samples, right-handed with z up, in metres and seconds.

    Raises
    ------
    NergError
        The file does not exist or is damaged.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> rays = nerg.Rays(t=[0, 0.1], person=[0, 0], persons=("Ada",), origin=[[1, 1, 1.6]] * 2,
    ...                  direction=[[1, 0, 0], [0, 1, 0]], confidence=[1, 1])
    >>> rays.save(folder / "rays.npz")
    >>> len(nerg.load_rays(folder / "rays.npz"))
    2
    """
    from nerg_mi.rays.dataset import load_rays as load

    return load(as_path(path))


def as_path(path: FilePath) -> Path:
    """Return ``path`` as a `Path`. Raises `NergError` for anything but a string or a path."""
    try:
        return Path(path)
    except TypeError as error:
        raise NergError(f"a file must be given as a string or a path, got {type(path).__name__}") from error
