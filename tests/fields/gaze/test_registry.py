"""Kinds of gaze fields by the names that checkpoints give them."""

import pytest

from nerg_mi.fields import gaze_base
from nerg_mi.fields.gaze_log_density import LogGazeField
from nerg_mi.fields.gaze_product import GazeField

from .test_log_density import BOX


def test_the_kinds_of_the_library_are_known():
    """Whichever module is imported first: they register themselves."""
    assert {"product", "log_density", "ensemble"} <= set(gaze_base.kinds())


def test_a_kind_builds_its_checkpoints(monkeypatch):
    """A checkpoint that names none is a product's."""
    monkeypatch.setattr(gaze_base, "_KINDS", dict(gaze_base._KINDS))
    built = []

    @gaze_base.register
    class Other:
        kind = "other"

        @classmethod
        def from_arrays(cls, about, box, arrays):
            built.append((about, box, arrays))
            return cls()

    about = {"kind": "other", "width": 3}
    assert isinstance(gaze_base.build(about, BOX, "arrays"), Other) and built == [(about, BOX, "arrays")]
    for about, cls in (({}, GazeField), ({"kind": "log_density"}, LogGazeField)):
        monkeypatch.setattr(cls, "from_arrays", classmethod(lambda c, *given: (c, *given)))
        assert gaze_base.build(about, BOX, "arrays") == (cls, about, BOX, "arrays")


@pytest.mark.parametrize("kind", ["wavelet", ["product"], 3])
def test_an_unknown_kind_is_refused(kind):
    with pytest.raises((ValueError, TypeError), match="wavelet|kind|unhashable"):
        gaze_base.build({"kind": kind}, BOX, None)
