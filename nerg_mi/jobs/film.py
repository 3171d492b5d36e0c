"""``nerg render``: Render a scene file to a picture or a video.

From a scene file to pictures or a video: in one go, or in parts that are kept and that others may make.
"""

from __future__ import annotations

from pathlib import Path

from .commands import argument, command, out
from .options.parts import FilmOptions
from .pictures import PictureResult, render_file
from .reporter import SILENT, Reporter


@command(
    "render",
    "Render a scene file to a picture or a video, with the integrator that the scene names.",
    more="""An EXR file holds all channels in float32, those of the AOVs among them; a PNG file holds the colour,
tonemapped to sRGB, or an overlay with its scale, which an SVG file can hold, too. Pictures of a sequence have a number
added to their names, or are the frames of an MP4 file.

With --store or --scheduler each picture is kept when it is done, and the same command goes on where it ended.""",
    options=FilmOptions,
    scene=argument("Mitsuba scene file (.xml)."),
    output=out("Picture to write: .exr (all channels), .png; .svg, .mp4."),
)
def render_film(
    scene: str | Path, output: str | Path, options: FilmOptions | None = None, reporter: Reporter = SILENT
) -> PictureResult:
    """Render the scene file ``scene`` to ``output``, as `render_file` does, and to the same bytes.

    With ``options.store`` or ``options.scheduler`` each picture of a sequence is a part, which is kept and not rendered
    again: whatever ended the job, the same call goes on. A picture depends on the scene, on the files that it names, on
    its own values and on the options, and on nothing else: those whose inputs have changed are rendered anew. The
    reporter hears the progress of either.
    """
    options = options or FilmOptions()
    if not options.in_parts:
        return render_file(scene, output, options, reporter)
    # A single picture needs neither time nor memory for it.
    from .film_parts import render_parts

    return render_parts(Path(scene), Path(output), options, reporter)
