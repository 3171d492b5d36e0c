"""A kind of figure: what it is called, which files and options it takes, and how it is drawn."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from nerg_mi.figures.overlay import Style
from nerg_mi.figures.style import find_colors
from nerg_mi.jobs.options import definitions, option
from nerg_mi.jobs.reporter import Reporter
from nerg_mi.ranges import DECADES, SEEDS, SPP, VALUES, Checked, Range


@dataclass(frozen=True)
class Drawing:
    """A ``figure`` of matplotlib, the files that it was made of (``inputs``), and the ``seed`` of what is random in it,
    or None."""

    figure: Any
    inputs: Sequence[Path]
    seed: int | None = None


@dataclass(frozen=True)
class Kind:
    """``name`` and ``summary`` for people; ``takes``: what its files are; ``most``: how many of them at most;
    ``options``: a dataclass, frozen and of keywords alone, whose fields ``option`` makes (`nerg_mi.jobs.options`);
    ``draw(files, options, reporter)``. Raises `NergError` for what the user can mend."""

    name: str
    summary: str
    takes: str
    most: int
    options: type
    draw: Callable[[Sequence[Path], Any, Reporter], Drawing]


@dataclass(frozen=True, kw_only=True)
class ColorOptions(Checked):
    """The colours of a figure's values."""

    top: float | None = option(
        None, "Upper end of the scale, in its unit.  [default: the 99.5th percentile]", within=VALUES
    )
    cmap: str | None = option(None, "Colour map: inferno, magma, plasma, viridis, cividis.  [default: inferno]")
    decades: float = option(0.0, "Powers of ten that the scale spans; 0: a linear scale.", within=DECADES)

    def style(self, title: str | None = None, kind: str = "sequential") -> Style:
        """How overlays are drawn by these options, with colour maps of that ``kind`` (`find_colors`). Raises
        `NergError` for what cannot be drawn."""
        if self.cmap is not None:
            find_colors(self.cmap, kind)
        return Style(self.cmap, self.decades, False, title)


@dataclass(frozen=True, kw_only=True)
class ScaleOptions(ColorOptions):
    """The same of a figure that can be hatched."""

    hatching: bool = option(True, "Hatch where nothing is known.")

    def style(self, title: str | None = None, kind: str = "sequential") -> Style:
        """How overlays are drawn by these options, with colour maps of that ``kind`` (`find_colors`). Raises
        `NergError` for what cannot be drawn."""
        return replace(super().style(title, kind), hatched=self.hatching)


@dataclass(frozen=True, kw_only=True)
class SceneOptions(ScaleOptions):
    """How a scene file is rendered for a figure."""

    defaults: Mapping[str, str] | None = definitions()
    spp: int = option(0, "Samples a pixel; 0: as the scene says.", within=Range(0, SPP.high))
    seed: int = option(0, "Seed of the random numbers.", within=SEEDS)
    mode: str | None = option(
        None, "Mitsuba variant.  [default: cuda_ad_rgb if it works, else llvm_ad_rgb]", "-m", "--mode"
    )
