"""Attention statistics of AOIs: measured, predicted by a gaze field, by cohort, time and zone, and what-if changes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType

import numpy as np

from nerg_mi.aoi.measured import (
    AoiContext,
    Viewpoints,
    ViewpointSampler,
    count_block,
    count_rays,
    iter_blocks,
    list_cohorts,
)
from nerg_mi.aoi.options import StatisticsOptions
from nerg_mi.aoi.output import StatisticsResult, write_results
from nerg_mi.aoi.predicted import (
    AoiScene,
    PredictedAttention,
    add_uncertainty,
    aggregate_by_participant,
    load_aoi_scene,
    place_observers_on_floor,
    subsample_participants,
    viewpoints_at,
    warn_few_viewpoints,
    warn_missing_support,
    what_if_rows,
)
from nerg_mi.aoi.scene import read_changes
from nerg_mi.environment.kinds import detect_kind
from nerg_mi.errors import NergError, parameter
from nerg_mi.files.atomic import check_folder, make_folder
from nerg_mi.formats.areas import AreaSet, read_areas
from nerg_mi.interruption import Interruption
from nerg_mi.measures.estimates import MIN_PARTICIPANTS
from nerg_mi.measures.power import power_rows
from nerg_mi.measures.tables import (
    MEASURED,
    PREDICTED,
    MinParticipantsFilter,
    ParticipantRows,
    Participants,
    Row,
    aoi_rows,
    difference_rows,
    duration_rows,
    transition_rows,
)
from nerg_mi.measures.visits import ALL, Cell, Total, VisitSums
from nerg_mi.options import parse_point
from nerg_mi.progress import SILENT, Reporter
from nerg_mi.rays.pseudonyms import make_pseudonyms, read_salt
from nerg_mi.rays.rays import TRACKING, Rays

from .base import select_backend
from .parts import PartRunner
from .statistics_parts import PartitionedStatistics


@dataclass(frozen=True)
class _InputFiles:
    """Input files by their kind."""

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
    """Compute attention statistics for the AOIs of ``options``.

    ``files`` are, in any order, rays or a dataset, a scene, a gaze field and a radiance field; the scene of a gaze
    field is looked up next to it. ``output`` is the folder for tables; None writes nothing. Raises `NergError`.
    """
    options = options or StatisticsOptions()
    if output is not None:
        check_folder(output)
    input_files = _sort(files)
    reporter.progress(0.0, "reading")
    areas = _areas(options)
    ns = select_backend(options.mode, options.threads)
    result = _StatisticsWork(input_files, areas, options, ns, reporter, output).run()
    if output is not None:
        geometry_options = (input_files.scene, input_files.field, input_files.gaze, input_files.rays)
        inputs = [path for path in geometry_options if isinstance(path, Path)]
        inputs += [p for p in (options.aois, options.what_if) if p is not None and p.is_file()]
        result.files.extend(write_results(make_folder(output), result, inputs, options, reporter))
    return result


def _sort(files: Sequence[str | Path | Rays]) -> _InputFiles:
    by_kind: dict[str, Path | Rays] = {}
    for file in files:
        path = file if isinstance(file, Rays) else Path(file)
        if not isinstance(path, Rays) and path.suffix.lower() in (".json", ".csv"):
            raise NergError(f'"{path}" is not rays, a scene or a field; AOIs are given with {parameter("aois")}')
        kind = "rays" if isinstance(path, Rays) else detect_kind(path)
        if kind not in ("scene", "field", "gaze", "rays"):
            raise NergError(f'"{path}" is a {kind}; give rays, a scene (.xml), a gaze field and a radiance field')
        if kind in by_kind:
            raise NergError(f'"{by_kind[kind]}" and "{path}" are both a {kind}; give one')
        by_kind[kind] = path
    if not by_kind:
        raise NergError("there is no input; give rays, a scene, or a gaze field")
    return _InputFiles(**by_kind)  # pyright: ignore[reportArgumentType]


def _areas(options: StatisticsOptions) -> AreaSet:
    if options.aois is None:
        raise NergError(f"no AOIs are given; add {parameter('aois', 'FILE')}")
    return read_areas(options.aois)


class _StatisticsWork:
    """Computes the statistics, with shared scene, AOIs and options."""

    def __init__(
        self,
        inputs: _InputFiles,
        areas: AreaSet,
        options: StatisticsOptions,
        ns: ModuleType,
        reporter: Reporter,
        output: str | Path | None,
    ):
        self.inputs, self.areas, self.options, self.reporter = inputs, areas, options, reporter
        self.setting = load_aoi_scene(inputs.scene, inputs.field, inputs.gaze, areas, options, ns)
        self.around, self.aois, self.members = self.setting.gaze_scene, self.setting.aois, self.setting.members
        for note in self.setting.warnings:
            reporter.message(note)
        if options.what_if is not None and self.around.gaze is None:
            raise NergError(f"{parameter('what_if')} needs a gaze field; give one, or a scene that has one")
        if options.power is not None and inputs.rays is None:
            raise NergError(f"{parameter('power')} needs recorded participants; give rays")
        if options.what_if is not None:
            # Errors in the file are reported before anything is counted.
            read_changes(options.what_if)
        self.parts = self._in_parts(output) if options.in_parts else None

    def run(self) -> StatisticsResult:
        """Compute all statistics."""
        o, floor = self.options, MinParticipantsFilter(self.options.min_participants)
        counting = None if self.inputs.rays is None else self._counting(self.inputs.rays)
        sums, viewpoints = (None, self._untracked_viewpoints()) if counting is None else self._count(counting)
        if counting is None and self.around.gaze is None:
            raise NergError("there are no observers: give rays or a gaze field")
        cells = [ALL] if counting is None else list(sums.cells) if sums is not None else []
        seen = counting is not None and counting.visibility_cache is not None
        people: dict[Cell, dict[str, Participants]] = {cell: {} for cell in cells}
        times: dict[Cell, dict[str, float]] = {cell: {} for cell in cells}
        for cell in cells:
            if sums is not None:
                people[cell][MEASURED] = tracked = Participants.from_sums(sums, cell, seen)
                times[cell] = dict(zip(tracked.names, tracked.time.tolist()))
            else:
                times[cell] = dict.fromkeys(viewpoints.participants, 1.0)
        predicted = None
        if self.around.gaze is not None:
            predicted = self._predict(viewpoints)
            warn_missing_support(predicted, self.reporter)
            for cell in cells:
                statistics = aggregate_by_participant(predicted, viewpoints, cell, times[cell], o.glance_duration)
                if statistics is not None:
                    people[cell][PREDICTED] = statistics
        self._report_small_groups(people)
        names = self.areas.names
        self.reporter.progress(0.9, "confidence intervals")
        rows = aoi_rows(names, people, floor, resamples=o.resamples, seed=o.seed)
        if predicted is not None:
            add_uncertainty(rows, predicted, viewpoints, times, o.glance_duration)
        source = MEASURED if sums is not None else PREDICTED
        power = []
        if o.power is not None:
            self.reporter.progress(0.95, "power of differences")
            power = power_rows(names, people, floor, o.power, seed=o.seed)
        result = StatisticsResult(
            aois=rows,
            differences=difference_rows(names, people, floor, source=source, resamples=o.resamples, seed=o.seed),
            power=power,
            transitions=[] if sums is None else transition_rows(sums, floor),
            durations=[] if sums is None else duration_rows(sums, floor),
            participants=self._people(sums, seen),
            what_if=[] if o.what_if is None else self._what_if(viewpoints, predicted, floor),
            sums=sums,
            num_suppressed=floor.num_suppressed,
        )
        if floor.num_suppressed:
            self.reporter.message(
                f"{floor.num_suppressed:,} numbers rest on fewer than {floor.minimum} participants and are blank"
            )
        return result

    def _counting(self, rays: Path | Rays) -> AoiContext:
        first = next(iter_blocks(rays, self.options.visit_rules()))
        hits = self.around.geometry is None and first.hit is not None and bool(np.isfinite(first.hit).any())
        if first.tracking in ("head", "mixed"):
            self.reporter.message(f"the rays are {TRACKING[first.tracking]}: numbers are those of heads, not of eyes")
        if self.around.geometry is None:
            self.reporter.message(
                "no scene is given: rays end at their hit points"
                if hits
                else "no scene is given: AOIs occlude each other, and nothing else does"
            )
        return self.setting.make_context(hits, list_cohorts(rays, first))

    def _count(self, counting: AoiContext) -> tuple[VisitSums, Viewpoints]:
        assert self.inputs.rays is not None
        count = count_rays(self.inputs.rays)
        picker = ViewpointSampler(max(1, count // self.options.viewpoints))
        total: Total | None = None

        def pick(block: Rays) -> None:
            picker.add(block, counting)

        seen = None if self.around.gaze is None else pick
        if self.parts is None:
            arriving = self._count_blocks(self.inputs.rays, counting, seen, count)
        else:
            arriving = self.parts.count(self.inputs.rays, counting, seen)
        for part in arriving:
            total = total or Total(part.areas, part.cells)
            total.add(part)
        if total is None:
            raise NergError("there are no rays; import some")
        sums = total.sums()
        self.reporter.message(f"{count:,} rays of {len(sums.find_participants(ALL)[0]):,} participants")
        if self.around.gaze is None:
            return sums, Viewpoints(np.zeros((0, 3)), np.zeros((0, 3)), (), ())
        viewpoints = subsample_participants(picker.viewpoints(), self.options.viewpoints, self.reporter)
        warn_few_viewpoints(viewpoints, self.reporter)
        return sums, viewpoints

    def _count_blocks(
        self, rays: Rays | Path, counting: AoiContext, seen: Callable[[Rays], None] | None, count: int
    ) -> Iterator[VisitSums]:
        """Yield the sums of each block, computed in this process."""
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
        g, o = self.inputs, self.options
        if output is None and o.store is None:
            raise NergError(
                f"parts need a folder; name one with {parameter('store')}, or give an output next to which it is "
                "created"
            )
        import mitsuba as mi

        name = Path(output or o.store or "")
        parts = PartRunner(o, name, self.reporter, o.threads)
        what = f"nerg stats {name.absolute()}"
        return PartitionedStatistics(parts, what, g.scene, g.field, g.gaze, self.areas, o, str(mi.variant()))

    def _untracked_viewpoints(self) -> Viewpoints:
        """Return observers without tracking."""
        o = self.options
        if o.observers:
            return viewpoints_at(np.array([parse_point(text, parameter("observers")) for text in o.observers]))
        if self.around.observer is not None:
            return viewpoints_at(self.around.observer[None])
        positions = place_observers_on_floor(self.around, o.eye_height, o.grid_step, o.floor_height)
        every = max(1, len(positions) // o.viewpoints)
        self.reporter.message(
            f"there is no tracking: {len(positions[::every])} positions on the floor, each for one observer"
        )
        return viewpoints_at(positions[::every])

    @property
    def _view(self) -> float:
        """Width of the field of view in degrees: 360 without rays, because orientations are unknown."""
        return self.options.fov if self.inputs.rays is not None else 360.0

    def _predict(self, viewpoints: Viewpoints) -> PredictedAttention:
        """Return the attention that the field predicts at these viewpoints."""
        note = self.around.describe_extrapolation(viewpoints.positions)
        if note:
            self.reporter.warn(note)
        if self.parts is None:
            predicted = self.setting.predict(viewpoints, self._view, self.reporter)
        else:
            predicted = self.parts.predict(viewpoints, self._view)
        return replace(predicted, note=note)

    def _what_if(
        self, viewpoints: Viewpoints, before: PredictedAttention | None, floor: MinParticipantsFilter
    ) -> list[Row]:
        o, parts = self.options, self.parts
        assert o.what_if is not None and before is not None

        def predict(scene: AoiScene, changed_viewpoints: Viewpoints) -> PredictedAttention:
            for note in scene.warnings[len(self.setting.warnings) :]:
                self.reporter.message(note)
            if parts is None:
                return scene.predict(changed_viewpoints, self._view, self.reporter)
            return parts.predict(changed_viewpoints, self._view, o.what_if)

        return what_if_rows(o.what_if, self.setting, viewpoints, before, predict, floor, o.resamples, o.seed)

    def _people(self, sums: VisitSums | None, seen: bool) -> Sequence[Row]:
        o = self.options
        if sums is None:
            return ()
        if o.min_participants > 1:
            self.reporter.message(
                "no table of participants is written, because each of its numbers would rest on one participant"
            )
            return ()
        persons = sums.find_participants(ALL)[1]
        named = {p: p for p in persons}
        if not o.show_names:
            named = make_pseudonyms(persons, None if o.salt is None else read_salt(o.salt))
        return ParticipantRows(sums, named, seen)

    def _report_small_groups(self, people: Mapping[Cell, Mapping[str, Participants]]) -> None:
        for cell in (c for c, by_source in people.items() if MEASURED in by_source and not by_source[MEASURED].names):
            self.reporter.message(
                f"there are no participants in the {cell.dimension} {cell.value}; time windows are on the rays' clock"
            )
        few = [
            cell
            for cell, by_source in people.items()
            for p in by_source.values()
            if 0 < p.is_in_cell.sum() < MIN_PARTICIPANTS
        ]
        if few:
            which = "the whole recording" if few[0] == ALL else f"{few[0].dimension} {few[0].value}"
            self.reporter.message(
                f"there are no confidence intervals for fewer than {MIN_PARTICIPANTS} participants ({which}"
                + (f" and {len(set(few)) - 1} more)" if len(set(few)) > 1 else ")")
            )
