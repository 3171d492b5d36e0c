"""The error of a training on views that it does not learn from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from nerg_mi.fields.radiance import RadianceField
from nerg_mi.maths.color import psnr, psnr_of_fitted_half
from nerg_mi.photos.images import View

if TYPE_CHECKING:
    from .trainer import RadianceTrainer


@dataclass(frozen=True)
class HeldOutError:
    """In dB, one of each view: ``psnr`` before black; ``fitted`` of right halves, their colours fitted on left
    halves (`psnr_of_fitted_half`)."""

    psnr: list[float]
    fitted: list[float]

    @property
    def mean(self) -> float:
        return float(np.nanmean(self.psnr))

    @property
    def mean_fitted(self) -> float:
        return float(np.nanmean(self.fitted))


def measure(
    trainer: RadianceTrainer, views: list[View], every: int = 1, field: RadianceField | None = None
) -> HeldOutError:
    """The error on ``views``, on every ``every``-th pixel of those that their masks leave in.

    Of ``field``, by its own occupancy; without one, of the trainer's averaged weights so far.
    """
    field, part = field or trainer.field(bound=False), (slice(every // 2, None, every),) * 2
    errors = HeldOutError([], [])
    for view in views:
        color, truth = trainer.render(view, every, field).color, view.over(0)[part]
        mask = None if view.mask is None else view.mask[part]
        alpha = view.color[part][..., 3] if view.has_alpha else None
        errors.psnr.append(psnr(color, truth, mask))
        errors.fitted.append(psnr_of_fitted_half(color, truth, alpha, mask))
    return errors
