"""Radiance fields in memory: loading, saving, and the error on held-out photos."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from nerg_mi.fields.radiance import RadianceNetwork
from nerg_mi.files.atomic import file_sha256
from nerg_mi.formats.fields import load_radiance, save_radiance

from .trained import TrainedField


@dataclass(frozen=True, eq=False, repr=False)
class RadianceField(TrainedField[RadianceNetwork]):
    """A radiance field in memory, loaded from a file or returned by `train_radiance`.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> from importlib.resources import files
    >>> field = nerg.RadianceField.load(files("nerg_mi.scenes.store") / "store.safetensors")
    >>> field.kind, field.held_out
    ('radiance', '26.1 dB PSNR on 12 held-out photos')
    """

    kind = "radiance"

    @staticmethod
    def _read(path: Path, ns: ModuleType) -> tuple[RadianceNetwork, dict[str, Any]]:
        return load_radiance(path, ns)

    def _write(self, path: Path, half: bool) -> None:
        save_radiance(self.network, path, dict(self.provenance), half, self.origin)

    def derive(self, network: RadianceNetwork, **provenance: Any) -> RadianceField:
        """Return a field with the weights of this one that is compiled or refined, with more ``provenance``."""
        origin = self.origin or (None if self.path is None else file_sha256(self.path))
        return RadianceField(network, {**self.provenance, **provenance}, origin=origin, half=self.half)

    @property
    def held_out(self) -> str | None:
        """The PSNR on held-out photos, in words; None if the provenance has none."""
        return describe_psnr(self.provenance)


def get_validation_views(provenance: Mapping[str, Any]) -> list[str]:
    """Return the names of the held-out photos that chose the state of the radiance field with this ``provenance``.

    Checkpoints of earlier versions name the views that were evaluated during the training. These chose the state if the
    evaluation of the ``result`` is stored; before that, the last state was the result.
    """
    watched = provenance.get("psnr_watched")
    earlier = watched.get("views") if isinstance(watched, Mapping) and "result" in watched else None
    names = provenance.get("validation_views", earlier)
    return [name for name in names if isinstance(name, str)] if isinstance(names, list) else []


def describe_psnr(provenance: Mapping[str, Any]) -> str | None:
    """Return the PSNR on held-out photos in the ``provenance`` of a radiance field, in words; None if it has none."""
    psnr = provenance.get("psnr_held_out")
    views = psnr.get("views") if isinstance(psnr, Mapping) else None
    if not isinstance(views, Mapping):
        return None
    # Not the stored mean, in which earlier versions include photos that chose the state.
    validation = get_validation_views(provenance)
    scores = [x for name, x in views.items() if name not in validation and isinstance(x, float)]
    return f"{np.mean(scores):.1f} dB PSNR on {len(scores)} held-out photos" if scores else None
