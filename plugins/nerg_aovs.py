"""The AOVs of :ref:`nerg <integrator-nerg>`: a table that its checks, its channels' names, what is computed and its
manual follow. One more AOV is one more entry."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import mitsuba as mi

from nerg_mi.errors import NergError
from nerg_mi.transport.field_medium import snapshot

if TYPE_CHECKING:
    from nerg_mi.transport.medium import Medium

    from .nerg_pixel import CameraView, Pixel


@dataclass(frozen=True)
class Need:
    """Something without which an AOV makes no sense: whether the integrator has it, and what is said otherwise."""

    is_met: Callable[[Any], bool]
    complaint: str


FIELD = Need(lambda nerg: "field" in nerg.children, 'which needs a "field"')
GAZE = Need(lambda nerg: nerg.gaze is not None, 'which needs a "gaze" volume')
KDE = Need(lambda nerg: "kde" in nerg.children, 'which needs a "kde" volume of type "gazekde"')
MEMBERS = Need(
    lambda nerg: len(nerg.gaze.field.members) > 1, 'which needs a "gaze" of several members; train it with --ensemble 5'
)
SUPPORT = Need(
    lambda nerg: nerg.gaze.field.support is not None, 'which the checkpoint of "gaze" does not hold; train it again'
)


@dataclass(frozen=True, kw_only=True)
class Aov:
    """One AOV. ``compute`` is called for those that are asked for, and for no others."""

    name: str
    # Suffixes of its channels; None: one a feature of the medium, by number.
    channels: str | None = "Y"
    # What it is, for the manual.
    summary: str
    # A Float for each channel, of a ``CameraView``, or of a ``Pixel`` where it is ``of_observer``.
    compute: Callable[[Any], list]
    # Whether it depends on where the observer is: what does not is computed once for several of them.
    of_observer: bool = False
    # In the order in which they are checked.
    needs: tuple[Need, ...] = ()
    # What has to be prepared for it, see ``Pixel``.
    demands: frozenset[str] = frozenset()

    def channels_of(self, medium) -> list[str]:
        """The suffixes of its channels for that medium."""
        return [str(i) for i in range(medium.feature_count)] if self.channels is None else list(self.channels)


_GAZE, _FACTORS, _COUNTS = frozenset({"gaze"}), frozenset({"gaze", "factors"}), frozenset({"counts"})


def _features_at(p: CameraView) -> list:
    return snapshot(cast("Medium", p.context.medium), p.p_d, p.surface & (p.depth < p.view.distance))


def _color_evaluations(p: CameraView) -> list:
    march, medium = p.view.march, p.context.medium
    if not p.lit or march is None or medium is None:
        return [mi.Float(0)]
    once = dr.select(p.active & (p.view.front > 0), mi.Float(1), 0)
    return [once if medium.deferred else march.color_evals]


AOVS: dict[str, Aov] = {
    aov.name: aov
    for aov in (
        Aov(
            name="depth",
            channels="T",
            summary="distance along the ray from the ray's origin, wherever opacity > 0",
            compute=lambda p: [p.camera_depth],
        ),
        Aov(name="opacity", summary="1 - transmittance", compute=lambda p: [dr.select(p.active, p.view.opacity, 0)]),
        Aov(
            name="position",
            channels="XYZ",
            summary="the surface :math:`p_d`",
            compute=lambda p: list(dr.select(p.surface, p.p_d, 0)),
        ),
        Aov(
            name="gaze",
            summary="density in 1/sr of the observer attending this surface, after occlusion",
            compute=lambda p: [p.attention.gaze],
            of_observer=True,
            needs=(GAZE,),
            demands=_GAZE,
        ),
        Aov(
            name="emit",
            summary="what the surface attracts, after its activation; 1 for a variant that lacks it",
            compute=lambda p: [p.attention.emit],
            of_observer=True,
            needs=(GAZE,),
            demands=_FACTORS,
        ),
        Aov(
            name="capture",
            summary="what the observer gives, after its activation; 1 for a variant that lacks it",
            compute=lambda p: [p.attention.capture],
            of_observer=True,
            needs=(GAZE,),
            demands=_FACTORS,
        ),
        Aov(
            name="gaze_std",
            summary="standard deviation of ``gaze`` over the members of an ensemble, in 1/sr, after occlusion",
            compute=lambda p: [p.attention.spread],
            of_observer=True,
            needs=(GAZE, MEMBERS),
            demands=frozenset({"gaze", "spread"}),
        ),
        Aov(
            name="support",
            summary="how many training rays started around the observer, one at distance d counting 1 - d²/(5R)² (R of "
            "the training); one number an observer, shown where there is a surface",
            compute=lambda p: [p.view_of_observer("support")],
            of_observer=True,
            needs=(GAZE, SUPPORT),
        ),
        Aov(
            name="kde",
            summary="density in 1/sr of the tracked rays nearest to the observer, towards this surface, after "
            "occlusion",
            compute=lambda p: [p.view_of_observer("kde")],
            of_observer=True,
            needs=(KDE,),
        ),
        Aov(
            name="visibility",
            summary="1 visible to the observer .. 0 hidden",
            compute=lambda p: [dr.select(p.camera.surface, p.sight.visibility, 0)],
            of_observer=True,
        ),
        Aov(
            name="observer_depth",
            channels="T",
            summary=":math:`d_o`; the distance to the surface where no occlusion is computed",
            compute=lambda p: [dr.select(p.camera.surface, p.sight.depth, 0)],
            of_observer=True,
            demands=frozenset({"observer_depth"}),
        ),
        Aov(
            name="features",
            channels=None,
            summary="the field's geometry features, accumulated like colour (not divided by opacity)",
            compute=lambda p: p.accumulated_features,
            needs=(FIELD,),
            demands=frozenset({"features"}),
        ),
        Aov(
            name="features_at",
            channels=None,
            summary="the same features at the surface :math:`p_d`; 0 on shapes",
            compute=_features_at,
            needs=(FIELD,),
        ),
        Aov(
            name="density_evals",
            summary="evaluations of density made for the pixel",
            compute=lambda p: [p.density_evaluations()],
            of_observer=True,
            demands=_COUNTS,
        ),
        Aov(
            name="color_evals",
            summary="evaluations of colour made for the pixel",
            compute=_color_evaluations,
            demands=_COUNTS,
        ),
        Aov(
            name="gaze_evals",
            summary="evaluations of gaze networks made for the pixel",
            compute=lambda p: [p.attention.evaluations],
            of_observer=True,
            needs=(GAZE,),
            demands=_GAZE,
        ),
    )
}


def read_aovs(value: str, nerg) -> list[str]:
    """The names in a comma-separated list. Raises ``NergError`` for one that is not known, that needs what the
    integrator does not have, or that is named twice."""
    names = [n.strip() for n in value.split(",") if n.strip()]
    for name in names:
        if name not in AOVS:
            raise NergError(f'"aovs" does not know "{name}"; it knows {", ".join(AOVS)}')
        for need in AOVS[name].needs:
            if not need.is_met(nerg):
                raise NergError(f'"aovs" asks for "{name}", {need.complaint}')
    if len(set(names)) < len(names):
        raise NergError(f'"aovs" names something twice: "{value}"')
    return names


def demands_of(names: Iterable[str]) -> frozenset[str]:
    """What has to be prepared for these AOVs."""
    return frozenset().union(*(AOVS[name].demands for name in names))


def channel_names(names: Iterable[str], medium) -> list[str]:
    """The names of all channels of these AOVs, in their order."""
    return [f"{name}.{channel}" for name in names for channel in AOVS[name].channels_of(medium)]


def compute(names: Sequence[str], pixel: Pixel) -> list:
    """All channels of these AOVs, in their order."""
    # Evaluations are counted when all else has made its own.
    order = sorted((AOVS[name] for name in names), key=lambda aov: "counts" in aov.demands)
    found = {aov.name: aov.compute(pixel if aov.of_observer else pixel.camera) for aov in order}
    return [channel for name in names for channel in found[name]]


def manual() -> str:
    """The list of AOVs as the manual has it."""
    return "\n".join(_entry(aov) for aov in AOVS.values())


def _entry(aov: Aov) -> str:
    channels = "``.0``, ``.1``, ..." if aov.channels is None else f"``{' '.join('.' + c for c in aov.channels)}``"
    return textwrap.fill(f"- ``{aov.name}`` ({channels}): {aov.summary}", 120, subsequent_indent="  ")
