"""Render an animation of a shopper's gaze along an aisle, seen from a fixed camera.

    python examples/walk.py [--out walk.webp] [--frames 48] [--width 400] [--quick]

The observer walks along an aisle of the demo store; the camera is behind a shelf. Gaze moves over surfaces visible to
both, and stops where surfaces are hidden from the shopper. The pictures are those of ``nerg render scene.xml -o
walk.png --overlay gaze --frames walk.csv``, with one common scale.
"""

from __future__ import annotations

import argparse
import io
import tempfile
from pathlib import Path

import nerg_mi as nerg  # chooses the libLLVM, so it comes before drjit and mitsuba
from nerg_mi.files.atomic import write_bytes

import numpy as np

SCENE = Path(__file__).resolve().parents[1] / "scenes" / "store" / "scene.xml"
PATH = np.array([(2.4, 2.8, 1.6), (6.6, 2.8, 1.6)])  # path of the shopper's eye, metres
CAMERA = {"camera": "7.4, 3.4, 2.2", "target": "4.8, 4.2, 1.0"}


def render_walk(out: Path, frames: int, width: int, spp: int) -> Path:
    """Write the animation ``out`` (.webp or .gif): there and back, 12 frames per second."""
    from PIL import Image

    # Slow at both ends, as a person would walk.
    along = 0.5 - 0.5 * np.cos(np.linspace(0, np.pi, frames // 2 + 1))
    positions = PATH[0] + along[:, None] * (PATH[1] - PATH[0])
    rows = [{"eye": ", ".join(f"{x:.3f}" for x in eye), "ahead": f"{eye[0] + 0.3:.3f}, 4.4, 1.2"} for eye in positions]
    with tempfile.TemporaryDirectory() as folder:
        height = str(width * 2 // 3)
        values = {**CAMERA, "width": str(width), "height": height, "spp": str(spp)}
        made = nerg.render_film(SCENE, Path(folder) / "walk.png", frames=rows, overlay="gaze", defaults=values)
        pictures = [Image.open(path).convert("RGB") for path in made.files]
    loop, buffer = [*pictures, *pictures[-2:0:-1]], io.BytesIO()
    save_options = {"save_all": True, "append_images": loop[1:], "duration": 1000 // 12, "loop": 0}
    loop[0].save(buffer, format=out.suffix[1:], quality=70, method=6, **save_options)
    write_bytes(out, buffer.getvalue())
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("walk.webp"), help="output file, .webp or .gif")
    parser.add_argument("--frames", type=int, default=48, help="number of frames, there and back (default: 48)")
    parser.add_argument(
        "--width", type=int, default=400, help="width of the picture without the scale, pixels (default: 400)"
    )
    parser.add_argument("--quick", action="store_true", help="render few and small frames, to test the script")

    options = parser.parse_args()
    size = (6, 96, 2) if options.quick else (options.frames, options.width, 16)
    print(f"wrote {render_walk(options.out, *size)}")


if __name__ == "__main__":
    main()
