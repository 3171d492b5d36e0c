"""The error on views that are not learnt from: of which pixels, of which colours."""

from dataclasses import replace

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.maths.color import psnr, psnr_of_fitted_half
from nerg_mi.train.radiance_run import HeldOutError, measure
from nerg_mi.train.radiance_trainer import RadianceTrainer

from .ball import BOX, TINY, settings


def test_what_a_mask_hides_does_not_count_in_the_progress(dataset):
    view = dataset.held_out[0]
    trainer = RadianceTrainer(dataset.train, BOX, TINY, settings(), ns, depth=False)
    mask = np.arange(24)[:, None] < np.full(24, 12)
    spoilt = view.pixels.copy()
    spoilt[~mask] = 1 - spoilt[~mask]
    whole, other, masked, same = measure(
        trainer,
        [
            view,
            replace(view, pixels=spoilt),
            *(replace(view, pixels=pixels, mask=mask) for pixels in (view.pixels, spoilt)),
        ],
        2,
    ).psnr
    assert masked == same and whole != other and masked != whole


def test_both_errors_are_those_of_the_rendered_view(dataset):
    trainer, views = RadianceTrainer(dataset.train, BOX, TINY, settings(), ns, depth=False), dataset.held_out[:2]
    field = trainer.field(bound=False)
    error = measure(trainer, views, 2, field)
    for k, view in enumerate(views):
        seen, truth = trainer.render(view, 2, field).color, view.over(0)[1::2, 1::2]
        assert error.psnr[k] == pytest.approx(psnr(seen, truth), rel=1e-6)
        alpha = view.color[1::2, 1::2, 3]
        assert error.fitted[k] == pytest.approx(psnr_of_fitted_half(seen, truth, alpha), rel=1e-6)


def test_views_of_which_nothing_counts_are_left_out_of_the_mean():
    error = HeldOutError([20.0, float("nan"), 22.0], [float("nan"), 25.0, 27.0])
    assert error.mean == 21 and error.mean_fitted == 26
    assert np.isnan(HeldOutError([20.0], [float("nan")]).mean_fitted)
