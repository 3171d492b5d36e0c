"""Largest numerical errors of transport and gaze, over the ranges that scenes may ask for.

    python benchmarks/numerics.py [--only march,pictures,gaze] [--update docs/numerics.md]

Every case is compared with a closed form or with float64, forwards and for its derivative, and gives one row: case,
range, quantity, largest error found, reference. Prints markdown; `--update` puts the tables
into a document in place of those that stand there under the same headings. Errors are relative unless
the row says otherwise. Nothing passes or fails here: bounds are kept by the tests.
"""

from __future__ import annotations

import argparse
import importlib
from dataclasses import dataclass
from pathlib import Path

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)
from output import print_table

HEAD = ["case", "range", "quantity", "largest error", "reference"]
"""Of tables whose lines are `Row`s."""

GROUPS = ("march", "rays", "pictures", "gaze")


@dataclass
class Row:
    """One line of a table. ``error``: a number, or a sentence where the outcome is not one."""

    case: str
    range: str
    quantity: str
    error: float | str
    reference: str

    def cells(self) -> list[str]:
        shown = self.error if isinstance(self.error, str) else f"{self.error:.1e}"
        return [self.case, self.range, self.quantity, "0" if shown == "0.0e+00" else shown, self.reference]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default=",".join(GROUPS), help="comma-separated groups")
    parser.add_argument("--update", type=Path, help="a document whose tables are replaced, heading by heading")
    args = parser.parse_args()
    names = args.only.split(",")
    for name in names:
        if name not in GROUPS:
            parser.error(f'there is no group "{name}"; there are {", ".join(GROUPS)}')

    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    for name in names:
        for title, head, rows in importlib.import_module(f"numerics_{name}").tables(mi):
            print_table(title, head, rows, args.update)


if __name__ == "__main__":
    main()
