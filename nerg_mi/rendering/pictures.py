"""What comes before a picture: the Mitsuba variant that renders it, and its scene."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from nerg_mi import llvm
from nerg_mi.errors import NergError, UnusableLLVM, mitsuba_says, sentence
from nerg_mi.files.images import threads_for_mitsuba

from .scene_file import check_scene, check_scene_file

_PREFERRED = ("cuda_ad_rgb", "llvm_ad_rgb")
# What mi.load_file takes besides the values of a scene.
_OWN = ("path", "parallel", "optimize")


def activate(variant: str | None = None) -> str:
    """Make a Mitsuba variant the active one, with the plugins of this package, and give its name.

    `variant` None: `cuda_ad_rgb` where there is an NVIDIA driver, otherwise `llvm_ad_rgb`. Raises NergError for a name
    that Mitsuba does not know and for a variant that does not work here.
    """
    import mitsuba as mi

    if variant is not None and variant not in mi.variants():
        raise NergError(f'there is no variant "{variant}"; this Mitsuba has {", ".join(mi.variants())}')
    wanted = [variant] if variant else [v for v in _PREFERRED if not v.startswith("cuda") or llvm.has_cuda()]
    reason = ""
    for choice in wanted:
        try:
            mi.set_variant(choice)
            return choice
        except UnusableLLVM:
            raise
        except ImportError as error:  # Mitsuba says so where the backend of a variant cannot start
            reason = sentence(error)
    raise NergError(f'the variant "{wanted[-1]}" does not work here ({reason}); "nerg doctor" says how to mend it')


def load_scene(path: str | Path, defaults: Mapping[str, str] | None = None, merge: bool = True):
    """The scene of a file, with ``defaults`` for its `<default>` and `$key`; the variant must be active. ``merge``:
    whether Mitsuba may make one of meshes of the same material, which then lose their names.

    Raises NergError for what Mitsuba does not take, and for what would end its process or fill the memory.
    """
    import mitsuba as mi

    if not Path(path).exists():
        raise NergError(f'there is no scene file "{path}"')
    # Values of any type, among which Mitsuba looks for its own parameters.
    given: dict[str, Any] = dict(defaults or {})
    for name in _OWN:
        if name in given:
            raise NergError(f'"{name}" is a name that Mitsuba keeps for itself: give the value in "{path}" another')
    check_scene_file(path, defaults)
    with mitsuba_says(), threads_for_mitsuba():
        try:
            loaded = mi.load_file(str(path), optimize=merge, **given)
        except RuntimeError as error:
            unused = (
                re.findall(r"^\s*- \$(\w+)=", str(error), re.MULTILINE) if "unused parameters" in str(error) else []
            )
            if unused:
                raise NergError(
                    f'the scene "{path}" asks for no "${unused[0]}": correct the name that is given a value'
                ) from error
            raise
        except UnicodeDecodeError as error:
            # Mitsuba quotes what it cannot read, and that is no text.
            raise NergError(f'a mesh or another file that the scene "{path}" names is damaged: make it anew') from error
    check_scene(path, loaded)
    return loaded
