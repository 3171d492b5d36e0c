"""Options of what is done to rays of attention: importing, filtering and splitting."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nerg_mi.errors import NergError
from nerg_mi.ranges import COORDINATES, LENGTHS, RAYS, SECONDS, SEEDS, THREADS, TIMES, Checked, Range

from . import option, parse_numbers

DETECTORS = ("ivt", "idt")
DATASET = ".rays"
"""How the name of a dataset ends where one is written; any other name is that of a file."""


@dataclass(frozen=True, kw_only=True)
class ImportOptions(Checked):
    """How tracking files become rays. Raises `NergError` for a salt without pseudonyms, and for what only a dataset
    has."""

    reader: str = option("table", "Name of a registered reader (nerg_mi.rays.readers.registry).")
    settings: Any = option(None, "An object of the reader's Options. Default: as they are by default.")
    place_name: str | None = option(None, "Of a dataset: the place of all files.  [default: unknown]")
    day: str | None = option(
        None, "Of a dataset: the day of all rays, as 2026-11-22.  [default: by their times, in UTC, else unknown]"
    )
    workers: int | None = option(
        None, "Of a dataset: processes that import files beside each other.  [default: a core each]", within=THREADS
    )
    skip_bad_lines: bool = option(
        False, "Leave out lines that cannot be read, with an account of them: at most 1 % of a file's."
    )
    pseudonyms: bool = option(False, "Replace the names of persons, also in the names of files, by salted hashes.")
    salt: Path | str | None = option(
        None,
        "--pseudonyms: file of 16 random bytes or more, so that several imports agree.  [default: random, not kept]",
    )
    output: Path | str | None = option(None, "Rays file (.npz or .parquet) or dataset (.rays) to write.")
    align_output: Path | str | None = option(
        None,
        "JSON file to write: the similarity from the rays to the files' own frame, for --align where a place is in "
        "that frame.",
        "--write-align",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.salt is not None and not self.pseudonyms:
            raise NergError("--salt belongs to --pseudonyms; add it, or leave out --salt")
        given = [n for n in ("place_name", "day", "workers") if getattr(self, n) is not None]
        if given and not self.into_dataset:
            raise NergError(
                f"--{given[0].replace('_', '-')} belongs to datasets; let the name of the output end in {DATASET}"
            )
        if self.align_output is not None and self.into_dataset:
            raise NergError(
                "--write-align belongs to files of rays; the sources of a dataset may differ in their frames"
            )

    @property
    def into_dataset(self) -> bool:
        """Whether a dataset is to be written."""
        return self.output is not None and Path(self.output).suffix.lower() == DATASET


@dataclass(frozen=True, kw_only=True)
class FilterOptions(Checked):
    """Which rays to keep: conditions first, then fixations, then fewer of those who stand still.

    Raises `NergError` for an unknown word, or where nothing is said.
    """

    start: float | None = option(None, "Rays from this time on, seconds.", "--from", within=TIMES)
    end: float | None = option(None, "Rays before this time, seconds.", "--to", within=TIMES)
    persons: tuple[str, ...] = option((), "Only this person; repeatable.", "--person")
    without_persons: tuple[str, ...] = option((), "Not this person; repeatable.", "--without-person")
    cohorts: tuple[str, ...] = option((), "Only this cohort; repeatable.", "--cohort")
    box: tuple[float, ...] | None = option(
        None, "Origins in this box: x0,x1,y0,y1,z0,z1, metres.", parse=parse_numbers, within=COORDINATES
    )
    min_confidence: float | None = option(None, "Only rays of at least this confidence.", within=Range(0, 1))
    with_hit: bool = option(False, "Only rays whose hit point is known.")
    fixations: str | None = option(None, "Only rays of fixations: ivt (by velocity) or idt (by dispersion).")
    velocity: float = option(100.0, "ivt: degrees a second that end a fixation.", within=Range(0, 10**6))
    dispersion: float = option(3.0, "idt: degrees within which a fixation stays.", within=Range(0, 180))
    least: float | None = option(None, "Shortest fixation, seconds.  [default: ivt 0.06, idt 0.1]", within=SECONDS)
    one_ray: bool = option(False, "One ray a fixation, its mean.")
    thin: float | None = option(None, "A stop counts as at most this many seconds of rays.", within=SECONDS)
    thin_distance: float = option(0.1, "With --thin, a stop is a stay within this many metres.", within=Range(0, 10**6))
    sample: int | None = option(None, "So many of the rays that are left, each as likely as any other.", within=RAYS)
    seed: int = option(0, "Seed of --sample.", within=SEEDS)
    output: Path | str | None = option(
        None, "Rays file to write (.npz or .parquet), or of a dataset another (.rays).", "-o", "--output"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.fixations not in (None, *DETECTORS):
            raise NergError(f'--fixations is "{self.fixations}"; it is ivt or idt')
        if self.one_ray and self.fixations is None:
            raise NergError("--one-ray is of fixations; add --fixations ivt or --fixations idt")
        if not self.conditions and not self.follows and self.sample is None:
            raise NergError(
                "say which rays to keep, for instance with --from, --person, --box, --fixations, --thin or --sample "
                "(--help lists all)"
            )

    @property
    def follows(self) -> bool:
        """Whether it is asked for what must see the rays of a person one after the other."""
        return self.fixations is not None or self.thin is not None

    @property
    def conditions(self) -> dict[str, Any]:
        """What was asked for, as `nerg_mi.rays.filters.select_mask` takes it."""
        what = {
            "time": None if self.start is None and self.end is None else (self.start, self.end),
            "persons": list(self.persons) or None,
            "without_persons": list(self.without_persons) or None,
            "cohorts": list(self.cohorts) or None,
            "box": None if self.box is None else list(self.box),
            "min_confidence": self.min_confidence,
            "with_hit": self.with_hit or None,
        }
        return {name: value for name, value in what.items() if value is not None}


@dataclass(frozen=True, kw_only=True)
class SplitOptions(Checked):
    """How training and test rays are parted: by position, person or time, or several of them at once.

    Raises `NergError` where nothing is said.
    """

    zones: int = option(0, "By position: zones held out; 0: not by position.", within=Range(0, 1000))
    radius: float = option(
        0.25, "By position: R of probes, metres; rays within 2R of a test position are purged.", within=LENGTHS
    )
    zone_radius: float = option(0.2, "By position: radius of a zone, metres.", within=Range(0, 10**6))
    positions: int = option(150, "By position: test positions in the zones.", within=Range(1, 10**5))
    min_rays: int = option(64, "By position: rays that a test position has within R.", within=Range(1, 10**6))
    people: float = option(0.0, "By person: share held out, at random; 0: not by person.", within=Range(0, 1))
    persons: tuple[str, ...] = option((), "By person: this one is held out; repeatable.", "--person")
    time: float = option(0.0, "By time: share at the end that is held out; 0: not by time.", within=Range(0, 1))
    gap: float = option(5.0, "By time: seconds purged before the end part.", within=SECONDS)
    clock: str = option("all", "By time: all (one clock), or person (each their own).")
    seed: int = option(0, "Seed of zones, positions and people.", within=SEEDS)
    train_output: Path | str | None = option(None, "Rays file to write of the training rays (.npz or .parquet).")
    test_output: Path | str | None = option(None, "The same of the test rays.")

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (self.zones or self.people or self.persons or self.time):
            raise NergError("say how to split: --zones 3, --people 0.5, --person NAME, --time 0.2, or several of them")
