"""Options of the viewer."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from nerg_mi.ranges import COORDINATES, SPP, Checked, Range

from . import option, parse_numbers


@dataclass(frozen=True, kw_only=True)
class ViewOptions(Checked):
    """Where the page is, how fine its pictures are, and what is shown first."""

    host: str = option("127.0.0.1", "Address to serve at; another than this machine's own asks pages for a token.")
    port: int = option(8080, "Port to serve at; 0: any that is free.", within=Range(0, 65535))
    names: tuple[str, ...] = option((), "Name by which others reach this machine, beside its address.", "--name")
    width: int = option(720, "Width of a refined picture in pixels.", within=Range(16, 8192))
    spp: int = option(0, "Samples a pixel of it; 0: as the scene says.", within=Range(0, SPP.high))
    observer: tuple[float, ...] | None = option(
        None, "Position of the observer's eye, x,y,z.  [default: the scene's]", parse=parse_numbers, within=COORDINATES
    )
    up: tuple[float, ...] | None = option(
        None,
        "Which way is up in the place, x,y,z.  [default: as its files say]",
        parse=parse_numbers,
        within=COORDINATES,
    )
    regions: Path | None = option(None, "JSON file of areas of interest: boxes with names.")
    align: Path | None = option(
        None, "JSON file with the 4x4 similarity from the rays' frame to the place's.  [default: the gaze field's]"
    )
    geometry: str | None = option(
        None, 'What rays alone are shown in: "hits", their hit points, or "none".  [default: hits if there are any]'
    )
    open: bool = option(False, "Open the page in this machine's browser.")
    mode: str | None = option(
        None, "Mitsuba variant.  [default: cuda_ad_rgb if it works, else llvm_ad_rgb]", "-m", "--mode"
    )
