"""From a scene file to pictures or a video: in one go, or in parts that are kept and that others may make."""

from __future__ import annotations

from pathlib import Path

from .options.parts import FilmOptions
from .pictures import PictureResult, render_file
from .reporter import SILENT, Reporter


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
