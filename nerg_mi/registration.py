"""Registration of the plugins of this package with Mitsuba, for each variant that becomes active.

A Mitsuba plugin in Python is bound to the variant that is active when its class is created, and is registered for that
variant only. Each plugin module is therefore imported again after every change of variant. This module does not import
Mitsuba: if it is not loaded yet, registration is delayed until it is imported. In the same way, the libLLVM of Dr.Jit
is checked when Dr.Jit is imported, because an unusable library has no effect before.
"""

from __future__ import annotations

import codecs
import importlib
import importlib.util
import sys
from collections.abc import Callable
from functools import partial
from typing import Any

from nerg_mi.errors import NergError
from nerg_mi.memory import MITSUBA_MEGABYTES, require_address_space

from . import llvm

PLUGINS = (
    ("panorama", "sensor"),
    ("nerf", "volume"),
    ("gazefield", "volume"),
    ("gazekde", "volume"),
    ("splats", "volume"),
    ("nerg", "integrator"),
)
"""Name and kind of each plugin; the module `nerg_mi.plugins.<name>` registers it. A plugin comes after the plugins that
it uses."""

# Mitsuba 3.9 has no register_volume. It checks the type of the created object, not the registry of its constructor.
_REGISTRY = {"volume": "texture"}


_classes: dict[str, type] = {}


def get_plugin_class(name: str) -> Any:
    """Return the class of the plugin ``name`` for the active variant, which must not be a scalar variant."""
    return _classes[name]


def register(kind: str, name: str, cls: type) -> None:
    """Register the plugin class ``cls`` under ``name`` for the active variant. Each plugin module ends with this call.

    In a scalar variant, a constructor that raises an error is registered instead. The user then reads what to do,
    instead of a message that the plugin does not exist. Volumes are skipped: the type that scalar_rgb registers for a
    name is the type that dict scenes expect in all later variants, and that would be a texture.

    Parameters
    ----------
    kind
        "integrator", "sensor", "volume", "texture", "film", ...
    name
        Name of the plugin in scenes.
    cls
        The class.
    """
    import mitsuba as mi

    variant = str(mi.variant())
    register_class = getattr(mi, f"register_{_REGISTRY.get(kind, kind)}")
    if variant.startswith("scalar"):
        if kind not in _REGISTRY:
            register_class(name, _make_constructor(_make_refusal(name, variant)))
    else:
        _classes[name] = cls
        register_class(name, _make_constructor(cls))


class _Raise:
    """Descriptor in the place of ``__init__``, whose call raises the ``error`` of its instance from C code."""

    def __get__(self, instance, owner):
        return partial(next, map(codecs.strict_errors, [instance.error]))


def _make_constructor(create: Callable[[Any], Any]) -> type:
    """Return a constructor for Mitsuba that calls ``create``, and whose `NergError` has no traceback.

    Mitsuba shows the traceback of an exception in front of its message, and each Python function that an exception
    leaves adds a line to it. An error of the user is therefore raised again from C code.
    """

    class Constructor:
        __init__ = _Raise()  # pyright: ignore[reportAssignmentType] which is called like a method
        error: NergError

        def __new__(cls, props):
            try:
                return create(props)
            except NergError as error:
                failed = super().__new__(cls)
                failed.error = error.with_traceback(None)
                return failed

    return Constructor


def _explain_variant(variant: str, subject: str) -> str:
    return (
        f'{subject} needs a variant with compiled kernels, but "{variant}" is active: '
        f'call mi.set_variant("llvm_ad_rgb") (or "cuda_ad_rgb") before loading the scene.'
    )


def _make_refusal(name: str, variant: str):
    def refuse(props):
        raise NergError(_explain_variant(variant, f'"{name}"'))

    return refuse


def _on_variant(old: str | None, new: str | None) -> None:
    """Callback of Mitsuba after each change of variant."""
    if new is None:
        return
    llvm.require_usable(new)
    if new.startswith("scalar"):
        mi = sys.modules["mitsuba"]
        names = ", ".join(f'"{name}"' for name, _ in PLUGINS)
        mi.Log(mi.LogLevel.Warn, _explain_variant(new, f"each plugin of nerg_mi ({names})"))
    for name, kind in PLUGINS:
        if new.startswith("scalar"):
            # The classes are not created: arrays of scalar variants lack attributes that the class bodies use.
            register(kind, name, object)
            continue
        module = sys.modules.get(f"{__package__}.plugins.{name}")
        if module is None:
            importlib.import_module(f"{__package__}.plugins.{name}")
        else:
            importlib.reload(module)


def _attach_to_mitsuba() -> None:
    """Register the plugins for the active variant of the loaded Mitsuba, and for each later variant."""
    llvm.require_usable()
    mi = sys.modules["mitsuba"]
    mi.detail.add_variant_callback(_on_variant)
    _on_variant(None, mi.variant())


class _ImportHook:
    """An entry of `sys.meta_path` that delegates the imports of Dr.Jit and Mitsuba.

    It checks libLLVM before Dr.Jit is loaded, and registers the plugins after Mitsuba is loaded.
    """

    def find_spec(self, fullname, path=None, target=None):
        if fullname not in ("drjit", "mitsuba"):
            return None
        sys.meta_path.remove(self)
        try:
            spec = importlib.util.find_spec(fullname)
        finally:
            sys.meta_path.insert(0, self)
        if spec is None or spec.loader is None:
            return spec
        original_exec = spec.loader.exec_module

        def exec_module(module):
            if fullname == "drjit":
                require_address_space(MITSUBA_MEGABYTES, "Mitsuba")
                llvm.require_usable()
                original_exec(module)
                return
            original_exec(module)
            if self in sys.meta_path:
                sys.meta_path.remove(self)
            _attach_to_mitsuba()

        spec.loader.exec_module = exec_module
        return spec


def install() -> None:
    """Register the plugins now if Mitsuba is loaded, otherwise when it is imported. Repeated calls have no effect.

    Raises `nerg_mi.errors.UnusableLLVM` if Dr.Jit is loaded with a libLLVM on which its kernels cannot run. If Dr.Jit
    is not loaded yet, its import raises that error.
    """
    if "drjit" in sys.modules:
        llvm.require_usable()
    if "mitsuba" in sys.modules:
        _attach_to_mitsuba()
    elif not any(isinstance(entry, _ImportHook) for entry in sys.meta_path):
        sys.meta_path.insert(0, _ImportHook())
