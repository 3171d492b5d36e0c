"""A ray's way through the package: which functions call which while a picture is traced, drawn by room.

What is recorded is one render of the demo store with depth, gaze and visibility of an observer beside the camera, in a
process of its own, so that nothing has been traced before. Left out are calls within a module, calls of what was called
before from there, plain mathematics, and names with an underscore, whose calls count as those of their module.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from types import CodeType, FrameType

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before Dr.Jit and Mitsuba)
from tools.imports import PACKAGE, modules
from tools.svg import FAINT, INK, PALE, Drawing

AOVS = "depth,gaze,visibility"
LEFT_OUT = (
    "maths",
    "field.backend",
    "transport.freezing",
    "properties",
    "registration",
    "errors",
    "interruption",
    "checkout",
)
"""Rooms and modules whose calls the picture leaves out: none of them says what becomes of a ray."""
LANES = (
    "plugins",
    "transport",
    "transport.observer",
    "transport.march",
    "transport.media",
    "field.gaze",
    "field",
    "field.encoding",
)
"""The columns of the picture: packages below `nerg_mi`, in the order in which a ray comes to them."""


@dataclass(frozen=True)
class Call:
    """A call of `name` in the module `target` by the module `source`; `depth`: how many drawn calls are around it."""

    source: str
    target: str
    name: str
    depth: int


class Recorder:
    """A profile function (`sys.setprofile`) that keeps the first call of each function of the package by each module.

    `calls`: in the order in which they were made.
    """

    def __init__(self) -> None:
        self.modules = {str(path): name for name, path in modules().items()}
        self.calls: list[Call] = []
        self._seen: set[tuple[str, str, str]] = set()
        self._stack: list[tuple[str, int] | None] = []

    def __call__(self, frame: FrameType, event: str, _) -> None:
        if event == "call":
            self._stack.append(self._enter(frame))
        elif event == "return" and self._stack:
            self._stack.pop()

    def _enter(self, frame: FrameType) -> tuple[str, int] | None:
        """Module and depth of what is entered, None where it is not of the package."""
        module = self.modules.get(frame.f_code.co_filename)
        if module is None:
            return None
        source, depth = next((entry for entry in reversed(self._stack) if entry is not None), ("", 0))
        name = _name(frame.f_code, frame)
        if source == module or name is None or any(f"{module}.".startswith(f"{PACKAGE}.{r}.") for r in LEFT_OUT):
            return (module, depth)
        if source and (source, module, name) not in self._seen:
            self._seen.add((source, module, name))
            self.calls.append(Call(source, module, name, depth))
        return (module, depth + bool(source))


def _name(code: CodeType, frame: FrameType) -> str | None:
    """`function` or `Class.method`; None for what is private or has no name of its own."""
    name = code.co_name
    if name.startswith("<") or (name.startswith("_") and name != "__call__"):
        return None
    if code.co_varnames[:1] == ("self",):
        owner = type(frame.f_locals["self"]).__name__
        return owner if name == "__call__" else f"{owner}.{name}"
    return name


def record() -> list[Call]:
    """The calls of one render, from the integrator's sample on. To be called once in a process."""
    import mitsuba as mi

    from nerg_mi.jobs.demo import store_scene

    mi.set_variant("llvm_ad_rgb")
    scene = mi.load_file(str(store_scene()), width=8, height=6, aovs=AOVS)
    recorder = Recorder()
    sys.setprofile(recorder)
    try:
        mi.render(scene, spp=1)
    finally:
        sys.setprofile(None)
    return recorder.calls


def lane(module: str) -> str:
    """The column of the picture that a module belongs to."""
    inner = module.removeprefix(f"{PACKAGE}.")
    return max((name for name in LANES if f"{inner}.".startswith(f"{name}.")), key=len, default=inner.split(".")[0])


def draw(calls: list[Call]) -> str:
    """The picture: a line for each call, indented by its depth, and its arrow from column to column."""
    lanes = list(LANES)
    lanes += [name for name in dict.fromkeys(lane(m) for c in calls for m in (c.source, c.target)) if name not in lanes]
    row, left, top, column = 20, 450, 130, 74
    drawing = Drawing(left + column * len(lanes) + 70, top + row * len(calls) + 24, "A ray's way through nerg_mi")
    drawing.words(20, 40, "A ray's way", size=18, bold=True)
    drawing.words(20, 62, "From the integrator's first call to the last, while a picture is traced.", color=PALE)
    for k, name in enumerate(lanes):
        x = left + column * (k + 0.5)
        drawing.words(x + 4, top - 12, name.replace(".", " / "), size=11, bold=True, turned=-35)
        drawing.line(x, top - 6, x, top + row * len(calls))
    for k, call in enumerate(calls):
        y = top + row * (k + 0.5)
        start, end = (left + column * (lanes.index(lane(m)) + 0.5) for m in (call.source, call.target))
        drawing.words(20 + 14 * call.depth, y + 4, call.name, size=11)
        drawing.words(left - 6, y + 4, call.target.rpartition(".")[2], size=9, color=PALE, anchor="end")
        if k % 2:
            drawing.line(20, y + row / 2, left + column * len(lanes), y + row / 2, color="#edf1f5")
        if start == end:
            drawing.dot(start, y, 3, fill="#ffffff", line=INK)
        else:
            drawing.dot(start, y, 2, fill=FAINT)
            drawing.arrow(start, end, y)
    return drawing.text()
