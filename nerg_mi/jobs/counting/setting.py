"""What a count needs besides rays, from files and options: the same in whatever process it is made."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from types import ModuleType

import numpy as np

from nerg_mi.alignment.check import read_similarity
from nerg_mi.formats.areas.kinds import Areas, Group
from nerg_mi.formats.regions import read_regions
from nerg_mi.jobs.options.statistics import StatisticsOptions, parse_window
from nerg_mi.jobs.reporter import SILENT, Reporter
from nerg_mi.statistics.visibility import CellsInView, Targets
from nerg_mi.statistics.visits import LookRules, Thing

from .changes import Changes, changed_areas, changed_scene
from .cohorts import read_cohorts
from .foretold import Foretold, foretell
from .surroundings import Surroundings, surroundings_of_files
from .things import shapes_of, things_of
from .tracked import Counting, Eyes, Window


@dataclass(frozen=True, eq=False)
class Setting:
    """``areas`` in what is ``around`` people, and the ``things`` that they consist of; ``options`` of how it is
    counted, with their ``rules`` of looks and ``windows`` of time."""

    around: Surroundings
    areas: Areas
    things: Sequence[Thing]
    options: StatisticsOptions
    rules: LookRules
    windows: Sequence[Window]

    @cached_property
    def members(self) -> list[tuple[int, ...]]:
        """Of each area the numbers of its things."""
        return list(self.areas.members().values())

    @property
    def margin(self) -> float:
        """In units of the place."""
        return self.options.margin * self.around.scale

    def counting(self, hits: bool, cohorts: tuple[str, ...]) -> Counting:
        """How rays are counted which end at their ``hits``, or not, and have these ``cohorts`` where no table does."""
        o = self.options
        in_view = None
        if o.seen:
            targets = Targets.of(self.things, o.samples)
            in_view = CellsInView(targets, self._depth_or_things, o.cell * self.around.scale, self.margin)
        leaves = [k for k, area in enumerate(self.areas.areas) if not isinstance(area, Group)]
        table = {} if o.cohorts is None else read_cohorts(o.cohorts)
        return Counting(
            self.around,
            self.things,
            self.areas.names,
            self.members,
            leaves,
            self.rules,
            self.margin,
            o.tolerance,
            hits,
            o.view,
            in_view,
            self.windows,
            [] if o.zones is None else read_regions(o.zones),
            table,
            tuple(sorted(set(table.values()))) if table else cohorts,
        )

    def changed(self, changes: Changes) -> Setting:
        """The same after ``changes`` of shapes and areas. Raises `NergError` for those that cannot be made."""
        areas, around, shapes = changed_areas(self.areas, changes), self.around, shapes_of(self.around.scene)
        if changes.of_shapes:
            scene, shapes = changed_scene(around.scene, changes)
            around = around.within(scene)
        return replace(self, around=around, areas=areas, things=things_of(areas.things, shapes))

    def foretold(self, eyes: Eyes, view: float, reporter: Reporter = SILENT) -> Foretold:
        """What the field says of the gaze of ``eyes`` that see so many degrees (``view``)."""
        o = self.options
        return foretell(
            self.around, eyes, self.things, self.members, self.margin, view, o.samples, o.directions, reporter
        )

    def _depth_or_things(self, o: np.ndarray, d: np.ndarray) -> np.ndarray:
        """How far is seen: to the surfaces of the place, or, where none is known, to the nearest thing."""
        if self.around.place is not None:
            return self.around.depth(o, d)
        reach = np.full(len(o), np.inf)
        for thing in self.things:
            near, far = thing.interval(o, d)
            met = (near >= 0) & (np.isfinite(near) if thing.open else near < far)
            reach = np.where(met, np.minimum(reach, near), reach)
        return reach


def setting_of(
    scene: Path | None, field: Path | None, gaze: Path | None, areas: Areas, options: StatisticsOptions, ns: ModuleType
) -> Setting:
    """The setting of these files. Raises `NergError`; what is plainly wrong is told before anything is loaded."""
    rules = LookRules(options.gap, options.pause, options.merge, options.least)
    windows = [Window(*parse_window(text)) for text in options.windows]
    align = None if options.align is None else read_similarity(options.align, "--align", "rays to place")
    around = surroundings_of_files(scene, field, gaze, align, ns)
    return Setting(around, areas, things_of(areas.things, shapes_of(around.scene)), options, rules, windows)
