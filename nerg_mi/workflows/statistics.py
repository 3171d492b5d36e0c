"""Attention on things as numbers: counted in rays, foretold by a field, by cohort, time and zone; and what if."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import numpy as np

from nerg_mi.aoi.measured import (
    AoiContext,
    Viewpoints,
    ViewpointSampler,
    iter_blocks,
    list_cohorts,
    count_block,
    count_rays,
)
from nerg_mi.aoi.options import StatisticsOptions
from nerg_mi.aoi.output import StatisticsResult, write_results
from nerg_mi.aoi.parts import PartitionedStatistics
from nerg_mi.aoi.predicted import (
    AoiScene,
    PredictedAttention,
    add_uncertainty,
    subsample_participants,
    aggregate_by_participant,
    isovist_rows,
    place_observers_on_floor,
    viewpoints_at,
    load_aoi_scene,
    warn_few_viewpoints,
    warn_missing_support,
    what_if_rows,
)
from nerg_mi.aoi.scene import read_changes
from nerg_mi.errors import NergError
from nerg_mi.files.atomic import check_folder, make_folder
from nerg_mi.formats.areas import AreaSet, read_areas
from nerg_mi.interruption import Interruption
from nerg_mi.rays.pseudonyms import make_pseudonyms, read_salt
from nerg_mi.rays.rays import Rays
from nerg_mi.statistics.estimates import MIN_PARTICIPANTS
from nerg_mi.statistics.shares import Isovists, SamplePoints
from nerg_mi.statistics.tables import (
    PREDICTED,
    MEASURED,
    MinParticipantsFilter,
    Participants,
    ParticipantRows,
    Row,
    difference_rows,
    duration_rows,
    transition_rows,
    aoi_rows,
)
from nerg_mi.statistics.visits import ALL, Cell, Total, VisitSums

from .base import SILENT, Reporter, select_backend
from .options import parse_point
from .parts import PartRunner
from .scene_places import detect_kind


@dataclass(frozen=True)
class _Given:
    """The files, by what they are."""

    scene: Path | None = None
    field: Path | None = None
    gaze: Path | None = None
    rays: Path | Rays | None = None


def statistics(
    files: Sequence[str | Path | Rays],
    output: str | Path | None = None,
    options: StatisticsOptions | None = None,
    reporter: Reporter = SILENT,
) -> StatisticsResult:
    """Numbers of attention on the areas of ``options``.

    ``files``, in any order: rays or a dataset of them, a scene, a gaze field, a radiance field; a gaze field's place is
    found beside it. ``output``: folder for the tables; None: nothing is written. Raises `NergError`.
    """
    options = options or StatisticsOptions()
    if output is not None:
        check_folder(output)
    given = _sort(files)
    reporter.progress(0.0, "reading")
    areas = _areas(options)
    ns = select_backend(options.mode, options.threads)
    result = _StatisticsWork(given, areas, options, ns, reporter, output).run()
    if output is not None:
        inputs = [p for p in (given.scene, given.field, given.gaze, given.rays) if isinstance(p, Path)]
        inputs += [p for p in (options.aois, options.what_if) if p is not None and p.is_file()]
        result.files.extend(write_results(make_folder(output), result, inputs, options, reporter))
    return result


def _sort(files: Sequence[str | Path | Rays]) -> _Given:
    found: dict[str, Path | Rays] = {}
    for given in files:
        path = given if isinstance(given, Rays) else Path(given)
        if not isinstance(path, Rays) and path.suffix.lower() in (".json", ".csv"):
            raise NergError(f'"{path}" is no rays, scene or field; areas are given with --areas, and so on')
        kind = "rays" if isinstance(path, Rays) else detect_kind(path)
        if kind not in ("scene", "field", "gaze", "rays"):
            raise NergError(f'"{path}" is a {kind}; statistics take rays, a scene (.xml), a gaze and a radiance field')
        if kind in found:
            raise NergError(f'"{found[kind]}" and "{path}" are both a {kind}; give one')
        found[kind] = path
    if not found:
        raise NergError("give rays, a scene, or a gaze field to tell of")
    return _Given(**found)  # pyright: ignore[reportArgumentType]


def _areas(options: StatisticsOptions) -> AreaSet:
    if options.aois is None:
        if options.visibility:
            return AreaSet(())
        raise NergError("say which things are asked about: --areas FILE")
    return read_areas(options.aois)


class _StatisticsWork:
    """What is computed, with what its parts have in common."""

    def __init__(
        self,
        given: _Given,
        areas: AreaSet,
        options: StatisticsOptions,
        ns: ModuleType,
        reporter: Reporter,
        output: str | Path | None,
    ):
        self.given, self.areas, self.options, self.reporter = given, areas, options, reporter
        self.setting = load_aoi_scene(given.scene, given.field, given.gaze, areas, options, ns)
        self.around, self.things, self.members = self.setting.gaze_scene, self.setting.aois, self.setting.members
        for note in self.setting.warnings:
            reporter.message(note)
        if options.what_if is not None and self.around.gaze is None:
            raise NergError("--what-if is what a gaze field foretells: give one, or a scene that has one")
        if options.what_if is not None:
            # What is wrong with it is told before anything is counted.
            read_changes(options.what_if)
        self.parts = self._in_parts(output) if options.in_parts else None

    def run(self) -> StatisticsResult:
        """All that is asked for."""
        o, floor = self.options, MinParticipantsFilter(self.options.min_participants)
        if o.visibility:
            return StatisticsResult(isovists=isovist_rows(self._isovists(), self.areas.names, self.members))
        counting = None if self.given.rays is None else self._counting(self.given.rays)
        sums, eyes = (None, self._standing()) if counting is None else self._count(counting)
        if counting is None and self.around.gaze is None:
            raise NergError("there is nobody to tell of: give rays, or a gaze field (or --visibility for isovists)")
        cells = [ALL] if counting is None else list(sums.cells) if sums is not None else []
        seen = counting is not None and counting.visibility_cache is not None
        people: dict[Cell, dict[str, Participants]] = {cell: {} for cell in cells}
        times: dict[Cell, dict[str, float]] = {cell: {} for cell in cells}
        for cell in cells:
            if sums is not None:
                people[cell][MEASURED] = tracked = Participants.from_sums(sums, cell, seen)
                times[cell] = dict(zip(tracked.names, tracked.time.tolist()))
            else:
                times[cell] = dict.fromkeys(eyes.participants, 1.0)
        foretold = None
        if self.around.gaze is not None:
            foretold = self._foretold(eyes)
            warn_missing_support(foretold, self.reporter)
            for cell in cells:
                found = aggregate_by_participant(foretold, eyes, cell, times[cell], o.glance_duration)
                if found is not None:
                    people[cell][PREDICTED] = found
        self._tell(people)
        names = self.areas.names
        self.reporter.progress(0.9, "intervals")
        things = aoi_rows(names, people, floor, resamples=o.resamples, seed=o.seed)
        if foretold is not None:
            add_uncertainty(things, foretold, eyes, times, o.glance_duration)
        result = StatisticsResult(
            things,
            difference_rows(
                names, people, floor, source=MEASURED if sums is not None else PREDICTED, resamples=o.resamples, seed=o.seed
            ),
            [] if sums is None else transition_rows(sums, floor),
            [] if sums is None else duration_rows(sums, floor),
            self._people(sums, seen),
            [] if o.what_if is None else self._what_if(eyes, foretold, floor),
            [],
            sums,
            floor.num_suppressed,
        )
        if floor.num_suppressed:
            self.reporter.message(f"{floor.num_suppressed:,} numbers rest on fewer than {floor.minimum} people and are blank")
        return result

    def _counting(self, rays: Path | Rays) -> AoiContext:
        first = next(iter_blocks(rays, self.options.visit_rules()))
        hits = self.around.geometry is None and first.hit is not None and bool(np.isfinite(first.hit).any())
        if self.around.geometry is None:
            self.reporter.message(
                "no place is given: rays end at their hit points"
                if hits
                else "no place is given: things hide each other, and nothing else hides them"
            )
        return self.setting.make_context(hits, list_cohorts(rays, first))

    def _count(self, counting: AoiContext) -> tuple[VisitSums, Viewpoints]:
        assert self.given.rays is not None
        count = count_rays(self.given.rays)
        picker = ViewpointSampler(max(1, count // self.options.viewpoints))
        total: Total | None = None

        def pick(block: Rays) -> None:
            picker.add(block, counting)

        seen = None if self.around.gaze is None else pick
        if self.parts is None:
            arriving = self._counted(self.given.rays, counting, seen, count)
        else:
            arriving = self.parts.count(self.given.rays, counting, seen)
        for part in arriving:
            total = total or Total(part.areas, part.cells)
            total.add(part)
        if total is None:
            raise NergError("there are no rays to count; import some")
        sums = total.sums()
        self.reporter.message(f"{count:,} rays of {len(sums.find_participants(ALL)[0]):,} people")
        if self.around.gaze is None:
            return sums, Viewpoints(np.zeros((0, 3)), np.zeros((0, 3)), (), ())
        eyes = subsample_participants(picker.viewpoints(), self.options.viewpoints, self.reporter)
        warn_few_viewpoints(eyes, self.reporter)
        return sums, eyes

    def _counted(
        self, rays: Rays | Path, counting: AoiContext, seen: Callable[[Rays], None] | None, count: int
    ) -> Iterator[VisitSums]:
        """The sums of each block, in this process."""
        done = 0
        with Interruption() as stop:
            for block in iter_blocks(rays, self.options.visit_rules()):
                stop.check()
                yield count_block(block, counting)
                if seen is not None:
                    seen(block)
                done += len(block)
                self.reporter.progress(0.8 * done / count, f"{done:,} of {count:,} rays")

    def _in_parts(self, output: str | Path | None) -> PartitionedStatistics:
        g, o = self.given, self.options
        if output is None and o.store is None:
            raise NergError("parts are kept in a folder: name one by --store, or an output beside which it is made")
        import mitsuba as mi

        name = Path(output or o.store or "")
        parts = PartRunner(o, name, self.reporter, o.threads)
        what = f"nerg stats {name.absolute()}"
        return PartitionedStatistics(parts, what, g.scene, g.field, g.gaze, self.areas, o, str(mi.variant()))

    def _standing(self) -> Viewpoints:
        """Observers who were not tracked."""
        o = self.options
        if o.observers:
            return viewpoints_at(np.array([parse_point(text, "--observer") for text in o.observers]))
        if self.around.observer is not None:
            return viewpoints_at(self.around.observer[None])
        found = place_observers_on_floor(self.around, o.eye_height, o.grid_step, o.floor_height)
        every = max(1, len(found) // o.viewpoints)
        self.reporter.message(f"nobody was tracked: {len(found[::every])} places on the floor, each somebody's")
        return viewpoints_at(found[::every])

    @property
    def _view(self) -> float:
        """Degrees that people see. Without rays nobody knows where somebody is turned."""
        return self.options.fov if self.given.rays is not None else 360.0

    def _foretold(self, eyes: Viewpoints) -> PredictedAttention:
        """What the field says where people stood."""
        if self.parts is None:
            return self.setting.predict(eyes, self._view, self.reporter)
        return self.parts.predict(eyes, self._view)

    def _isovists(self) -> Isovists:
        from nerg_mi.statistics.shares import compute_isovists

        o = self.options
        points = place_observers_on_floor(self.around, o.eye_height, o.grid_step, o.floor_height)
        box = self.around.bounds()
        self.reporter.message(f"{len(points):,} places on the floor")
        reach = float(np.linalg.norm(box[1] - box[0]))
        return compute_isovists(points, self.around.trace_depth, SamplePoints.sample(self.things, o.aoi_samples), self.setting.margin, reach)

    def _what_if(self, eyes: Viewpoints, before: PredictedAttention | None, floor: MinParticipantsFilter) -> list[Row]:
        o, parts = self.options, self.parts
        assert o.what_if is not None and before is not None

        def foretell(there: AoiScene, others: Viewpoints) -> PredictedAttention:
            for note in there.warnings[len(self.setting.warnings) :]:
                self.reporter.message(note)
            if parts is None:
                return there.predict(others, self._view, self.reporter)
            return parts.predict(others, self._view, o.what_if)

        return what_if_rows(o.what_if, self.setting, eyes, before, foretell, floor, o.resamples, o.seed)

    def _people(self, sums: VisitSums | None, seen: bool) -> Sequence[Row]:
        o = self.options
        if sums is None:
            return ()
        if o.min_participants > 1:
            self.reporter.message("no table of single people is made, since each number in it would be of one person")
            return ()
        persons = sums.find_participants(ALL)[1]
        named = {p: p for p in persons}
        if not o.show_names:
            named = make_pseudonyms(persons, None if o.salt is None else read_salt(o.salt))
        return ParticipantRows(sums, named, seen)

    def _tell(self, people: Mapping[Cell, Mapping[str, Participants]]) -> None:
        for cell in (c for c, found in people.items() if MEASURED in found and not found[MEASURED].names):
            self.reporter.message(f"nobody is in the {cell.dimension} {cell.value}; windows are on the rays' own clock")
        few = [cell for cell, found in people.items() for p in found.values() if 0 < p.is_in_cell.sum() < MIN_PARTICIPANTS]
        if few:
            which = "all of it" if few[0] == ALL else f"{few[0].dimension} {few[0].value}"
            self.reporter.message(
                f"there are no intervals where there are fewer than {MIN_PARTICIPANTS} people ({which}"
                + (f" and {len(set(few)) - 1} more)" if len(set(few)) > 1 else ")")
            )
