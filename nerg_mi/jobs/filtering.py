"""What a filter does to rays, step by step: conditions, fixations, thinning, a sample."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.rays import filters
from nerg_mi.rays.rays import Rays

from .options.rays import FilterOptions
from .reporter import SILENT, Reporter


@dataclass(frozen=True)
class Step:
    """A step that was taken: what the metadata of rays keep of it."""

    name: str
    kept: int
    of: int
    about: dict[str, Any]


class FilterSteps:
    """Rays to which one thing after the other is done.

    ``own``: whether nobody else holds the rays, which then lose them. ``strict``: whether a step that leaves none is an
    error; without it what is left of nothing is nothing.
    """

    def __init__(self, rays: Rays, *, own: bool, reporter: Reporter = SILENT, strict: bool = True) -> None:
        self.rays, self.taken = rays, list[Step]()
        self._own, self._reporter, self._strict = own, reporter, strict

    def select(self, conditions: dict[str, Any]) -> None:
        """Keep what meets ``conditions``, those of `nerg_mi.rays.filters.select_mask`."""
        self._keep(filters.select_mask(self.rays, **conditions), "filter", conditions)

    def follow(self, options: FilterOptions) -> int | None:
        """Keep fixations, and fewer of those who stand still, as ``options`` say; how many fixations there are."""
        count = None
        if options.fixations is not None:
            count = self._fixations(options)
        if options.thin is not None:
            about = {"seconds": options.thin, "distance": options.thin_distance}
            there = len(self.rays) > 0
            self._keep(filters.thin_mask(self.rays, **about) if there else np.zeros(0, bool), "thin", about)
        return count

    def sample(self, n: int, seed: int) -> None:
        """Keep ``n`` rays, each as likely as any other."""
        lot = np.random.default_rng(seed).random(len(self.rays))
        self._keep(least_mask(lot, n), "sample", {"seed": seed})

    def _fixations(self, options: FilterOptions) -> int:
        by_velocity = options.fixations == "ivt"
        limit = {"velocity": options.velocity} if by_velocity else {"dispersion": options.dispersion}
        limit |= {} if options.least is None else {"least": options.least}
        label = np.zeros(0, np.int64)
        if len(self.rays):
            label = (filters.ivt if by_velocity else filters.idt)(self.rays, **limit)
        count = len(np.unique(label[label >= 0]))
        self._reporter.message(f"{count:,} fixations ({options.fixations})")
        about = {"by": options.fixations, **limit}
        if options.one_ray:
            self._replace(label, {**about, "one_ray": True})
        else:
            self._keep(label >= 0, "fixations", about)
        return count

    def _replace(self, label: np.ndarray, about: dict[str, Any]) -> None:
        """Go on with a ray for each fixation."""
        before = len(self.rays)
        rays = filters.fixation_rays(self.rays, label)[0] if before else self.rays
        self._reporter.message(f"fixations: one ray each, {len(rays):,} of {before:,} rays")
        self._take(rays, Step("fixations", len(rays), before, about))

    def _keep(self, mask: np.ndarray, name: str, about: dict[str, Any]) -> None:
        """Keep the rays of a mask (N,); in their own memory, if nobody else holds them."""
        rays, count = self.rays, int(mask.sum())
        if not count and self._strict:
            raise NergError(f"{name} leaves none of {len(rays):,} rays; widen its conditions")
        self._reporter.message(f"{name}: {count:,} of {len(rays):,} rays")
        kept = rays.keep_in_place(mask) if self._own else rays.select(mask)
        self._take(kept, Step(name, count, len(rays), about))

    def _take(self, rays: Rays, step: Step) -> None:
        self.rays = rays.with_step(step=step.name, kept=step.kept, of=step.of, **step.about)
        self._own = True
        self.taken.append(step)


def least_mask(lot: np.ndarray, n: int) -> np.ndarray:
    """The ``n`` least of the numbers ``lot`` (N,), as a mask; all, where there are no more."""
    mask = np.ones(len(lot), bool)
    if n < len(lot):
        mask[np.argpartition(lot, n)[n:]] = False
    return mask
