"""Imports within the package: no circle, no name with an underscore, and none within a function without a reason.

That they run down from room to room is checked by `make lint` (import-linter, pyproject.toml).
"""

from __future__ import annotations

import pytest

from tools.imports import Import, all_imports, circles, modules

PACKAGE = all_imports()
"""Every import of one module of the package by another."""

LATE = {
    "nerg_mi.api": "the public API is loaded name by name, so that `import nerg_mi` stays cheap",
    "nerg_mi.cli": "`nerg --help` loads only what describes the options",
    "nerg_mi.jobs": "a job loads Mitsuba's code after the variant is chosen",
    "nerg_mi.scenes": "the generators of the store load what one of their parts needs when it is made",
}
"""Where imports within functions are the rule -> the reason."""

TO_REMOVE = "to be moved to the top of its file"

LATE_HERE: dict[tuple[str, str], str] = {
    ("nerg_mi.capture.bounds", "nerg_mi.capture.lens"): TO_REMOVE,
    ("nerg_mi.evaluation.ablation", "nerg_mi.training.geometry.hit_geometry"): TO_REMOVE,
    ("nerg_mi.evaluation.study.subject", "nerg_mi.evaluation.study.errors"): TO_REMOVE,
    ("nerg_mi.evaluation.study.subject", "nerg_mi.scenes.store.twin"): TO_REMOVE,
    ("nerg_mi.evaluation.study.subject", "nerg_mi.transport.observer.viewpoint"): TO_REMOVE,
    ("nerg_mi.formats.torch_ngp.fields", "nerg_mi.formats.torch_ngp.pickling"): TO_REMOVE,
    ("nerg_mi.rays.plausibility", "nerg_mi.rays.filters"): TO_REMOVE,
    ("nerg_mi.rays.readers.ray_tables", "nerg_mi.rays.io"): TO_REMOVE,
    ("nerg_mi.rendering.bands", "nerg_mi.transport.observer.viewpoint"): TO_REMOVE,
    ("nerg_mi.rendering.pictures", "nerg_mi.llvm"): TO_REMOVE,
    ("nerg_mi.training.geometry.places", "nerg_mi.formats.fields"): TO_REMOVE,
    ("nerg_mi.training.geometry.places", "nerg_mi.rendering.pictures"): TO_REMOVE,
    ("nerg_mi.training.radiance.preview", "nerg_mi.field.backend"): TO_REMOVE,
    ("nerg_mi.view.demo", "nerg_mi.scenes"): TO_REMOVE,
    ("nerg_mi.view.demo", "nerg_mi.transport.observer.viewpoint"): TO_REMOVE,
    ("nerg_mi.view.demo", "nerg_mi.transport.panorama"): TO_REMOVE,
}
"""Importing and imported module -> why this one import waits for the call."""


TO_CUT = [
    ["nerg_mi.density.kde", "nerg_mi.density.probes"],
    ["nerg_mi.scenes.store.furniture", "nerg_mi.scenes.store.layout"],
]
"""Circles that are known and to be cut."""

PRIVATE_TO_REMOVE = {"_Samples"}


def late() -> list[Import]:
    """The imports within functions that `LATE` does not cover."""
    return [i for i in PACKAGE if i.when == "call" and not any(f"{i.source}.".startswith(f"{p}.") for p in LATE)]


def test_the_whole_package_is_read():
    known = modules()
    assert {"nerg_mi", "nerg_mi.transport.place", "nerg_mi.plugins.nerg", "nerg_mi.scenes.store.twin"} <= set(known)
    assert len(PACKAGE) > 3 * len(known) and {i.source for i in PACKAGE} | {i.target for i in PACKAGE} <= set(known)


@pytest.mark.xfail(reason="rooms are being built", strict=False)
def test_no_circles():
    """Neither of modules as they are loaded nor through imports that wait for a call."""
    found = circles({(i.source, i.target) for i in PACKAGE if i.when != "types"})
    assert [c for c in found if c not in TO_CUT] == []


@pytest.mark.xfail(reason="rooms are being built", strict=False)
def test_no_circles_between_the_packages_of_a_room():
    """Within a room, what one sub-package imports does not import it, and the room's own modules stand where they are
    needed."""

    def part(module: str) -> str:
        return ".".join(module.split(".")[:3])

    pairs = {(part(i.source), part(i.target)) for i in PACKAGE if i.when != "types"}
    assert [c for c in circles({(a, b) for a, b in pairs if a != b}) if c not in TO_CUT] == []


@pytest.mark.xfail(reason="rooms are being built", strict=False)
def test_names_with_an_underscore_stay_where_they_are():
    private = [
        f"{i.source}:{i.line}: {name} of {i.target}"
        for i in PACKAGE
        for name in (*i.names, i.target.rpartition(".")[2])
        if name.startswith("_") and not name.startswith("__") and name not in PRIVATE_TO_REMOVE
    ]
    assert private == []


@pytest.mark.xfail(reason="rooms are being built", strict=False)
def test_imports_within_functions_have_a_reason():
    assert [f"{i.source}:{i.line} imports {i.target}" for i in late() if (i.source, i.target) not in LATE_HERE] == []
