"""Options of scene files that are written for checkpoints."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from nerg_mi.ranges import COORDINATES, FIELDS_OF_VIEW, RATES, SECONDS, TIMES, Checked, Range

from . import option, parse_numbers


@dataclass(frozen=True, kw_only=True)
class SceneOptions(Checked):
    """Who looks, and from where it is shown. Positions are in the coordinates of the place."""

    observer: tuple[float, ...] | None = option(
        None,
        "Position of the observer's eye, x,y,z.  [default: where most rays are]",
        parse=parse_numbers,
        within=COORDINATES,
    )
    person: str | None = option(None, "Person of the rays whose eye the observer's is, at --time or --times.")
    time: float | None = option(None, "When, in seconds of the rays' clock.", within=TIMES)
    times: tuple[float, ...] | None = option(
        None,
        "From when to when, A,B: also writes the frames of a walk, for nerg render --frames.",
        parse=parse_numbers,
        within=TIMES,
    )
    fps: float = option(10.0, "Frames a second of --times.", within=RATES)
    gap: float = option(0.5, "Seconds without a ray of that person that are bridged.", within=SECONDS)
    camera_from: tuple[float, ...] | None = option(
        None,
        "Position of the camera, x,y,z.  [default: the best overview]",
        "--from",
        parse=parse_numbers,
        within=COORDINATES,
    )
    camera_to: tuple[float, ...] | None = option(
        None, "Point that it looks at, x,y,z.", "--to", parse=parse_numbers, within=COORDINATES
    )
    own: bool = option(False, "The camera is the observer's own eye.")
    photos: Path | None = option(None, "Photos that the radiance field was trained on: the camera is one of theirs.")
    photo: str | None = option(None, "Which of them: its name, or its number from 0 on.  [default: the best]")
    allow_outside: bool = option(False, "Read files outside of --photos' folder too, where it names them.")
    fov: float | None = option(
        None, "Degrees between the left and right border of the picture.  [default: 70]", within=FIELDS_OF_VIEW
    )
    width: int = option(480, "Width of the picture in pixels.", within=Range(1, 16384))
    up: tuple[float, ...] | None = option(
        None,
        "Which way is up in the place, x,y,z.  [default: as its files say]",
        parse=parse_numbers,
        within=COORDINATES,
    )
    align: Path | None = option(
        None, "JSON file with the 4x4 similarity from the rays' frame to the place's.  [default: the gaze field's]"
    )
    geometry: str | None = option(
        None, 'What rays alone are shown in: "hits", their hit points, or "none".  [default: hits if there are any]'
    )
    mode: str | None = option(
        None, "Mitsuba variant.  [default: cuda_ad_rgb if it works, else llvm_ad_rgb]", "-m", "--mode"
    )
