"""How tracking lies in a place."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from nerg_mi.workflows.base import SILENT, Reporter

from .fields import FilePath
from .options import options_of, rays_of

if TYPE_CHECKING:
    from nerg_mi.alignment.check import Alignment
    from nerg_mi.rays.rays import Rays
    from nerg_mi.workflows.align import AlignOptions


def align(
    rays: Rays | FilePath | None = None,
    output: FilePath | None = None,
    *,
    options: AlignOptions | None = None,
    reporter: Reporter = SILENT,
    **changes: Any,
) -> Alignment:
    """Find the similarity from the frame of ``rays`` (z up, metres) to that of a place.

    ``rays``: what `load_rays` or `import_rays` gave, or a file of them; not needed where other evidence is given.
    ``output``: alignment to write besides (.json), which ``align=`` of `train_gaze` takes, with a picture beside it.
    ``changes``: options one by one on top of ``options``: the place (``field=``, ``scene=``, ``surface=``), evidence
    (``pairs=``, ``twin=``, ``cameras=`` with ``place_cameras=``; none of them: the tracking alone), and what is known
    (``up=``, ``scale=``, ...); `nerg_mi.workflows.align.AlignOptions` says what there is. Raises `NergError` for
    evidence that leaves it open, for a mirrored frame and for a bad fit.

    >>> import nerg_mi as nerg
    >>> rows = "0,0,0,1,0,0\\n2,0,0,5,0,0\\n0,1,0,1,2,0\\n0,0,1,1,0,2\\n"
    >>> _ = (folder / "pairs.csv").write_text("x,y,z,place_x,place_y,place_z\\n" + rows)
    >>> found = nerg.align(pairs=folder / "pairs.csv")
    >>> (found.matrix.round(6) + 0.0)[0].tolist()
    [2.0, 0.0, 0.0, 1.0]
    """
    from nerg_mi.workflows import align as alignment
    from nerg_mi.workflows.align import AlignOptions

    job = options_of(AlignOptions, "align", options, changes)
    return alignment.align(None if rays is None else rays_of(rays), output, job, reporter).alignment
