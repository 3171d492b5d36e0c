"""People without their names: what a report shows of rays and of evaluations unless names are asked for."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from nerg_mi.evaluation.gaze.results import GazeResults
from nerg_mi.rays.rays import Rays

# Metadata of rays that name nobody.
_KEPT = ("frame", "source_frame", "transform", "rows_read", "preset")
# Names of fewer characters are parts of too many words to be looked for within them.
_WORD = 3


class Labels:
    """Numbered people, as in "person 1", in place of names: by the number of rays, the most first, and then those who
    are only named by evaluations."""

    def __init__(self, rays: Rays | None, results: Iterable[GazeResults] = ()):
        names: list[str] = []
        if rays is not None:
            count = np.bincount(rays.person, minlength=len(rays.persons))
            names = [rays.persons[i] for i in np.argsort(-count, kind="stable")]
        for found in results:
            names += [str(row["person"]) for row in found.persons if "person" in row]
        self._number = {name: k + 1 for k, name in enumerate(dict.fromkeys(names))}
        self._label = {name: f"person {number}" for name, number in self._number.items()}

    def of(self, name: str) -> str:
        """What stands for ``name``."""
        return self._label.get(name, "a person")

    def number(self, name: str) -> int:
        """The number that stands for ``name``, 0 for nobody's."""
        return self._number.get(name, 0)

    def hide(self, text: str) -> str:
        """``text``, such as a file's name, with what stands for people in place of their names: also within words, but
        for names of one or two characters."""
        parts = sorted((n for n in self._label if n), key=len, reverse=True)
        pattern = "|".join(re.escape(n) if len(n) >= _WORD else rf"(?<!\w){re.escape(n)}(?!\w)" for n in parts)
        folded = {name.lower(): label for name, label in self._label.items()}
        swap = lambda found: folded.get(found.group().lower(), "a person")
        return re.sub(pattern, swap, text, flags=re.IGNORECASE) if pattern else text


def rays_without_names(rays: Rays, labels: Labels) -> Rays:
    """``rays`` whose people are called by ``labels``, and of whose metadata only that is left which names nobody."""
    about = {key: rays.metadata[key] for key in _KEPT if key in rays.metadata}
    files = [d.get("file") for d in rays.metadata.get("dropped", [])]
    number = {name: f"file {k + 1}" for k, name in enumerate(dict.fromkeys(files))}
    about["dropped"] = [{**d, "file": number[d.get("file")]} for d in rays.metadata.get("dropped", [])]
    words = ("step", "side", "kept", "of")
    about["steps"] = [{k: step[k] for k in words if k in step} for step in rays.metadata.get("steps", [])]
    # In the order of the labels, since that of names or files can be guessed.
    order = sorted(range(len(rays.persons)), key=lambda i: labels.number(rays.persons[i]))
    code = np.empty(len(order), np.int32)
    code[order] = np.arange(len(order))
    return replace(
        rays, person=code[rays.person], persons=tuple(labels.of(rays.persons[i]) for i in order), metadata=about
    )


def results_without_names(found: GazeResults, labels: Labels) -> GazeResults:
    """``found`` whose people are called by ``labels``."""
    persons = tuple({**row, "person": labels.of(str(row.get("person", "")))} for row in found.persons)
    return replace(found, persons=persons)
