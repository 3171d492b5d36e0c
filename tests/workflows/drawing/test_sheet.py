"""Contact sheets of files."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.figures.overlay import srgb, top_of, write_png
from nerg_mi.workflows.draw import draw

from .test_files import COLOR, GAZE, OPACITY, write


def test_one_scale_for_all(tmp_path):
    bright = np.where(OPACITY > 0.5, 3 * GAZE, 100)
    files = [
        write(tmp_path / "first.exr", **{"opacity.Y": OPACITY}),
        write(tmp_path / "second.exr", **{"opacity.Y": OPACITY, "gaze.Y": bright.astype(np.float32)}),
    ]
    figure = draw("sheet", files, overlay="gaze")
    assert [a.get_title() for a in figure.axes[:2]] == ["first", "second"]
    bar = figure.axes[-1 if figure.axes[-1].get_ylabel() else -2]
    bar = next(a for a in figure.axes if a.get_ylabel())
    top = top_of(bright, OPACITY > 0.5)
    said = [float(t.get_text()) for t in bar.get_yticklabels()]
    np.testing.assert_allclose(bar.get_yticks(), np.array(said) / top, atol=1e-6)
    assert "no data" in [t.get_text() for a in figure.axes for t in a.texts]


def test_pictures_as_they_are(rgb, tmp_path):
    write_png(tmp_path / "a.png", COLOR)
    write(tmp_path / "b.exr")
    figure = draw("sheet", [tmp_path / "a.png", tmp_path / "b.exr"], tmp_path / "out.png", columns=2)
    a, b = (axes.images[0].get_array() for axes in figure.axes)
    np.testing.assert_allclose(a, COLOR, atol=0.51 / 255)
    np.testing.assert_allclose(b, srgb(COLOR))
    assert (tmp_path / "out.png").is_file()


def test_nothing_to_take_a_scale_from(tmp_path):
    dark = write(tmp_path / "a.exr", **{"gaze.Y": 0 * GAZE})
    with pytest.raises(NergError, match='"gaze" is 0'):
        draw("sheet", dark, overlay="gaze")
    assert draw("sheet", dark, overlay="gaze", top=1.0).axes


def test_what_the_pictures_rest_on_is_said_below(tmp_path):
    texts = [{"gaze.basis": f"made of {n} rays of 2 people"} for n in (5, 6)]
    a, b = (write(tmp_path / f"{name}.exr", text) for name, text in zip("ab", texts))
    said = lambda *files: {t.get_text().replace("\n", " ") for t in draw("sheet", list(files), overlay="gaze").texts}
    assert said(a, a) == {texts[0]["gaze.basis"]}
    assert said(a, b) == {f"a: {texts[0]['gaze.basis']}; b: {texts[1]['gaze.basis']}"}
    figure = draw("difference", [a, a])
    assert figure.texts[0].get_text().replace("\n", " ") == texts[0]["gaze.basis"]
