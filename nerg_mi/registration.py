"""Makes the plugins of this package known to Mitsuba, for every variant that is switched to.

A Mitsuba plugin written in Python is bound to the variant that was active when its class was made, and is registered
for that variant alone. So each plugin module is imported again after every change of variant. Mitsuba itself is not
imported from here: where it is not loaded yet, registration waits until somebody imports it. Likewise the libLLVM that
Dr.Jit would load is looked at when Dr.Jit is imported, which is when an unusable one begins to matter.
"""

from __future__ import annotations

import importlib
import importlib.machinery
import importlib.util
import sys
from typing import Any

from . import llvm
from .errors import NergError

PLUGINS = (
    ("panorama", "sensor"),
    ("nerf", "volume"),
    ("gazefield", "volume"),
    ("gazekde", "volume"),
    ("splats", "volume"),
    ("nerg", "integrator"),
)
"""Name and kind of each plugin; the module `nerg_mi.plugins.<name>` registers it. Order: a plugin follows those it
uses."""

# Mitsuba 3.9 has no register_volume. It checks the type of the object that is made, not where its maker is registered.
_REGISTRY = {"volume": "texture"}


_classes: dict[str, type] = {}


def get_plugin_class(name: str) -> Any:
    """The class of the plugin ``name`` for the active variant, which must not be a scalar one."""
    return _classes[name]


def register(kind: str, name: str, cls: type) -> None:
    """Register the plugin class `cls` under `name` for the active variant; the last line of every plugin module.

    `kind`: "integrator", "sensor", "volume", "texture", "film", ... In a scalar variant a refusal is registered in its
    place, so that the user reads what to do instead of that there is no such plugin. Volumes get none: what scalar_rgb
    knows of a name decides what dict scenes of every later variant expect, and that would be a texture.
    """
    import mitsuba as mi

    variant = str(mi.variant())
    put = getattr(mi, f"register_{_REGISTRY.get(kind, kind)}")
    if variant.startswith("scalar"):
        if kind not in _REGISTRY:
            put(name, _refusal(name, variant))
    else:
        _classes[name] = cls
        put(name, cls)


def _excuse(variant: str, what: str) -> str:
    return (
        f'{what} needs a variant that compiles its kernels, and "{variant}" is active: '
        f'call mi.set_variant("llvm_ad_rgb") (or "cuda_ad_rgb") before loading the scene.'
    )


def _refusal(name: str, variant: str):
    def refuse(props):
        raise NergError(_excuse(variant, f'"{name}"'))

    return refuse


def _on_variant(old: str | None, new: str | None) -> None:
    """Called by Mitsuba after each change of variant."""
    if new is None:
        return
    llvm.require_usable(new)
    if new.startswith("scalar"):
        mi = sys.modules["mitsuba"]
        names = ", ".join(f'"{name}"' for name, _ in PLUGINS)
        mi.Log(mi.LogLevel.Warn, _excuse(new, f"each of nerg_mi's plugins ({names})"))
    for name, kind in PLUGINS:
        if new.startswith("scalar"):
            # The classes are not even made: arrays of scalar variants lack what their bodies use.
            register(kind, name, object)
            continue
        module = sys.modules.get(f"{__package__}.plugins.{name}")
        if module is None:
            importlib.import_module(f"{__package__}.plugins.{name}")
        else:
            importlib.reload(module)


def _attach() -> None:
    """Follow the variants of the Mitsuba that is loaded, starting with the active one."""
    llvm.require_usable()
    mi = sys.modules["mitsuba"]
    mi.detail.add_variant_callback(_on_variant)
    _on_variant(None, mi.variant())


class _Watcher:
    """An entry of `sys.meta_path` that lets Dr.Jit and Mitsuba be found as ever: the one is loaded only after its
    libLLVM was checked, and the plugins are attached to the other once it is loaded."""

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
        execute = spec.loader.exec_module

        def exec_module(module):
            if fullname == "drjit":
                llvm.require_usable()
                execute(module)
                return
            execute(module)
            if self in sys.meta_path:
                sys.meta_path.remove(self)
            _attach()

        spec.loader.exec_module = exec_module
        return spec


def install() -> None:
    """Register the plugins now if Mitsuba is loaded, else as soon as it is. Calling it again does nothing new.

    Raises `nerg_mi.errors.UnusableLLVM` where Dr.Jit is loaded with a libLLVM on which its kernels cannot run; where it
    is not loaded yet, importing it does.
    """
    if "drjit" in sys.modules:
        llvm.require_usable()
    if "mitsuba" in sys.modules:
        _attach()
    elif not any(isinstance(entry, _Watcher) for entry in sys.meta_path):
        sys.meta_path.insert(0, _Watcher())
