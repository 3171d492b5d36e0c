"""The AOVs of :ref:`nerg <integrator-nerg>`: a table that its checks, channel names, what is computed, its manual,
overlays, the viewer's layers, contact sheets and differences follow. One more AOV is one more entry."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, cast

import drjit as dr

from nerg_mi.errors import NergError

from .field_medium import evaluate_features
from .observer import ObserverView, SupportView

if TYPE_CHECKING:
    from .medium import Medium


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
class Display:
    """How pictures show the values of an AOV.

    ``kind``: "sequential", colours from a least to a greatest value; "heat", the same over the colours of the picture,
    the more opaque the higher; "diverging", to both sides of 0; "categorical", for whole numbers that name classes;
    "shade", values from 0 to 1 by which the picture is darkened. ``cmap``: colour map of matplotlib, None for the usual
    one of its kind. ``limits``: fixed ends of the scale; None for percentiles of what is seen: from 0 for a heat,
    equally far to both sides where diverging.
    """

    kind: Literal["sequential", "heat", "diverging", "categorical", "shade"] = "sequential"
    cmap: str | None = None
    limits: tuple[float, float] | None = None


@dataclass(frozen=True, kw_only=True)
class Quantity:
    """What pictures of a quantity need to know. ``title``: of a picture that shows it, and of the viewer's layer, by
    default its ``name``; ``label``: what its scale measures, by default the name, in which ``unit``; ``data_source``: the
    part of the integrator, "gaze" or "kde", that was made of rays, whose number pictures state; ``needs_support``:
    whether it is hatched where no rays were recorded around the observer."""

    name: str
    title: str = ""
    label: str = ""
    unit: str = ""
    display: Display = Display()
    data_source: str = ""
    needs_support: bool = False

    @property
    def heading(self) -> str:
        """Its title, or its name in words."""
        return self.title or self.name.replace("_", " ").capitalize()

    @property
    def scale_label(self) -> str:
        """Label and unit, as they stand beside a scale."""
        label = self.label or self.name.replace("_", " ")
        return f"{label} [{self.unit}]" if self.unit else label


@dataclass(frozen=True, kw_only=True)
class Aov(Quantity):
    """One AOV. ``compute`` is called for those that are asked for, and for no others."""

    # Suffixes of its channels; None: one a feature of the medium, by number.
    channels: str | None = "Y"
    # What it is, for the manual.
    summary: str
    # A Float for each channel, of a ``plugins.nerg_pixel.CameraView``, or of a ``Pixel`` where it is ``is_per_observer``.
    compute: Callable[[Any], list]
    # What is known of an observer once their position is, of the integrator, for ``Pixel.view_of_observer``.
    view: Callable[[Any], ObserverView] | None = None
    # Whether it depends on where the observer is: what does not is computed once for several of them.
    is_per_observer: bool = False
    # Whether an integrator that can compute it gives the same value everywhere.
    is_constant: Callable[[Any], bool] = lambda nerg: False
    # In the order in which they are checked.
    dependencies: tuple[Need, ...] = ()
    # What has to be prepared for it, see ``Pixel``.
    demands: frozenset[str] = frozenset()

    @property
    def has_multiple_channels(self) -> bool:
        """Whether it has more than one channel."""
        return self.channels is None or len(self.channels) > 1

    def channel_suffixes(self, medium) -> list[str]:
        """The suffixes of its channels for that medium."""
        return [str(i) for i in range(medium.feature_count)] if self.channels is None else list(self.channels)


_GAZE, _FACTORS, _COUNTS = frozenset({"gaze"}), frozenset({"gaze", "factors"}), frozenset({"counts"})
_HEAT, _SIGNED = Display(kind="heat"), Display(kind="diverging")
_EVALUATIONS = "evaluations per pixel"


def _features_at(p: Any) -> list:
    return evaluate_features(cast("Medium", p.context.medium), p.p_d, p.surface & (p.depth < p.view.distance))


def _color_evaluations(p: Any) -> list:
    import mitsuba as mi

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
            title="Depth",
            label="distance from the camera",
            unit="scene units",
            display=Display(cmap="viridis_r"),
            compute=lambda p: [p.camera_depth],
        ),
        Aov(
            name="opacity",
            summary="1 - transmittance",
            display=Display(limits=(0.0, 1.0)),
            compute=lambda p: [dr.select(p.active, p.view.opacity, 0)],
        ),
        Aov(
            name="position",
            channels="XYZ",
            summary="the surface :math:`p_d`",
            unit="scene units",
            compute=lambda p: list(dr.select(p.surface, p.p_d, 0)),
        ),
        Aov(
            name="gaze",
            summary="density in 1/sr of the observer attending this surface, after occlusion",
            title="Gaze",
            label="gaze density",
            unit="1/sr",
            display=_HEAT,
            data_source="gaze",
            needs_support=True,
            compute=lambda p: [p.attention.gaze],
            is_per_observer=True,
            dependencies=(GAZE,),
            demands=_GAZE,
        ),
        Aov(
            name="emit",
            summary="what the surface attracts, after its activation; 1 for a variant that lacks it",
            title="What surfaces attract",
            label="emitted attention",
            display=_HEAT,
            data_source="gaze",
            is_constant=lambda nerg: nerg.gaze.field.config.variant == "capture",
            compute=lambda p: [p.attention.emit],
            is_per_observer=True,
            dependencies=(GAZE,),
            demands=_FACTORS,
        ),
        Aov(
            name="capture",
            summary="what the observer gives, after its activation; 1 for a variant that lacks it",
            title="What the observer gives",
            label="captured attention",
            display=_HEAT,
            data_source="gaze",
            is_constant=lambda nerg: nerg.gaze.field.config.variant == "emit",
            compute=lambda p: [p.attention.capture],
            is_per_observer=True,
            dependencies=(GAZE,),
            demands=_FACTORS,
        ),
        Aov(
            name="gaze_std",
            summary="standard deviation of ``gaze`` over the members of an ensemble, in 1/sr, after occlusion",
            title="Uncertainty of gaze",
            label="standard deviation of gaze",
            unit="1/sr",
            display=_HEAT,
            data_source="gaze",
            needs_support=True,
            compute=lambda p: [p.attention.spread],
            is_per_observer=True,
            dependencies=(GAZE, MEMBERS),
            demands=frozenset({"gaze", "spread"}),
        ),
        Aov(
            name="support",
            summary="how many training rays started around the observer, one at distance d counting 1 - d²/(5R)² (R of "
            "the training); one number an observer, shown where there is a surface",
            title="Support",
            label="training rays around the observer",
            display=_HEAT,
            data_source="gaze",
            compute=lambda p: [p.view_of_observer("support")],
            view=lambda nerg: SupportView(nerg.gaze.field.support, nerg.gaze.to_world),
            is_per_observer=True,
            dependencies=(GAZE, SUPPORT),
        ),
        Aov(
            name="kde",
            summary="density in 1/sr of the tracked rays nearest to the observer, towards this surface, after "
            "occlusion",
            title="Where people looked",
            label="tracked gaze",
            unit="1/sr",
            display=_HEAT,
            data_source="kde",
            compute=lambda p: [p.view_of_observer("kde")],
            view=lambda nerg: nerg.children["kde"].kde_view(),
            is_per_observer=True,
            dependencies=(KDE,),
        ),
        Aov(
            name="visibility",
            summary="1 visible to the observer .. 0 hidden",
            title="Visible to the observer",
            label="0 hidden, 1 visible",
            display=Display(kind="shade", limits=(0.0, 1.0)),
            compute=lambda p: [dr.select(p.camera.surface, p.sight.visibility, 0)],
            is_per_observer=True,
        ),
        Aov(
            name="observer_depth",
            channels="T",
            summary=":math:`d_o`; the distance to the surface where no occlusion is computed",
            label="distance from the observer",
            unit="scene units",
            display=Display(cmap="viridis_r"),
            compute=lambda p: [dr.select(p.camera.surface, p.sight.depth, 0)],
            is_per_observer=True,
            demands=frozenset({"observer_depth"}),
        ),
        Aov(
            name="features",
            channels=None,
            summary="the field's geometry features, accumulated like colour (not divided by opacity)",
            display=_SIGNED,
            compute=lambda p: p.accumulated_features,
            dependencies=(FIELD,),
            demands=frozenset({"features"}),
        ),
        Aov(
            name="features_at",
            channels=None,
            summary="the same features at the surface :math:`p_d`; 0 on shapes",
            display=_SIGNED,
            compute=_features_at,
            dependencies=(FIELD,),
        ),
        Aov(
            name="density_evals",
            summary="evaluations of density made for the pixel",
            title="Evaluations of density",
            label=_EVALUATIONS,
            compute=lambda p: [p.density_evaluations()],
            is_per_observer=True,
            demands=_COUNTS,
        ),
        Aov(
            name="color_evals",
            summary="evaluations of colour made for the pixel",
            title="Evaluations of colour",
            label=_EVALUATIONS,
            compute=_color_evaluations,
            demands=_COUNTS,
        ),
        Aov(
            name="gaze_evals",
            summary="evaluations of gaze networks made for the pixel",
            title="Evaluations of gaze",
            label=_EVALUATIONS,
            compute=lambda p: [p.attention.evaluations],
            is_per_observer=True,
            dependencies=(GAZE,),
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
        for need in AOVS[name].dependencies:
            if not need.is_met(nerg):
                raise NergError(f'"aovs" asks for "{name}", {need.complaint}')
    if len(set(names)) < len(names):
        raise NergError(f'"aovs" names something twice: "{value}"')
    return names


def demands_of(names: Iterable[str]) -> frozenset[str]:
    """What has to be prepared for these AOVs."""
    return frozenset().union(*(AOVS[name].demands for name in names))


def views_of(names: Iterable[str], nerg) -> dict[str, ObserverView]:
    """The views of the observer that these AOVs show, by their names."""
    return {name: view(nerg) for name in names if (view := AOVS[name].view) is not None}


def channel_names(names: Iterable[str], medium) -> list[str]:
    """The names of all channels of these AOVs, in their order."""
    return [f"{name}.{channel}" for name in names for channel in AOVS[name].channel_suffixes(medium)]


def compute(names: Sequence[str], pixel: Any) -> list:
    """All channels of these AOVs, in their order."""
    # Evaluations are counted when all else has made its own.
    order = sorted((AOVS[name] for name in names), key=lambda aov: "counts" in aov.demands)
    found = {aov.name: aov.compute(pixel if aov.is_per_observer else pixel.camera) for aov in order}
    return [channel for name in names for channel in found[name]]


def manual() -> str:
    """The list of AOVs as the manual has it."""
    return "\n".join(_entry(aov) for aov in AOVS.values())


def _entry(aov: Aov) -> str:
    channels = "``.0``, ``.1``, ..." if aov.channels is None else f"``{' '.join('.' + c for c in aov.channels)}``"
    return textwrap.fill(f"- ``{aov.name}`` ({channels}): {aov.summary}", 120, subsequent_indent="  ")
