"""The place."""

from __future__ import annotations

from nerg_mi.report.html import Html, figure, image, markup, pairs, paragraph
from nerg_mi.report.run import Run

from .protocol import Section


def _show_place(run: Run) -> Html:
    """What it is and what it looks like."""
    shown = [paragraph(run.place), pairs(_facts(run))]
    picture = run.pictures.get("color")
    if picture is not None:
        shown.append(figure(image(picture.png, picture.alt), picture.caption))
    return markup(shown)


def _facts(run: Run) -> list[tuple[str, str]]:
    about, facts = run.radiance.get("provenance", {}), []
    box = run.radiance.get("box") or run.gaze.get("box") or {}
    if "lower" in box and "upper" in box:
        edges = [b - a for a, b in zip(box["lower"], box["upper"])]
        facts.append(("box", " × ".join(f"{e:.2f}" for e in edges) + " scene units (metres, as a rule)"))
    if "training_frames" in about:
        facts.append(("photos", f"{about['training_frames']} that it was trained on"))
    held = about.get("psnr_held_out")
    if isinstance(held, dict) and "mean" in held:
        facts.append(("likeness", f"{held['mean']:.1f} dB PSNR on {len(held.get('views', ()))} photos held out"))
    shape = (run.provenance.get("geometry_file") or {}).get("shape")
    if shape:
        facts.append(("hit points", " × ".join(map(str, shape)) + " voxels made of what people looked at"))
    return facts


PLACE = Section("place", "The place", _show_place)
