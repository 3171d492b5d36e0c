"""Tests of `nerg_mi.train.radiance_monitor`."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.figures.style import figure_of, rasterize
from nerg_mi.figures.training import psnr_figure
from nerg_mi.photos.cameras import Intrinsics, PosedCamera
from nerg_mi.photos.images import PhotoView
from nerg_mi.train.radiance_monitor import (
    MAX_PREVIEW_FRACTION,
    PREVIEW_WIDTH,
    GuardedObserver,
    PreviewWriter,
    write_curves_table,
)

from .ball import LENS, trainer

# ---- Previews ----


def stand_in(color, samples_per_ray=1.0, **values):
    """A trainer in the middle of a run of 100 s, with 1e6 evaluations a second, that renders ``color``."""

    def render(view, every, field, stride):
        t.rendered.append((view, every, stride))
        part = slice(every // 2, None, every)
        full = np.broadcast_to(np.asarray(color, np.float32), (*view.shape, 3))
        return SimpleNamespace(color=full[part, part])

    t = SimpleNamespace(
        seconds=50.0,
        progress=0.5,
        stride=4,
        clock=SimpleNamespace(seconds=10.0, evaluations=10**7),
        estimate_samples=lambda view, stride: view.shape[0] * view.shape[1] * samples_per_ray / stride,
        render=render,
        rendered=[],
    )
    vars(t).update(values)
    return t


def photo(width, height):
    """A photo with the red of its column and the green of its row, and its camera."""
    pixels = np.zeros((height, width, 3), np.float32)
    pixels[..., 0], pixels[..., 1] = np.linspace(0, 1, width), np.linspace(0, 1, height)[:, None]
    return PhotoView(
        "a", PosedCamera(Intrinsics(width, height, 900.0, 900.0, width / 2, height / 2), np.eye(4)), pixels
    )


def read(rgb, path):
    return np.array(rgb.Bitmap(str(path)))


@pytest.mark.parametrize(
    ("size", "shown"),
    [((1000, 600), (400, 240)), ((401, 200), (400, 200)), ((400, 300), (400, 300)), ((90, 160), (90, 160))],
)
def test_a_preview_has_the_width_of_the_photo_up_to_a_maximum(size, shown, tmp_path, rgb):
    t = stand_in([0.5, 0.5, 0.5])
    assert PreviewWriter(tmp_path / "a.png", photo(*size)).write_if_affordable(t)
    width, height = shown
    picture = read(rgb, tmp_path / "a.png")
    assert picture.shape == (height, 2 * width, 3) and PREVIEW_WIDTH == 400
    lens = t.rendered[0][0].camera.intrinsics
    assert (lens.width, lens.height) == shown and lens.fx / width == pytest.approx(900 / size[0])
    truth = np.linspace(0, 255, width)
    assert np.abs(picture[:, width:, 0] - truth).max() < 2 and (picture[:, :width] == 128).all()


@pytest.mark.parametrize(("value", "stored"), [(1.7, 255), (-0.4, 0), (0.5, 128)])
def test_colours_are_clamped(value, stored, tmp_path, rgb):
    """Colours above white are white and do not wrap around."""
    PreviewWriter(tmp_path / "a.png", photo(8, 8)).write_if_affordable(stand_in([value] * 3))
    assert (read(rgb, tmp_path / "a.png")[:, :8] == stored).all()


def test_the_stride_follows_the_cost(tmp_path):
    """Of 4e4 pixels, at 1e6 samples a second and 2.1 s: the finest strides that are affordable, or no preview."""
    path = tmp_path / "a.png"
    cases = [(50, 1, (1, 1)), (100, 1, (1, 2)), (200, 1, (1, 4)), (250, 1, (2, 4)), (2000, 1, (4, 4)), (4000, 1, None)]
    cases += [(250, 16, (1, 8)), (9000, 16, (4, 16)), (20000, 16, None)]
    for samples_per_ray, coarsest, strides in cases:
        t = stand_in([0, 0, 0], samples_per_ray, stride=coarsest)
        assert PreviewWriter(path, photo(200, 200)).write_if_affordable(t) == (strides is not None)
        assert [tuple(rest) for _, *rest in t.rendered] == ([] if strides is None else [strides])
        assert path.exists() == (strides is not None)
        path.unlink(missing_ok=True)
    # The last preview is always written.
    for samples_per_ray, coarsest, strides in ((250, 1, (1, 2)), (20000, 1, (4, 4)), (90000, 16, (4, 16))):
        t = stand_in([0, 0, 0], samples_per_ray, seconds=100.0, progress=1.0, stride=coarsest)
        PreviewWriter(path, photo(200, 200)).write_result(t, "field")
        assert [tuple(rest) for _, *rest in t.rendered] == [strides] and path.exists()


@pytest.mark.parametrize("size", [(9, 6), (10, 7), (11, 8)])
def test_a_coarse_rendering_is_enlarged(size, tmp_path, rgb):
    """The rendering is the photo itself, each of whose pixels is at most three columns and rows away."""
    view = photo(*size)
    t = stand_in(view.pixels, 4000 * 4e4 / np.prod(size) / 1.5)
    assert PreviewWriter(tmp_path / "a.png", view).write_if_affordable(t) and t.rendered[0][1:] == (4, 4)
    picture = read(rgb, tmp_path / "a.png").astype(float) / 255
    rendered, truth = picture[:, : size[0]], picture[:, size[0] :]
    assert picture.shape == (size[1], 2 * size[0], 3)
    assert np.abs(rendered[..., 0] - truth[..., 0]).max() <= 3.1 / (size[0] - 1)
    assert np.abs(rendered[..., 1] - truth[..., 1]).max() <= 3.1 / (size[1] - 1)
    # Blocks of pixels have one colour.
    assert (rendered[:4, :4] == rendered[0, 0]).all()


def test_previews_take_a_fraction_of_the_run(dataset, tmp_path):
    """A real training of 60 steps in which a preview is due after each step; measured against the clock."""
    t = trainer(dataset, steps=60)
    view = replace(dataset.held_out[0], camera=PosedCamera(LENS.resized(120, 120), dataset.held_out[0].camera.to_world))
    view = replace(view, pixels=np.zeros((120, 120, 3), np.uint8), depth=None)
    t.step()
    t.render(view)  # Compiles its kernels
    t.start()
    writer, written = PreviewWriter(tmp_path / "a.png", view), []
    for _ in range(59):
        t.step()
        before = writer.seconds
        if writer.write_if_affordable(t):
            written.append(writer.seconds - before)
    # The cost of a preview is known after the first one only, and the length of the run is estimated.
    assert writer.seconds < MAX_PREVIEW_FRACTION * t.seconds + 2 * max(written, default=0.0)
    assert len(written) < 59


# ---- Observers ----


def test_an_error_of_an_observer_is_reported_once():
    calls, warnings = [], []

    class Fails:
        def on_start(self, trainer, dataset):
            calls.append("start")

        def on_step(self, trainer, history):
            calls.append("step")
            raise NergError("the page is gone.")

    observer = GuardedObserver(Fails(), warnings.append)
    observer.on_start(None, None)
    observer.on_step(None, [])
    observer.on_step(None, [])
    assert calls == ["start", "step"]
    (text,) = warnings
    assert "NergError: the page is gone);" in text and "training continues" in text


def test_ctrl_c_passes_an_observer():
    class Interrupted:
        def on_start(self, trainer, dataset):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        GuardedObserver(Interrupted(), lambda text: None).on_start(None, None)


# ---- Curves ----

HISTORY = [
    {"steps": 50, "seconds": 4.0, "psnr": 13.0, "psnr_train": 13.5, "every_pixel": 4},
    {"steps": 90, "seconds": 8.0, "psnr": 18.0, "psnr_train": None, "every_pixel": 2},
    {"steps": 120, "seconds": 12.0, "psnr": 17.0, "psnr_train": 20.0, "every_pixel": 2, "more": 1},
]


def test_unknown_values_are_empty_cells(tmp_path):
    write_curves_table(tmp_path / "a.csv", HISTORY)
    lines = (tmp_path / "a.csv").read_text().splitlines()
    assert [line.rsplit(",", 1)[0] for line in lines if "psnr_train:" not in line] == [
        "steps,seconds,psnr,psnr_train,every_pixel",
        "50,4.0,13.0,13.5,4",
        "120,12.0,17.0,20.0,2",
    ]
    assert lines[2].startswith('90,8.0,18.0,,2,"psnr_train: ')


def test_the_figure_has_both_curves_and_the_written_state():
    page = figure_of(psnr_figure(HISTORY, HISTORY[1]))
    axes, top = page.axes
    lines = {line.get_label(): line for line in axes.lines}
    np.testing.assert_array_equal(lines["held-out views"].get_ydata(), [13, 18, 17])
    np.testing.assert_array_equal(lines["training views"].get_ydata(), [13.5, np.nan, 20])
    marked = lines["written state: step 90, 18.00 dB on these held-out views"]
    assert marked.get_xydata().tolist() == [[8, 18]]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("training time [s]", "PSNR [dB]")
    assert sorted(int(t.get_text()) for t in top.get_xticklabels()) == [50, 90, 120]
    assert rasterize(page).shape == (460, 720, 3)


def test_a_single_evaluation_is_drawn():
    rasterize(psnr_figure([{"steps": 1, "seconds": 0.0, "psnr": 10.0}]))
