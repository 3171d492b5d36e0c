"""The Mitsuba variant that the library works in: the one that is set, or the best where none is."""

from __future__ import annotations

from types import ModuleType

from nerg_mi.errors import NergError


def active_mitsuba() -> ModuleType:
    """The module ``mitsuba`` with a variant that fields work in.

    A variant that is set stays set. Where none is, it is ``cuda_ad_rgb`` if that works here, and ``llvm_ad_rgb``
    otherwise, as for the command `nerg`. Raises `NergError` for a variant without kernels.
    """
    import mitsuba as mi

    variant = mi.variant()
    if variant is None:
        from nerg_mi.rendering.scene import activate

        activate()
    elif variant.startswith("scalar"):
        raise NergError(
            f'fields need a variant that compiles its kernels, and "{variant}" is active: '
            'call mi.set_variant("llvm_ad_rgb") (or "cuda_ad_rgb") first'
        )
    return mi


def array_module() -> ModuleType:
    """The Dr.Jit array types of the active variant (`nerg_mi.fields.mlp.namespace`)."""
    from nerg_mi.fields.mlp import namespace

    return namespace(active_mitsuba().variant())
