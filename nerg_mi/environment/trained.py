"""Base of trained fields in memory, with their provenance."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from nerg_mi.errors import NergError
from nerg_mi.fields.gaze_base import GazeNetwork, tracking_suffix
from nerg_mi.fields.radiance import RadianceNetwork
from nerg_mi.files.html import key_value_table
from nerg_mi.files.values import FilePath, hash_arrays, to_path
from nerg_mi.tracking_kinds import read_tracking

from .scene_loading import get_array_module

Network = TypeVar("Network", RadianceNetwork, GazeNetwork)
Field = TypeVar("Field", bound="TrainedField[Any]")


@dataclass(frozen=True, eq=False, repr=False)
class TrainedField(Generic[Network]):
    """A trained field in memory: base of `RadianceField` and `GazeField`.

    Attributes
    ----------
    network : RadianceNetwork or GazeNetwork
        The networks (`nerg_mi.fields`). Their arrays belong to the variant that was active when they were created.
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

    kind: ClassVar[str]
    """``radiance`` or ``gaze``."""

    @classmethod
    def load(cls: type[Field], path: FilePath) -> Field:
        """Load a checkpoint. Raises `NergError` if it does not exist, is damaged, or contains something else."""
        path = to_path(path)
        network, metadata = cls._read(path, get_array_module())
        provenance, origin = metadata.get("provenance", {}), metadata.get("refined_from")
        return cls(network, provenance, path.name, path, origin=origin, half=metadata["half"])

    @classmethod
    def open(cls: type[Field], field: Any) -> Field:
        """Return a field of this class, loaded if ``field`` is a file. Raises `NergError` as `load`, and for a field
        of another kind."""
        if isinstance(field, cls):
            return field
        if isinstance(field, TrainedField):
            raise NergError(f"a {cls.kind} field is needed, and {field!r} is none")
        return cls.load(field)

    @staticmethod
    def _read(path: Path, ns: ModuleType) -> tuple[Any, dict[str, Any]]:
        """Read the networks and the metadata of a checkpoint."""
        raise NotImplementedError

    def _write(self, path: Path, half: bool) -> None:
        """Write a checkpoint."""
        raise NotImplementedError

    @property
    def held_out(self) -> str | None:
        """The score on data that was not trained on, in words; None if the provenance has none."""
        raise NotImplementedError

    @property
    def members(self) -> int:
        """Number of fields in an ensemble; 1 without one."""
        return 1

    @property
    def label(self) -> str:
        """What messages call the field: its file in quotes, or "the gaze field in memory"."""
        return f"the {self.kind} field in memory" if self.path is None else f'"{self.path}"'

    @property
    def bounds(self) -> NDArray[np.float64]:
        """Lower and upper corner (2, 3) of the bounding box of the field, in its own units."""
        return np.array([self.network.box.lower, self.network.box.upper], np.float64)

    @property
    def num_weights(self) -> int:
        """Number of trained weights."""
        parameters = self.network.parameters()
        return sum(int(np.prod(value.shape)) for name, value in parameters.items() if not name.startswith("voxels."))

    @property
    def digest(self) -> str:
        """SHA-256 (hex) of the weights."""
        return hash_arrays({name: np.array(value) for name, value in self.network.parameters().items()})

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
        self._write(path, half)
        return path

    def __repr__(self) -> str:
        lower, upper = (", ".join(f"{x:.3g}" for x in corner) for corner in self.bounds)
        what = f"{self.kind} field" if self.members == 1 else f"ensemble of {self.members} {self.kind} fields"
        name = f"{self.name}{tracking_suffix(self.provenance)}"
        score = f", {self.held_out}" if self.held_out else ""
        return f"<{what} {name}: {self.num_weights:,} weights, box ({lower}) to ({upper}){score}>"

    def _repr_html_(self) -> str:
        lower, upper = (", ".join(f"{x:.3g}" for x in corner) for corner in self.bounds)
        rows = [(f"{self.kind} field", self.name), ("weights", f"{self.num_weights:,}")]
        rows.append(("box", f"({lower}) to ({upper})"))
        rows += [("held-out score", self.held_out)] if self.held_out else []
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
