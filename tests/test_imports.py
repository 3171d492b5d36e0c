"""Imports within the package: no circle, no name with an underscore, and none within a function without a reason.

That they run down from room to room is checked by `make lint` (import-linter, pyproject.toml).
"""

from __future__ import annotations

from tools.imports import Import, all_imports, circles, modules

PACKAGE = all_imports()
"""Every import of one module of the package by another."""

LATE = {
    "nerg_mi.api": "the public API is loaded name by name, so that `import nerg_mi` stays cheap",
    "nerg_mi.cli": "`nerg --help` loads only what describes the options",
    "nerg_mi.jobs": "a job loads Mitsuba's code after the variant is chosen",
    "nerg_mi.scenes": "the generators of ready scenes load what one of their parts needs when it is made",
}
"""Where imports within functions are the rule -> the reason."""

LATE_HERE: dict[tuple[str, str], str] = {
    ("nerg_mi.rendering.bands", "nerg_mi.transport.observer.viewpoint"): "a film is described without Dr.Jit",
    ("nerg_mi.figures.provenance", "nerg_mi.rays.dataset.opening"): "a picture without rays starts without datasets",
}
"""Importing and imported module -> why this one import waits for the call."""

LAYERED = [["nerg_mi.density.kde", "nerg_mi.density.probes"]]
"""Packages of a room that lie around a module of it: estimates below probes, their use in pictures above."""


def late() -> list[Import]:
    """The imports within functions that `LATE` does not cover."""
    return [i for i in PACKAGE if i.when == "call" and not any(f"{i.source}.".startswith(f"{p}.") for p in LATE)]


def test_the_whole_package_is_read():
    known = modules()
    assert {"nerg_mi", "nerg_mi.transport.place", "nerg_mi.plugins.nerg", "nerg_mi.scenes.store.twin"} <= set(known)
    assert len(PACKAGE) > 3 * len(known) and {i.source for i in PACKAGE} | {i.target for i in PACKAGE} <= set(known)


def test_no_circles():
    """Neither of modules as they are loaded nor through imports that wait for a call."""
    assert circles({(i.source, i.target) for i in PACKAGE if i.when != "types"}) == []


def test_no_circles_between_the_packages_of_a_room():
    """Within a room, what one sub-package imports does not import it, and the room's own modules stand where they are
    needed."""

    def part(module: str) -> str:
        return ".".join(module.split(".")[:3])

    pairs = {(part(i.source), part(i.target)) for i in PACKAGE if i.when != "types"}
    assert [c for c in circles({(a, b) for a, b in pairs if a != b}) if c not in LAYERED] == []


def test_names_with_an_underscore_stay_where_they_are():
    private = [
        f"{i.source}:{i.line}: {name} of {i.target}"
        for i in PACKAGE
        for name in (*i.names, i.target.rpartition(".")[2])
        if name.startswith("_") and not name.startswith("__")
    ]
    assert private == []


def test_imports_within_functions_have_a_reason():
    assert [f"{i.source}:{i.line} imports {i.target}" for i in late() if (i.source, i.target) not in LATE_HERE] == []


def test_reasons_are_of_imports_that_are_there():
    assert set(LATE_HERE) <= {(i.source, i.target) for i in late()}
    for place in LATE:
        assert any(i.when == "call" and f"{i.source}.".startswith(f"{place}.") for i in PACKAGE), place
