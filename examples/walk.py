"""What a shopper looks at on the way along an aisle, seen from a camera that stands still: a moving picture.

    python examples/walk.py [--out walk.webp] [--frames 48] [--width 400] [--quick]

The observer walks along an aisle of the demo store and turns to what attracts them most; the camera looks on from
behind a shelf, so that gaze moves over what both can see, and stops at what is hidden from the shopper. The pictures
are those of ``nerg render scene.xml -o walk.png --overlay gaze --frames walk.csv``, with one scale for all.
"""

from __future__ import annotations

import argparse
import io
import tempfile
from pathlib import Path

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)
from nerg_mi.files.atomic import write_bytes
from nerg_mi.files.tables import write_csv
from nerg_mi.workflows.render import render_file
from nerg_mi.workflows.scene_commands import PictureOptions

import numpy as np

SCENE = Path(__file__).resolve().parents[1] / "scenes" / "store" / "scene.xml"
WAY = np.array([(2.4, 2.8, 1.6), (6.6, 2.8, 1.6)])  # of the shopper's eye, metres
CAMERA = {"camera": "7.4, 3.4, 2.2", "target": "4.8, 4.2, 1.0"}


def render_walk(out: Path, frames: int, width: int, spp: int) -> Path:
    """Write the moving picture ``out`` (.webp or .gif): there and back, 12 frames a second."""
    from PIL import Image

    # Slow at both ends, as people are.
    along = 0.5 - 0.5 * np.cos(np.linspace(0, np.pi, frames // 2 + 1))
    eyes = WAY[0] + along[:, None] * (WAY[1] - WAY[0])
    rows = [{"eye": ", ".join(f"{x:.3f}" for x in eye), "ahead": f"{eye[0] + 0.3:.3f}, 4.4, 1.2"} for eye in eyes]
    with tempfile.TemporaryDirectory() as folder:
        walk = Path(folder) / "walk.csv"
        write_csv(walk, rows)
        height = str(width * 2 // 3)
        values = {**CAMERA, "width": str(width), "height": height, "spp": str(spp)}
        options = PictureOptions(overlay="gaze", frames=walk, defaults=values)
        made = render_file(SCENE, Path(folder) / "walk.png", options)
        pictures = [Image.open(path).convert("RGB") for path in made.files]
    loop, whole = [*pictures, *pictures[-2:0:-1]], io.BytesIO()
    about = {"save_all": True, "append_images": loop[1:], "duration": 1000 // 12, "loop": 0}
    loop[0].save(whole, format=out.suffix[1:], quality=70, method=6, **about)
    write_bytes(out, whole.getvalue())
    return out


def main() -> None:
    words = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    words.add_argument("--out", type=Path, default=Path("walk.webp"))
    words.add_argument("--frames", type=int, default=48, help="of the way there and back")
    words.add_argument("--width", type=int, default=400, help="of the picture in pixels, its scale aside")
    words.add_argument("--quick", action="store_true", help="few and small frames, to see that it works")
    given = words.parse_args()
    size = (6, 96, 2) if given.quick else (given.frames, given.width, 16)
    print(f"wrote {render_walk(given.out, *size)}")


if __name__ == "__main__":
    main()
