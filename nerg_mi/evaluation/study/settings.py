"""Which settings a study renders: sweeps of one factor around the scene's own, steps x quadrature, the paper's
marching."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from nerg_mi.transport.depth import DEPTHS
from nerg_mi.transport.quadrature import RULES

from . import splats
from .paper import DT_GAMMA, STEPS, as_in_the_paper

STEP_COUNTS = (16, 32, 64, 128, 256, 512, 1024, 2048, 4096)
RESOLUTIONS = (16, 32, 64, 128)
PAPER = "paper"


@dataclass(frozen=True)
class Setting:
    """One row of a study."""

    # As the tables have it.
    name: str
    # The factor that it belongs to.
    group: str
    # Of the integrator, over the scene's own.
    params: Mapping = field(default_factory=dict)
    # Samples a pixel.
    spp: int = 1
    # Of the density as a grid; 0: the scene's own.
    resolution: int = 0
    # (steps, γ) of the paper's marching; None: ours.
    paper: tuple[int, float] | None = None
    # What is kept from frame to frame is made anew in each.
    first_frame: bool = False

    def integrator(self, subject, **more):
        """The integrator that renders this row; ``more``: further parameters, such as AOVs that count."""
        made = subject.integrator({**self.params, **more}, self.resolution)
        return made if self.paper is None else as_in_the_paper(made, subject.sensor, subject.tolerance, *self.paper)


def settings(subject, quick: bool = False) -> list[Setting]:
    """All rows for ``subject``; ``quick``: one or two of each factor."""

    if not subject.marched:
        return [Setting("default", "default"), *_observer(subject, quick), *_left_out(subject), *_samples(quick)]

    def some(values):
        return values[:: max(len(values) - 1, 1)] if quick else values

    if subject.hits:
        return [*_met(some), *_observer(subject, quick), *_left_out(subject), *_samples(quick)]

    def steps(n):
        return {"step": subject.extent / n}

    rows = [Setting("default", "default")]
    for rule in (r.name for r in RULES if not r.in_cells):
        for n in (64, 512) if quick else STEP_COUNTS:
            rows.append(Setting(f"{rule}, {n} steps", f"steps, {rule}", {"quadrature": rule, **steps(n)}))
    for g in some((1 / 1024, 1 / 512, 1 / 256, 1 / 128)):
        rows.append(Setting(f"dt_gamma 1/{round(1 / g)}", "dt_gamma", {"dt_gamma": g}))
    for c in some((2, 4, 8, 16)):
        rows.append(Setting(f"coarse {c}", "coarse", {"coarse": float(c)}))
    for s in some((1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-8)):
        rows.append(Setting(f"stop {s:g}", "stop", {"stop": s}))
    for c in some((0.0, 1e-4, 1e-3, 3e-3, 1e-2, 3e-2)):
        rows.append(Setting(f"color_cutoff {c:g}", "color_cutoff", {"color_cutoff": c}))
    for k in DEPTHS.names():
        rows.append(Setting(f"depth {k}", "depth", {"depth": k}))
        for n in () if quick else (128, 256, 512, 1024):
            rows.append(Setting(f"depth {k}, {n} steps", "depth", {"depth": k, **steps(n)}))
    rows.append(Setting("unrefined", "refined", {"refined": False}))
    rows.append(Setting("jitter", "jitter", {"jitter": True}))
    rows += _observer(subject, quick) + _left_out(subject) + _samples(quick)
    if subject.resampled:
        for r in RESOLUTIONS[:1] if quick else RESOLUTIONS:
            for rule in RULES.names():
                rows.append(Setting(f"grid {r}, {rule}", "resolution", {"quadrature": rule}, resolution=r))
        for n in () if quick else (16, 64, 256):
            for rule in RULES.names():
                rows.append(
                    Setting(
                        f"grid 64, {rule}, {n} steps", "resolution", {"quadrature": rule, **steps(n)}, resolution=64
                    )
                )
    rows += [] if quick else _together(subject)
    return rows + _paper(quick)


def _met(some) -> list[Setting]:
    """Of Gaussian splats, which are met one by one and not marched."""
    rows = [Setting("default", "default")]
    rows += [Setting(f"stop {s:g}", "stop", {"stop": s}) for s in some(splats.STOPS)]
    rows += [Setting(f"extent {e:g}", "extent", {"extent": e}) for e in some(splats.EXTENTS)]
    # The others are the median here.
    rows += [Setting(f"depth {k}", "depth", {"depth": k}) for k in ("expected", "median")]
    loose = [(2.0, 1e-2), (2.5, 1e-2), (2.5, 1e-3)]
    return rows + [Setting(f"extent {e:g}, stop {s:g}", "together", {"extent": e, "stop": s}) for e, s in some(loose)]


def _visibility(quick: bool) -> list[Setting]:
    rows = [Setting(f"visibility {k}", "visibility", {"visibility": k}) for k in ("depth", "transmittance")]
    for h in (16,) if quick else (64, 128, 256, 512, 1024):
        params = {"visibility": "map", "map_height": h}
        rows.append(Setting(f"visibility map {h}", "visibility", params))
        rows.append(Setting(f"visibility map {h}, first frame", "visibility", params, first_frame=True))
    return rows


def _observer(subject, quick: bool) -> list[Setting]:
    """What is found out for each observer: visibility, and the integral of a gaze that is divided by one."""
    if not subject.normalized:
        return _visibility(quick)
    return _visibility(quick) + [
        Setting(f"integral_tolerance {t:g}, first frame", "integral", {"integral_tolerance": t}, first_frame=True)
        for t in ((0.0, 5e-3) if quick else (0.0, 3.125e-4, 1.25e-3, 5e-3, 2e-2))
    ]


def _samples(quick: bool) -> list[Setting]:
    return [Setting(f"spp {k}", "spp", spp=k) for k in ((2,) if quick else (4, 16, 64))]


def _left_out(subject) -> list[Setting]:
    """What a scene does not need, taken away piece by piece."""
    rows = [
        Setting("no colour", "leave out", {"radiance": False}),
        Setting("no observer", "leave out", {"aovs": "depth,opacity"}),
        Setting("depth only", "leave out", {"aovs": "depth,opacity", "radiance": False}),
    ]
    if subject.has_gaze:
        rows.insert(1, Setting("no gaze", "leave out", {"aovs": "depth,opacity,visibility"}))
    return rows


def _together(subject) -> list[Setting]:
    """Several factors at once, to find the front."""
    rows = []
    for n in (128, 256, 512, 1024, 2048):
        step = {"step": subject.extent / n}
        rows.append(Setting(f"{n} steps, coarse 4", "together", {**step, "coarse": 4.0}))
        loose = {**step, "stop": 1e-4, "color_cutoff": 1e-2}
        rows.append(Setting(f"{n} steps, stop 1e-4, cutoff 1e-2", "together", loose))
        rows.append(
            Setting(f"{n} steps, stop 1e-4, cutoff 1e-2, linear", "together", {**loose, "quadrature": "linear"})
        )
        rows.append(Setting(f"{n} steps, stop 1e-4, cutoff 1e-2, refined", "together", {**loose, "depth": "refined"}))
    return rows


def _paper(quick: bool) -> list[Setting]:
    counts = (64, STEPS) if quick else (128, 256, 512, STEPS, 2048, 4096)
    # The rule is one of depth comparison and of expected depth, whatever the scene prefers.
    params = {"depth": "expected", "visibility": "depth"}
    rows = [Setting(f"paper, {n} steps", PAPER, params, paper=(n, 0.0)) for n in counts]
    return rows + [Setting(f"paper, {STEPS} steps, dt_gamma 1/128", PAPER, params, paper=(STEPS, DT_GAMMA))]
