"""Trained fields in memory, with their provenance."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from nerg_mi.errors import NergError
from nerg_mi.fields.gaze_base import AnyGazeField, tracking_suffix
from nerg_mi.fields.radiance import RadianceField
from nerg_mi.files.atomic import file_sha256
from nerg_mi.files.html import key_value_table
from nerg_mi.files.values import FilePath, to_path
from nerg_mi.formats.fields import load_radiance, save_gaze, save_radiance
from nerg_mi.rendering.scene import get_array_module
from nerg_mi.tracking_kinds import read_tracking

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
    origin : str or None
        Checksum of the checkpoint that this field was compiled or refined from; gaze fields that were trained in that
        one accept this one.
    half : bool
        Whether the checkpoint has the weights as fp16.
    """

    network: Network
    provenance: Mapping[str, Any] = field(default_factory=dict)
    name: str = "in memory"
    path: Path | None = None
    origin: str | None = field(default=None, kw_only=True)
    half: bool = field(default=False, kw_only=True)

    def derive(self, network: Network, **provenance: Any) -> TrainedField[Network]:
        """Return a field with the weights of this one that is compiled or refined, with more ``provenance``."""
        origin = self.origin or (None if self.path is None else file_sha256(self.path))
        return TrainedField(network, {**self.provenance, **provenance}, origin=origin, half=self.half)

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

    def save(self, path: FilePath, half: bool | None = None) -> Path:
        """Write a checkpoint (.safetensors) atomically.

        Parameters
        ----------
        path : path
            File to write.
        half : bool, optional
            Whether to store the weights as fp16 instead of fp32. Default: as in the file of the field, else fp32.

        Returns
        -------
        Path
            The file.

        Raises
        ------
        NergError
            The weights are not finite or exceed fp16, or the file cannot be written.
        """
        path, half = Path(path), self.half if half is None else half
        if path.suffix.lower() != ".safetensors":
            raise NergError(f'fields are saved as .safetensors; change the file name extension of "{path}"')
        if isinstance(self.network, RadianceField):
            save_radiance(self.network, path, dict(self.provenance), half, self.origin)
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
    network, metadata = load_radiance(to_path(path), get_array_module())
    origin = metadata.get("refined_from")
    return TrainedField(
        network, metadata.get("provenance", {}), Path(path).name, Path(path), origin=origin, half=metadata["half"]
    )


def open_field(field: TrainedField[RadianceField] | FilePath) -> TrainedField[RadianceField]:
    """Return ``field``, loaded if it is a file."""
    if not isinstance(field, TrainedField):
        return load_field(field)
    if field.kind != "radiance":
        raise NergError(f"a radiance field is needed, and {field!r} is none")
    return field
