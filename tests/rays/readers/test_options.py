"""Typed options of readers."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pytest

from nerg_mi.errors import NergError
from nerg_mi.rays.readers.base import NoOptions, TickOption, option, options_of, recorded_options


@dataclass(frozen=True, kw_only=True)
class Some(TickOption):
    min_height: float = option(1.5, "Metres.")
    poses: Path | None = option(None, "A file.")
    pair: tuple[int, int] = option((1, 2), "Two.", flag="--two", shown="1,2", parse=lambda text: (0, 0))
    rough: bool = option(False, "Whether.")
    secret: str = option("a", "Told elsewhere.", recorded=False)


def test_what_is_said_of_each():
    tick, height, poses, pair, rough, secret = options_of(Some)
    assert (tick.flag, tick.kind, tick.shown, tick.default) == ("--tick", float, "1", 1.0)
    assert (height.flag, height.shown, height.help, height.recorded) == ("--min-height", "1.5", "Metres.", True)
    assert (poses.kind, poses.shown, poses.default) == (Path, "", None)
    assert (pair.flag, pair.kind, pair.shown, pair.parse("9,9")) == ("--two", str, "1,2", (0, 0))
    assert (rough.kind, rough.shown) == (bool, "") and not secret.recorded and options_of(NoOptions) == ()


def test_what_goes_into_the_metadata():
    assert recorded_options(Some(poses=Path("a"))) == {"tick": 1.0, "min_height": 1.5, "pair": [1, 2], "rough": False}
    assert recorded_options(NoOptions()) == {}


def test_refusals():
    for tick in (0.0, -1.0, float("nan"), 1e13):
        with pytest.raises(NergError, match="--tick"):
            Some(tick=tick)

    @dataclass(frozen=True)
    class Silent:
        a: int = 1

    with pytest.raises(TypeError, match="Silent.a says nothing of itself"):
        options_of(Silent)
    with pytest.raises(TypeError, match="is no dataclass"):
        options_of(int)
