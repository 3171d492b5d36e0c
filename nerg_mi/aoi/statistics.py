"""Attention statistics of AOIs: measured, predicted by a gaze field, by cohort, time and zone, and what-if changes."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike

from nerg_mi.environment.environment import Environment
from nerg_mi.environment.gaze import GazeField
from nerg_mi.environment.inputs import Inputs, sort_inputs
from nerg_mi.environment.scene_loading import activate_mitsuba
from nerg_mi.errors import NergError, parameter, sanitize
from nerg_mi.figures.style import changed_arguments, existing_files, make_provenance
from nerg_mi.files.values import FilePath, to_numbers, to_path
from nerg_mi.formats.alignments import AnySimilarity, open_similarity
from nerg_mi.interruption import Interruption
from nerg_mi.maths.coordinates import check_coordinates
from nerg_mi.progress import Progress, Reporter, open_reporter
from nerg_mi.ranges import SECONDS, SEEDS, TIMES, Range, check_ranges
from nerg_mi.tasks.parts import PartRunner
from nerg_mi.tasks.settings import Parallel
from nerg_mi.tracking.dataset import RayDataset, open_recordings
from nerg_mi.tracking.event_settings import EventRules, read_fixations
from nerg_mi.tracking.events import describe_slow_sampling, label_fixations
from nerg_mi.tracking.objects import ObjectPoses
from nerg_mi.tracking.pseudonyms import make_pseudonyms, read_salt
from nerg_mi.tracking.rays import TRACKING, Rays
from nerg_mi.transport.observer import sensor_center

from .areas import AnyAreas, AreaGroup, Areas, to_json_values
from .changes import open_changes
from .estimates import MIN_FOR_INTERVAL
from .measured import AoiContext, Counting, TimeWindow, count_block, iter_blocks
from .moving import check_objects
from .output import StatisticsResult, has_parquet
from .placed import PlacedAreas, open_placed_areas
from .power import power_rows
from .predicted import (
    PredictedAttention,
    Viewpoints,
    ViewpointSampler,
    add_uncertainty,
    aggregate_by_participant,
    place_observers_on_floor,
    predict_attention,
    subsample_participants,
    viewpoints_at,
    warn_few_viewpoints,
    warn_missing_support,
    what_if_rows,
)
from .settings import AoiSampling, ObserverGrid, TrackerError, VisitRules
from .statistics_parts import PartitionedStatistics, save_objects
from .tables import (
    MAX_COMPARED_VALUES,
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
from .tracker_error import LEVELS, describe_tracker_fixations, resolution_rows, tracker_rows
from .visits import ALL, Cell, VisitSums, merge_sums


@check_ranges
def statistics(
    inputs: Sequence[FilePath | Any] | FilePath | Any,
    aois: FilePath | AnyAreas | None = None,
    *,
    align: FilePath | AnySimilarity | None = None,
    cohorts: FilePath | None = None,
    validation: FilePath | None = None,
    windows: Mapping[str, Sequence[float]] | None = None,
    zones: FilePath | AnyAreas | None = None,
    objects: FilePath | ObjectPoses | None = None,
    pose_gap: Annotated[float, SECONDS] | None = None,
    clock_offset: Annotated[float, TIMES] = 0.0,
    what_if: FilePath | Mapping[str, Any] | None = None,
    observers: ArrayLike | None = None,
    viewpoints: Annotated[int, Range(1, 100_000)] = 256,
    aoi_visibility: bool = False,
    fov: Annotated[float, Range(1, 360)] = 120.0,
    resamples: Annotated[int, Range(199, 100_000)] = 1999,
    power: Annotated[float, Range(0.01, 100)] | None = None,
    seed: Annotated[int, SEEDS] = 0,
    min_participants: Annotated[int, Range(1, 10**6)] = 1,
    show_names: bool = False,
    salt: FilePath | None = None,
    rules: VisitRules = VisitRules(),
    error: TrackerError = TrackerError(),
    sampling: AoiSampling = AoiSampling(),
    grid: ObserverGrid = ObserverGrid(),
    parallel: Parallel = Parallel(),
    progress: Progress = None,
) -> StatisticsResult:
    """Compute attention statistics of areas of interest (AOIs): measured from rays, and predicted by a gaze field.

    Reports attention share, dwell time, hit ratio, time to first visit, revisits, viewing distance and visibility, by
    cohort, time window and zone; differences between AOIs, transitions, and the effect of changes to the scene.
    Confidence intervals take participants as the sampling unit.

    Parameters
    ----------
    inputs : object, path or sequence of these
        Rays or a dataset, an environment and a gaze field, in any order.
    aois : Areas, path or mapping
        JSON file of areas of interest (AOIs): boxes, meshes, shapes of the scene, and groups of them; or a folder of
        Aria Digital Twin. Areas in memory are boxes (two corners), meshes of trimesh or dicts as in the file, by name.
    align : path or similarity, optional
        JSON file with the 4x4 similarity from the frame of the rays to that of the scene, as nerg align writes it.
        Default: the alignment of the gaze field, or of an environment in memory.
    cohorts : path, optional
        CSV file with columns person,cohort; attention is reported separately for each cohort. Default: the cohorts in
        the rays.
    validation : path, optional
        Table with columns person,accuracy,precision in degrees, or one of Tobii Pro Lab, Titta, glassesValidator or
        ETDQualitizer: the errors of the eye tracker by participant, which replace accuracy and precision. A column
        start, in seconds of the rays' clock, tells sessions apart.
    windows : mapping, optional
        Start and end of a time window by its name, NAME=FROM,TO in seconds of the rays' clock; attention is reported
        separately in it; repeatable.
    zones : Areas, path or mapping, optional
        JSON file of boxes on the floor; attention is reported separately for observers in each box.
    objects : ObjectPoses or path, optional
        Table with columns time,object,x,y,z,qw,qx,qy,qz (`nerg_mi.tracking.objects`): poses of shapes and areas that
        move, in the frame of the rays; without x,y,z an object is absent. Predictions ignore them.
    pose_gap : float, optional
        Longest time in seconds over which poses of objects are interpolated, or continued before the first and after
        the last one. Default: 1, or as in poses in memory.
    clock_offset : float
        Seconds that are added to the times of the poses of objects, if their clock is not that of the rays.
    what_if : path or mapping, optional
        JSON file of changes to shapes and observers; the gaze field predicts their effect.
    observers : array_like of shape (M, 3), optional
        Position x,y,z of an observer, where there are no rays; repeatable. Default: the observer of the scene, or a
        grid on the floor.
    viewpoints : int
        Approximate number of viewpoints from which the gaze field is evaluated: recorded positions, or positions on the
        floor if there are no recordings. Each participant gets at least one. If there are more participants than this
        number, the prediction uses that many of them.
    aoi_visibility : bool
        Also report the visibility of AOIs: visible share of each AOI, attention while it is visible, and visible but
        unseen AOIs.
    fov : float
        Width of the field of view in degrees, centred on the head direction, or on the gaze if there is none.
    resamples : int
        Number of bootstrap resamples of the participants for confidence intervals.
    power : float, optional
        Relative difference between two cells, such as 0.3 for 30 %. The table `power` then reports how often the test
        of differences detects it, by number of participants. Default: no table.
    seed : int
        Seed of the random numbers for bootstrap resamples.
    min_participants : int
        Smallest number of participants that a reported number may rest on; other numbers are left blank.
    show_names : bool
        Write the names of participants into the tables. Without it, they get pseudonyms.
    salt : path, optional
        Secret file from which pseudonyms are derived, so that several runs agree. Default: random, not stored.
    rules : VisitRules
        Durations that define a visit (`nerg_mi.aoi.settings.VisitRules`).
    error : TrackerError
        Error of the eye tracker (`nerg_mi.aoi.settings.TrackerError`).
    sampling : AoiSampling
        How rays are assigned to AOIs, and how the gaze field is sampled (`nerg_mi.aoi.settings.AoiSampling`).
    grid : ObserverGrid
        Positions on the floor without recordings (`nerg_mi.aoi.settings.ObserverGrid`).
    parallel : Parallel
        Where parts run (`nerg_mi.tasks.settings.Parallel`). The tables are the same.
    progress : bool, Reporter or None
        Progress and messages (`nerg_mi.progress.Progress`).

    Returns
    -------
    StatisticsResult
        Tables as lists of dicts, with methods ``to_dataframe`` and ``save`` (a folder of tables and figures).

    Raises
    ------
    NergError
        An argument or a file is invalid.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> eye, ahead = [[0.0, 0.0, 1.6]] * 3, [[1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    >>> rays = nerg.Rays.from_arrays(eye, ahead, times=[0.0, 0.2, 0.4])
    >>> row = nerg.statistics(rays, {"shelf": [[2, -1, 0], [3, 1, 2]]}).aois[0]
    >>> row["aoi"], round(row["share"], 3), row["hit_ratio"], row["distance"]
    ('shelf', 0.667, 1.0, 2.0)
    """
    changed = changed_arguments(statistics, locals())
    if aois is None:
        raise NergError(f"no AOIs are given; add {parameter('aois', 'FILE')}")
    mode = str(activate_mitsuba().variant())
    chosen, align = open_inputs(inputs, align)
    areas = Areas.open(aois, "aois")
    zones = to_json_values(zones) if isinstance(zones, Mapping) else zones
    what_if = to_json_values(what_if) if isinstance(what_if, Mapping) else what_if
    if align is not None and not isinstance(align, (str, os.PathLike)):
        align = open_similarity(align, "rays to scene").matrix.tolist()
    eyes = None if observers is None else _check_observers(observers)
    poses = _open_poses(objects, pose_gap, clock_offset)
    plain_counting = Counting(rules, aoi_visibility=aoi_visibility, fov=fov, error=error, objects=poses)
    counting, counting_files = open_counting(plain_counting, windows, zones, cohorts, validation)
    files = [*existing_files(*chosen, *areas.files, what_if, align, objects), *counting_files]
    plain = {
        "aois": areas.path or (str(aois) if isinstance(aois, (str, os.PathLike)) else None),
        "zones": zones.path if isinstance(zones, Areas) else zones,
        "what_if": what_if,
        "align": align,
    }
    plain["observers"] = None if eyes is None else eyes.tolist()
    changed |= {"mode": mode} | {name: value for name, value in plain.items() if value is not None}
    with open_reporter(progress) as reporter:
        reporter.progress(0.0, "reading")
        with _open_parts(chosen, areas, align, sampling, parallel, reporter) as parts:
            work = AttentionAnalysis(
                open_placed_areas(chosen.environment, chosen.gaze, areas, align, sampling),
                None if chosen.rays is None else open_recordings(chosen.rays),
                counting,
                parts,
                MinParticipantsFilter(min_participants),
                resamples,
                seed,
                reporter,
            )
            work.check(what_if, power)
            # Errors in changes are reported before anything is counted.
            changes = None if what_if is None else open_changes(what_if)
            files += [] if changes is None else changes.meshes
            changed |= {} if work.rays is None else read_fixations(work.rays.metadata)
            changed |= describe_tracker_fixations(error)
            attention = work.measure(viewpoints, eyes, grid)
            result = work.make_tables(attention, power, show_names, salt)
            if changes is not None and attention.predicted is not None:
                predict = lambda placed, viewpoints: work.predict(placed, viewpoints, what_if)
                rows = what_if_rows(
                    changes,
                    work.placed,
                    attention.viewpoints,
                    attention.predicted,
                    predict,
                    work.suppression,
                    resamples,
                    seed,
                )
                result = replace(result, what_if=rows)
        if num_suppressed := work.suppression.num_suppressed:
            reporter.message(
                f"{num_suppressed:,} numbers rest on fewer than {min_participants} participants and are blank"
            )
        if not has_parquet():
            reporter.message(
                "tables are not saved as Parquet, because pyarrow is missing: pip install 'nerg-mi[parquet]'"
            )
    provenance = make_provenance("nerg stats", files, seed, changed)
    return replace(result, num_suppressed=num_suppressed, provenance=provenance)


def open_counting(
    counting: Counting,
    windows: Mapping[str, Sequence[float]] | None,
    zones: FilePath | AnyAreas | None,
    cohorts: FilePath | None,
    validation: FilePath | None,
) -> tuple[Counting, list[Path]]:
    """Return ``counting`` with these time windows, zones, cohorts and errors, and the files that they are in."""
    opened = None
    if zones is not None:
        opened = Areas.open(to_json_values(zones) if isinstance(zones, Mapping) else zones, "zones")
    counting = replace(
        counting,
        windows=_make_windows(windows or {}),
        zones=() if opened is None else tuple(Areas.open_boxes(opened, "zones")),
        cohorts=None if cohorts is None else to_path(cohorts),
        validation=None if validation is None else to_path(validation),
    )
    return counting, existing_files(cohorts, validation, *(() if opened is None else opened.files))


def warn_unused_fixation_part(counting: Counting, rays: Rays | RayDataset | None, reporter: Reporter) -> None:
    """Warn if the part of the tracker's offset that changes between fixations has no effect, or changes between
    samples, since ``rays`` have no fixations."""
    if not counting.error.fixation_part > 0:
        return
    part = parameter("fixation_part", f"{counting.error.fixation_part:g}")
    if not counting.has_error:
        reporter.warn(
            f"{part} has no effect, because no error of the tracker is given: add {parameter('accuracy')} or "
            f"{parameter('validation')}"
        )
    elif rays is None:
        reporter.warn(f"{part} has no effect, because predictions depend on the sum of all errors")
    elif not read_fixations(rays.metadata).get("fixations", {}).get("one_ray"):  # each of which is a fixation
        first = None
        for block in iter_blocks(rays, counting.rules):
            if (label_fixations(block)[0] >= 0).any():
                return
            first = first or block
        assert first is not None
        reason = describe_slow_sampling(first, EventRules()) or "gaze never rests"
        reporter.warn(
            f"{part} makes offsets that change with each sample, because the rays have no fixations: {reason}; leave "
            "it out, or give rays of fixations"
        )


def _open_poses(
    objects: FilePath | ObjectPoses | None, pose_gap: float | None, clock_offset: float
) -> ObjectPoses | None:
    if objects is None:
        if pose_gap is not None or clock_offset:
            raise NergError(
                f"{parameter('pose_gap')} and {parameter('clock_offset')} are for poses of objects; add "
                f"{parameter('objects', 'FILE')}"
            )
        return None
    poses = ObjectPoses.open(objects).shift(clock_offset)
    return poses if pose_gap is None else replace(poses, max_gap=pose_gap)


def _make_windows(windows: Mapping[str, Sequence[float]]) -> tuple[TimeWindow, ...]:
    made = []
    for name, values in windows.items():
        ends = to_numbers(values, f"the time window {name!r}").ravel().tolist()
        if not str(name).strip() or len(ends) != 2 or not TIMES.low <= ends[0] < ends[1] <= TIMES.high:
            pair = f"{name}={','.join(f'{end:g}' for end in ends)}"
            raise NergError(
                f"{parameter('windows')} must be NAME=FROM,TO in seconds, as in morning=0,3600, got "
                f'"{sanitize(pair, 60)}"'
            )
        made.append(TimeWindow(str(name).strip(), *ends))
    return tuple(made)


def _check_observers(observers: ArrayLike) -> np.ndarray:
    """Return positions (M, 3) of observers."""
    positions = to_numbers(observers, parameter("observers"))
    if positions.ndim != 2 or positions.shape[1] != 3 or not len(positions):
        raise NergError(f"{parameter('observers')} must be x,y,z or rows of these, got {sanitize(observers, 60)}")
    check_coordinates(positions, parameter("observers"))
    return positions


# ---- Inputs ----


def list_inputs(inputs: Any) -> list[Any]:
    """Return one or several inputs as a list. Raises `NergError` for files that are none."""
    items = list(inputs) if isinstance(inputs, (list, tuple)) else [inputs]
    for item in items:
        if isinstance(item, (str, os.PathLike)) and Path(item).suffix.lower() in (".json", ".csv"):
            raise NergError(f'"{item}" is not rays, a scene or a field; AOIs are given with {parameter("aois")}')
    return items


def open_inputs(inputs: Any, align: Any) -> tuple[Inputs, Any]:
    """Return the inputs by their roles, as files where they have one, and ``align`` or that of an environment in
    memory. A gaze field without a file brings the environment of its training."""
    chosen = sort_inputs(list_inputs(inputs))
    if all(value is None for value in chosen):
        raise NergError("there is no input; give rays, a scene, or a gaze field")
    environment = chosen.environment
    if align is None and chosen.gaze is None and isinstance(environment, Environment):
        align = None if environment.align.is_identity else environment.align
    chosen = chosen.prefer_files()
    if chosen.environment is None and isinstance(chosen.gaze, GazeField) and chosen.gaze.environment is not None:
        # Its file may be elsewhere than the gaze field.
        chosen = chosen._replace(environment=chosen.gaze.environment.path)
    return chosen, align


@contextmanager
def _open_parts(
    chosen: Inputs, areas: Areas, align: Any, sampling: AoiSampling, parallel: Parallel, reporter: Reporter
) -> Iterator[PartitionedStatistics | None]:
    """Yield what computes parts; None if ``parallel`` has none. Files of objects exist within the context."""
    if not parallel.in_parts:
        yield None
        return
    runner = PartRunner(parallel, None, reporter)
    with runner.store.make_scratch_folder() as folder:
        environment, gaze = save_objects(chosen.environment, chosen.gaze, folder)
        job = f"nerg stats {runner.store.folder.absolute()}"
        align = Path(align) if isinstance(align, (str, os.PathLike)) else align
        yield PartitionedStatistics(runner, job, environment, gaze, areas, align, sampling)


# ---- Steps ----


@dataclass(frozen=True, eq=False)
class MeasuredAttention:
    """Attention of participants by cell and source: ``sums`` of recordings, all sums with those of
    ``disturbed`` samples, and what a gaze field predicts from ``viewpoints``, with the recorded ``times`` of
    participants."""

    sums: VisitSums | None
    disturbed: VisitSums | None
    viewpoints: Viewpoints
    predicted: PredictedAttention | None
    people: Mapping[Cell, Mapping[str, Participants]]
    times: Mapping[Cell, dict[str, float]]


@dataclass(frozen=True, eq=False)
class AttentionAnalysis:
    """Computes the statistics; ``parts`` is None if all is computed in this process."""

    placed: PlacedAreas
    rays: Rays | RayDataset | None
    counting: Counting
    parts: PartitionedStatistics | None
    suppression: MinParticipantsFilter
    resamples: int
    seed: int
    reporter: Reporter

    def check(self, what_if: Any, power: float | None) -> None:
        """Report notes on the inputs. Raise `NergError` if they lack what is requested."""
        for note in self.placed.warnings:
            self.reporter.message(note)
        if what_if is not None and self.placed.sampler is None:
            raise NergError(f"{parameter('what_if')} needs a gaze field; give one, or a scene that has one")
        if power is not None and self.rays is None:
            raise NergError(f"{parameter('power')} needs recorded participants; give rays")
        if self.counting.objects is not None and self.placed.sampler is not None:
            self.reporter.message("predictions of the gaze field are those of the environment without motion")
        if self.counting.objects is not None and self.rays is None:
            raise NergError(f"{parameter('objects')} are poses at the times of rays; give rays")
        if self.rays is None and self.placed.sampler is None:
            raise NergError("there are no observers: give rays or a gaze field")
        if self.rays is not None:
            self.counting.disturbance.check_participants(self.rays.persons, self.reporter)
        warn_unused_fixation_part(self.counting, self.rays, self.reporter)

    def measure(self, num_viewpoints: int, observers: np.ndarray | None, grid: ObserverGrid) -> MeasuredAttention:
        """Count visits, and predict the attention from recorded positions or those of observers."""
        people: dict[Cell, dict[str, Participants]] = {ALL: {}}
        times: dict[Cell, dict[str, float]] = {}
        disturbed = None
        if self.rays is not None:
            counted, viewpoints = self._count(self.rays, num_viewpoints)
            sums = counted.select_draw(0)
            disturbed = counted if self.counting.has_error else None
            for cell in sums.cells:
                tracked = Participants.from_sums(sums, cell, self.counting.aoi_visibility)
                people[cell] = {MEASURED: tracked}
                times[cell] = dict(zip(tracked.names, tracked.time.tolist()))
        else:
            sums, viewpoints = None, self._place_viewpoints(num_viewpoints, observers, grid)
            times[ALL] = dict.fromkeys(viewpoints.participants, 1.0)
        predicted = None
        if self.placed.sampler is not None:
            predicted = self.predict(self.placed, viewpoints)
            warn_missing_support(predicted, self.reporter)
            duration = self.placed.sampling.glance_duration
            for cell, cell_times in times.items():
                predicted_people = aggregate_by_participant(predicted, viewpoints, cell, cell_times, duration)
                if predicted_people is not None:
                    people[cell][PREDICTED] = predicted_people
        _report_small_groups(people, self.reporter)
        return MeasuredAttention(sums, disturbed, viewpoints, predicted, people, times)

    def _count(self, rays: Rays | RayDataset, num_viewpoints: int) -> tuple[VisitSums, Viewpoints]:
        context, count = self._make_context(rays), len(rays)
        picker = ViewpointSampler(max(1, count // num_viewpoints))
        if context.moving is not None:
            check_objects(context.moving, iter_blocks(rays, self.counting.rules), self.reporter)
        has_gaze = self.placed.sampler is not None
        picks = has_gaze or self.counting.has_error
        on_block = (lambda block: picker.add(block, context)) if picks else None
        count_blocks = self._count_blocks if self.parts is None else self.parts.count
        sums = merge_sums(count_blocks(rays, context, on_block))
        self.reporter.message(f"{count:,} rays of {len(sums.find_participants(ALL)[0]):,} participants")
        viewpoints = picker.viewpoints()
        if has_gaze:
            viewpoints = subsample_participants(viewpoints, num_viewpoints, self.reporter)
            warn_few_viewpoints(viewpoints, self.reporter)
        return sums, viewpoints

    def _make_context(self, rays: Rays | RayDataset) -> AoiContext:
        # A dataset may be larger than the memory: its first block decides.
        first = rays if isinstance(rays, Rays) else next(iter_blocks(rays, self.counting.rules))
        has_surfaces = self.placed.environment.has_surfaces
        hits = not has_surfaces and first.hit is not None and bool(np.isfinite(first.hit).any())
        if first.tracking in ("head", "mixed"):
            self.reporter.message(f"the rays are {TRACKING[first.tracking]}: numbers are those of heads, not of eyes")
        if not has_surfaces:
            self.reporter.message(
                "no scene is given: rays end at their hit points"
                if hits
                else "no scene is given: AOIs occlude each other, and nothing else does"
            )
        return AoiContext(self.placed, self.counting, hits, tuple(sorted(rays.cohorts)))

    def _count_blocks(
        self, rays: Rays | RayDataset, context: AoiContext, on_block: Callable[[Rays], None] | None
    ) -> Iterator[VisitSums]:
        """Yield the sums of each block, computed in this process, and call ``on_block`` with it."""
        done, count = 0, len(rays)
        with Interruption() as stop:
            for block in iter_blocks(rays, self.counting.rules):
                yield count_block(block, context)
                if on_block is not None:
                    on_block(block)
                done += len(block)
                self.reporter.progress(0.8 * done / count, f"{done:,} of {count:,} rays")
                stop.check()

    def _place_viewpoints(self, num_viewpoints: int, observers: np.ndarray | None, grid: ObserverGrid) -> Viewpoints:
        """Return viewpoints without tracking."""
        nerg = self.placed.environment.nerg
        if observers is not None:
            return viewpoints_at(observers)
        if nerg is not None and nerg.observer is not None:
            return viewpoints_at(np.array(sensor_center(nerg.observer), np.float64).reshape(1, 3))
        positions = place_observers_on_floor(self.placed, grid)
        every = max(1, len(positions) // num_viewpoints)
        self.reporter.message(
            f"there is no tracking: {len(positions[::every])} positions on the floor, each for one observer"
        )
        return viewpoints_at(positions[::every])

    def predict(self, placed: PlacedAreas, viewpoints: Viewpoints, what_if: Any = None) -> PredictedAttention:
        """Return the attention that the field predicts from ``viewpoints`` for ``placed``, the areas after the changes
        ``what_if``."""
        assert placed.sampler is not None
        for note in placed.warnings[len(self.placed.warnings) :]:
            self.reporter.message(note)
        note = placed.sampler.describe_extrapolation(viewpoints.positions)
        if note and what_if is None:
            self.reporter.warn(note)
        # Without rays, orientations are unknown.
        fov = self.counting.fov if self.rays is not None else 360.0
        sigma = self.counting.disturbance.sigma if self.counting.has_error else 0.0
        if self.parts is None:
            predicted = predict_attention(placed, viewpoints, fov, self.reporter, sigma=sigma)
        else:
            predicted = self.parts.predict(viewpoints, fov, what_if, sigma=sigma)
        return replace(predicted, note=note)

    def make_tables(
        self, attention: MeasuredAttention, power: float | None, show_names: bool, salt: FilePath | None
    ) -> StatisticsResult:
        """Return all tables except that of changes."""
        sums, people, suppression, seed = attention.sums, attention.people, self.suppression, self.seed
        names = self.placed.areas.names
        self.reporter.progress(0.9, "confidence intervals")
        rows = aoi_rows(names, people, suppression, resamples=self.resamples, seed=seed)
        if attention.predicted is not None:
            duration = self.placed.sampling.glance_duration
            add_uncertainty(rows, attention.predicted, attention.viewpoints, attention.times, duration)
        power_table = []
        if power is not None:
            self.reporter.progress(0.95, "power of differences")
            power_table = power_rows(names, people, suppression, power, seed=seed)
        report_values_without_comparison(people, MAX_COMPARED_VALUES, self.reporter)
        differences = difference_rows(names, people, suppression, resamples=self.resamples, seed=seed)
        recorded: dict[str, Any] = {}
        if self.counting.has_error:
            recorded |= self._make_tracker_tables(attention)
        if sums is not None:
            recorded |= {
                "transitions": transition_rows(sums, suppression),
                "durations": duration_rows(sums, suppression),
            }
            recorded["participants"] = self._list_participants(sums, show_names, salt)
        groups = [area.name for area in self.placed.areas.areas if isinstance(area, AreaGroup)]
        tables = {"aois": rows, "differences": differences, "power": power_table}
        return StatisticsResult(**tables, **recorded, sums=sums, groups=groups)

    def _make_tracker_tables(self, attention: MeasuredAttention) -> dict[str, list[Row]]:
        """Return the tables of the tracker's error."""
        self.reporter.progress(0.97, "error of the tracker")
        error, disturbance = self.counting.error, self.counting.disturbance
        people: dict[Cell, dict[str, list[Participants]]] = {}
        if (sums := attention.disturbed) is not None:
            for of_draw in map(sums.select_draw, range(len(LEVELS) * error.draws + 1)):
                for cell in of_draw.cells:
                    of_cell = Participants.from_sums(of_draw, cell, has_visibility=False)
                    people.setdefault(cell, {}).setdefault(MEASURED, []).append(of_cell)
        if (predicted := attention.predicted) is not None and predicted.disturbed is not None:
            for cell, times in attention.times.items():
                for share in (predicted.share, *predicted.disturbed):
                    level, duration = replace(predicted, share=share), self.placed.sampling.glance_duration
                    of_cell = aggregate_by_participant(level, attention.viewpoints, cell, times, duration)
                    if of_cell is not None:
                        people.setdefault(cell, {}).setdefault(PREDICTED, []).append(of_cell)
        names = self.placed.areas.names
        corrected = tracker_rows(names, people, self.suppression, resamples=self.resamples, seed=self.seed)
        too_small = resolution_rows(self.placed, attention.viewpoints.positions, disturbance.mean_accuracy)
        if too_small:
            self.reporter.warn(
                f"{len(too_small):,} areas or pairs, such as {too_small[0]['aoi']}, are smaller than twice the "
                "accuracy of the tracker; they are in the table resolution"
            )
        elif disturbance.mean_accuracy > 0:
            self.reporter.message("no area is smaller than twice the accuracy of the tracker")
        return {"tracker": corrected, "resolution": too_small}

    def _list_participants(self, sums: VisitSums, show_names: bool, salt: FilePath | None) -> Sequence[Row]:
        if self.suppression.minimum > 1:
            self.reporter.message(
                "no table of participants is written, because each of its numbers would rest on one participant"
            )
            return ()
        persons = sums.find_participants(ALL)[1]
        named = {p: p for p in persons}
        if not show_names:
            named = make_pseudonyms(persons, None if salt is None else read_salt(to_path(salt)))
        return ParticipantRows(sums, named, self.counting.aoi_visibility)


def report_values_without_comparison(cells: Collection[Cell], limit: int, reporter: Reporter) -> None:
    """Warn of dimensions of ``cells`` with more than ``limit`` values, of which the first ones are compared."""
    for dimension in dict.fromkeys(cell.dimension for cell in cells):
        values = [cell.value for cell in cells if cell.dimension == dimension]
        if len(values) > limit:
            reporter.warn(
                f"differences are those between the first {limit} of {len(values)} values of {dimension}; "
                f'"{values[limit]}" and later ones are not compared'
            )


def _report_small_groups(people: Mapping[Cell, Mapping[str, Participants]], reporter: Reporter) -> None:
    for cell in (c for c, by_source in people.items() if MEASURED in by_source and not by_source[MEASURED].names):
        reporter.message(
            f"there are no participants in the {cell.dimension} {cell.value}; time windows are on the rays' clock"
        )
    few = [
        cell
        for cell, by_source in people.items()
        for p in by_source.values()
        if 0 < p.is_in_cell.sum() < MIN_FOR_INTERVAL
    ]
    if few:
        which = "the whole recording" if few[0] == ALL else f"{few[0].dimension} {few[0].value}"
        reporter.message(
            f"there are no confidence intervals for fewer than {MIN_FOR_INTERVAL} participants ({which}"
            + (f" and {len(set(few)) - 1} more)" if len(set(few)) > 1 else ")")
        )
