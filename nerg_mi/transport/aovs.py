"""The AOVs of :ref:`nerg <integrator-nerg>`: one table for validation, channel names, evaluation, manual, overlays,
layers of the viewer, contact sheets and differences. A new AOV is one new entry."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, cast

import drjit as dr

from nerg_mi.errors import NergError, parameter

from .field_medium import evaluate_features
from .observer import ObserverView, SupportView

if TYPE_CHECKING:
    from .medium import Medium


@dataclass(frozen=True)
class Dependency:
    """A part of the integrator that an AOV depends on: a test for it, and the error message without it."""

    is_satisfied: Callable[[Any], bool]
    message: str


FIELD = Dependency(lambda nerg: "field" in nerg.children, 'which needs a "field"')
GAZE = Dependency(lambda nerg: nerg.gaze is not None, 'which needs a "gaze" volume')
KDE = Dependency(lambda nerg: "kde" in nerg.children, 'which needs a "kde" volume of type "gazekde"')
MEMBERS = Dependency(
    lambda nerg: len(nerg.gaze.field.members) > 1,
    f'which needs an ensemble as "gaze"; train one with {parameter("ensemble", 5)}',
)
SUPPORT = Dependency(
    lambda nerg: nerg.gaze.field.support is not None, 'which needs a "gaze" checkpoint with support; train it again'
)


@dataclass(frozen=True, kw_only=True)
class Display:
    """How images show the values of an AOV.

    Parameters
    ----------
    kind : str
        "sequential": a colour scale; "heat": a colour scale blended over the image, more opaque for higher values;
        "diverging": a scale symmetric about 0; "categorical": whole numbers that identify classes; "shade": values from
        0 to 1 that darken the image.
    cmap : str, optional
        Colour map of matplotlib. Default: that of the kind.
    limits : tuple of float, optional
        Fixed ends of the scale. Default: percentiles of the visible values; from 0 for a heat map, symmetric if
        diverging.
    """

    kind: Literal["sequential", "heat", "diverging", "categorical", "shade"] = "sequential"
    cmap: str | None = None
    limits: tuple[float, float] | None = None


@dataclass(frozen=True, kw_only=True)
class Quantity:
    """How a quantity is labelled and displayed.

    Parameters
    ----------
    title : str
        Title of an image and of the viewer's layer. Default: from the ``name``.
    label, unit : str
        Label of the colour bar (default: the name) and its unit.
    data_source : str
        The part of the integrator, "gaze" or "kde", that stems from tracking data; images state the amount of data.
    needs_support : bool
        Whether regions are hatched if no rays were recorded near the observer.
    """

    name: str
    title: str = ""
    label: str = ""
    unit: str = ""
    display: Display = Display()
    data_source: str = ""
    needs_support: bool = False

    @property
    def heading(self) -> str:
        """The title, or the name in words."""
        return self.title or self.name.replace("_", " ").capitalize()

    @property
    def scale_label(self) -> str:
        """Label and unit for a colour bar."""
        label = self.label or self.name.replace("_", " ")
        return f"{label} [{self.unit}]" if self.unit else label


@dataclass(frozen=True, kw_only=True)
class Aov(Quantity):
    """One AOV. ``compute`` is only called for the requested AOVs."""

    # Suffixes of the channels; None: one channel per feature of the medium, numbered.
    channels: str | None = "Y"
    # Description for the manual.
    summary: str
    # Computes one Float per channel from a `plugins.nerg_pixel.CameraView`, or from a `Pixel` if `is_per_observer`.
    compute: Callable[[Any], list]
    # Creates, from the integrator, the observer view for ``Pixel.evaluate_observer_view``.
    view: Callable[[Any], ObserverView] | None = None
    # Whether it depends on the position of the observer; other AOVs are computed once for several observers.
    is_per_observer: bool = False
    # Whether it is constant for a given integrator.
    is_constant: Callable[[Any], bool] = lambda nerg: False
    # In the order in which they are checked.
    dependencies: tuple[Dependency, ...] = ()
    # Data that must be prepared for it, see `RenderContext`.
    required_data: frozenset[str] = frozenset()

    @property
    def has_multiple_channels(self) -> bool:
        """Whether it has more than one channel."""
        return self.channels is None or len(self.channels) > 1

    def channel_suffixes(self, medium) -> list[str]:
        """Suffixes of its channels for ``medium``."""
        return [str(i) for i in range(medium.feature_count)] if self.channels is None else list(self.channels)


_GAZE, _FACTORS, _COUNTS = frozenset({"gaze"}), frozenset({"gaze", "factors"}), frozenset({"counts"})
_HEAT, _SIGNED = Display(kind="heat"), Display(kind="diverging")
_EVALUATIONS = "evaluations per pixel"


def _features_at(p: Any) -> list:
    return evaluate_features(
        cast("Medium", p.context.nerg.medium), p.p_d, p.has_surface & (p.depth < p.ray_hit.shape_distance)
    )


def _color_evaluations(p: Any) -> list:
    import mitsuba as mi

    march, medium = p.ray_hit.march, p.context.nerg.medium
    if not p.has_color or march is None or medium is None:
        return [mi.Float(0)]
    once = dr.select(p.active & (p.ray_hit.medium_opacity > 0), mi.Float(1), 0)
    return [once if medium.is_deferred else march.color_evals]


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
            compute=lambda p: [dr.select(p.active, p.ray_hit.opacity, 0)],
        ),
        Aov(
            name="position",
            channels="XYZ",
            summary="the surface :math:`p_d`",
            unit="scene units",
            compute=lambda p: list(dr.select(p.has_surface, p.p_d, 0)),
        ),
        Aov(
            name="gaze",
            summary="gaze density in 1/sr of the observer on this surface, after occlusion",
            title="Gaze",
            label="gaze density",
            unit="1/sr",
            display=_HEAT,
            data_source="gaze",
            needs_support=True,
            compute=lambda p: [p.surface_gaze.gaze],
            is_per_observer=True,
            dependencies=(GAZE,),
            required_data=_GAZE,
        ),
        Aov(
            name="emit",
            summary="factor of the surface, after its activation; 1 for a variant without it",
            title="Attention that surfaces attract",
            label="emitted attention",
            display=_HEAT,
            data_source="gaze",
            is_constant=lambda nerg: nerg.gaze.field.config.variant == "capture",
            compute=lambda p: [p.surface_gaze.emit],
            is_per_observer=True,
            dependencies=(GAZE,),
            required_data=_FACTORS,
        ),
        Aov(
            name="capture",
            summary="factor of the observer, after its activation; 1 for a variant without it",
            title="Attention that the observer gives",
            label="captured attention",
            display=_HEAT,
            data_source="gaze",
            is_constant=lambda nerg: nerg.gaze.field.config.variant == "emit",
            compute=lambda p: [p.surface_gaze.capture],
            is_per_observer=True,
            dependencies=(GAZE,),
            required_data=_FACTORS,
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
            compute=lambda p: [p.surface_gaze.std],
            is_per_observer=True,
            dependencies=(GAZE, MEMBERS),
            required_data=frozenset({"gaze", "spread"}),
        ),
        Aov(
            name="support",
            summary="number of training rays that started near the observer; a ray at distance d counts 1 - d²/(5R)² "
            "(R: probe radius of the training); one number per observer, shown on all surfaces",
            title="Support",
            label="training rays near the observer",
            display=_HEAT,
            data_source="gaze",
            compute=lambda p: [p.evaluate_observer_view("support")],
            view=lambda nerg: SupportView(nerg.gaze.field.support, nerg.gaze.to_world),
            is_per_observer=True,
            dependencies=(GAZE, SUPPORT),
        ),
        Aov(
            name="kde",
            summary="density in 1/sr of the tracked rays nearest to the observer, towards this surface, after "
            "occlusion",
            title="Where participants looked",
            label="recorded gaze",
            unit="1/sr",
            display=_HEAT,
            data_source="kde",
            compute=lambda p: [p.evaluate_observer_view("kde")],
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
            compute=lambda p: [dr.select(p.camera.has_surface, p.observer_hit.visibility, 0)],
            is_per_observer=True,
        ),
        Aov(
            name="observer_depth",
            channels="T",
            summary="depth :math:`d_o` along the observer's ray; the distance to the surface without occlusion",
            label="distance from the observer",
            unit="scene units",
            display=Display(cmap="viridis_r"),
            compute=lambda p: [dr.select(p.camera.has_surface, p.observer_hit.depth, 0)],
            is_per_observer=True,
            required_data=frozenset({"observer_depth"}),
        ),
        Aov(
            name="features",
            channels=None,
            summary="the field's geometry features, composited like colour (not divided by opacity)",
            display=_SIGNED,
            compute=lambda p: p.accumulated_features,
            dependencies=(FIELD,),
            required_data=frozenset({"features"}),
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
            summary="density evaluations for the pixel",
            title="Density evaluations",
            label=_EVALUATIONS,
            compute=lambda p: [p.count_density_evaluations()],
            is_per_observer=True,
            required_data=_COUNTS,
        ),
        Aov(
            name="color_evals",
            summary="colour evaluations for the pixel",
            title="Colour evaluations",
            label=_EVALUATIONS,
            compute=_color_evaluations,
            required_data=_COUNTS,
        ),
        Aov(
            name="gaze_evals",
            summary="evaluations of gaze networks for the pixel",
            title="Gaze evaluations",
            label=_EVALUATIONS,
            compute=lambda p: [p.surface_gaze.evaluations],
            is_per_observer=True,
            dependencies=(GAZE,),
            required_data=_GAZE,
        ),
    )
}


def parse_aovs(value: str, nerg) -> list[str]:
    """The names in a comma-separated list. Raises ``NergError`` for a name that is unknown or repeated, or whose
    dependencies the integrator lacks."""
    names = [n.strip() for n in value.split(",") if n.strip()]
    for name in names:
        if name not in AOVS:
            raise NergError(f'"aovs" contains the unknown name "{name}"; known names: {", ".join(AOVS)}')
        for dependency in AOVS[name].dependencies:
            if not dependency.is_satisfied(nerg):
                raise NergError(f'"aovs" contains "{name}", {dependency.message}')
    if len(set(names)) < len(names):
        raise NergError(f'"aovs" contains a name twice: "{value}"')
    return names


def collect_required_data(names: Iterable[str]) -> frozenset[str]:
    """The data that must be prepared for these AOVs."""
    return frozenset().union(*(AOVS[name].required_data for name in names))


def collect_observer_views(names: Iterable[str], nerg) -> dict[str, ObserverView]:
    """The observer views of these AOVs, by name."""
    return {name: view(nerg) for name in names if (view := AOVS[name].view) is not None}


def channel_names(names: Iterable[str], medium) -> list[str]:
    """The names of all channels of these AOVs, in order."""
    return [f"{name}.{channel}" for name in names for channel in AOVS[name].channel_suffixes(medium)]


def format_manual() -> str:
    """The list of AOVs for the manual."""
    entries = []
    for aov in AOVS.values():
        channels = "``.0``, ``.1``, ..." if aov.channels is None else f"``{' '.join('.' + c for c in aov.channels)}``"
        entries.append(textwrap.fill(f"- ``{aov.name}`` ({channels}): {aov.summary}", 120, subsequent_indent="  "))
    return "\n".join(entries)
