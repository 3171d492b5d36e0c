"""A format of tracking that nobody writes, as somebody would add it: a file of eyes beside a file of heads."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.rays.readers.base import Frame, RaysBuilder, Signature, TickOption, option
from nerg_mi.rays.readers.tables import iterate_table


@dataclass(frozen=True, kw_only=True)
class MadeUpOptions(TickOption):
    heads: Path | None = option(None, "File of the heads' places.")
    scale: float = option(1.0, "What a unit of the heads' places is, in metres.")
    blinks: bool = option(False, "Keep blinks.")


class MadeUp:
    """Columns t, a, b, c of directions; x, y, z of heads, row by row."""

    name = "made_up"
    files = "directions, with the file of the heads in `--heads`"
    world = "y up, right, m"
    checked_on = "itself"
    signature = Signature(
        columns=(("t", "a", "b", "c", "open"),),
        options={"--heads": "HEADS"},
        question="the file of the heads (--heads)",
    )
    Options = MadeUpOptions

    def frame(self, files: Sequence[Path], options: MadeUpOptions) -> Frame:
        return Frame(up="y")

    def read(self, files: Sequence[Path], options: MadeUpOptions, builder: RaysBuilder) -> None:
        if options.heads is None:
            raise NergError("directions alone are no rays; name the file of the heads (--heads)")
        builder.source(options.heads)
        heads = np.concatenate([b.numbers for b in iterate_table(options.heads, ["x", "y", "z"])])
        for path in files:
            builder.source(path)
            for values, _, lines in iterate_table(path, ["t", "a", "b", "c", "open"], on_bad=builder.on_bad):
                builder.add(
                    values[:, 0] * options.tick,
                    path.stem,
                    options.scale * heads[lines - 2],
                    values[:, 1:4],
                    rows=lines,
                    drop={} if options.blinks else {"a blink": values[:, 4] == 0},
                )


def write_recording(folder: Path) -> tuple[Path, Path]:
    """Files of directions and of heads: two rows, of which the second is a blink."""
    (folder / "ann.csv").write_text("t,a,b,c,open\n0,0,0,-2,1\n500,1,0,0,0\n")
    (folder / "heads.csv").write_text("x,y,z\n100,160,-300\n200,160,0\n")
    return folder / "ann.csv", folder / "heads.csv"
