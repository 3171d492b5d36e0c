"""Fields and rays in memory: read from files, handed to scenes, and saved again."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from nerg_mi.errors import NergError
from nerg_mi.fields.gaze_base import AnyGazeField
from nerg_mi.fields.radiance import RadianceField
from nerg_mi.formats.fields import load_gaze as read_gaze
from nerg_mi.formats.fields import load_radiance, save_gaze, save_radiance

from .variant import array_module

if TYPE_CHECKING:
    from nerg_mi.rays.rays import Rays

FilePath: TypeAlias = str | Path
Network = TypeVar("Network", RadianceField, AnyGazeField)


@dataclass(frozen=True, eq=False, repr=False)
class TrainedField(Generic[Network]):
    """A radiance field or a gaze field in memory.

    ``network``: the field itself (`nerg_mi.fields`), whose arrays belong to the variant that was active when it was
    made. ``provenance``: what it was trained on and with, as its file keeps it. ``name``: the file's, or what it is.
    ``path``: the checkpoint that holds it, None where there is none.
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
        """Lower and upper corner (2, 3) of where the field may hold density, in its own units."""
        return np.array([self.network.box.lower, self.network.box.upper], np.float64)

    @property
    def weights(self) -> int:
        """How many numbers were trained."""
        return sum(int(np.prod(value.shape)) for value in self.network.parameters().values())

    def save(self, path: FilePath, half: bool = False) -> Path:
        """Write a checkpoint (.safetensors), whole or not at all, and give its path; ``half``: weights in fp16.

        Raises `NergError` for weights that are not finite or exceed fp16, and for a file that cannot be written.
        """
        path = Path(path)
        if path.suffix.lower() != ".safetensors":
            raise NergError(f'a field is saved as .safetensors, and "{path}" ends otherwise; choose another name')
        if isinstance(self.network, RadianceField):
            save_radiance(self.network, path, dict(self.provenance), half)
        else:
            save_gaze(self.network, path, dict(self.provenance), half)
        return path

    def __repr__(self) -> str:
        lower, upper = (", ".join(f"{x:.3g}" for x in corner) for corner in self.bounds)
        members = 1 if isinstance(self.network, RadianceField) else len(self.network.members)
        what = f"{self.kind} field" if members == 1 else f"ensemble of {members} gaze fields"
        return f"<{what} {self.name}: {self.weights:,} weights, box ({lower}) to ({upper})>"


def load_field(path: FilePath) -> TrainedField[RadianceField]:
    """Read a radiance field: density and colour of a place.

    ``path``: a checkpoint that ``nerg train radiance``, `train_radiance` or ``nerg import`` has written. Give what
    comes back to `make_scene`, look at ``.bounds``, write it again with ``.save(path)``. Raises `NergError` for a file
    that is missing, damaged, or holds something else.

    >>> import nerg_mi as nerg
    >>> from importlib.resources import files
    >>> store = files("nerg_mi.scenes.store")
    >>> field = nerg.load_field(store / "store.safetensors")
    >>> field.bounds.tolist()
    [[-0.1, -0.1, -0.1], [8.1, 6.1, 3.1]]
    """
    network, metadata = load_radiance(_existing(path), array_module())
    return TrainedField(network, metadata.get("provenance", {}), Path(path).name, Path(path))


def load_gaze(path: FilePath) -> TrainedField[AnyGazeField]:
    """Read a gaze field, or an ensemble of them: how much surfaces attract an observer.

    ``path``: a checkpoint that ``nerg train gaze``, `train_gaze` or ``nerg import`` has written; the rest is as for
    `load_field`.

    >>> import nerg_mi as nerg
    >>> from importlib.resources import files
    >>> store = files("nerg_mi.scenes.store")
    >>> gaze = nerg.load_gaze(store / "shoppers.safetensors")
    >>> gaze.kind
    'gaze'
    """
    network, metadata = read_gaze(_existing(path), array_module())
    return TrainedField(network, metadata.get("provenance", {}), Path(path).name, Path(path))


def load_rays(path: FilePath) -> Rays:
    """Read rays of attention: who looked from where to where, and when.

    ``path``: a file (.npz or .parquet) that ``nerg rays import``, `import_rays` or the method ``save`` of rays has
    written; or a dataset (.rays), of at most 50 million rays. Right-handed, z up, metres and seconds (`Rays`). Raises
    `NergError` for a file that is missing or damaged.

    >>> import nerg_mi as nerg
    >>> rays = nerg.Rays(t=[0, 0.1], person=[0, 0], persons=("Ada",), origin=[[1, 1, 1.6]] * 2,
    ...                  direction=[[1, 0, 0], [0, 1, 0]], confidence=[1, 1])
    >>> rays.save(folder / "rays.npz")
    >>> len(nerg.load_rays(folder / "rays.npz"))
    2
    """
    from nerg_mi.rays.dataset_open import load_rays as load

    return load(_existing(path))


def _existing(path: FilePath) -> Path:
    try:
        return Path(path)
    except TypeError as error:
        raise NergError(f"a file is named by a string or a path, got {type(path).__name__}") from error
