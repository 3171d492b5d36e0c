"""Scores of a gaze field as text and JSON, and the verdict on them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError, sanitize
from nerg_mi.figures.style import Provenance, find_colormap, new_page, save
from nerg_mi.files.atomic import write_text
from nerg_mi.files.safe_read import is_count, read_json
from nerg_mi.files.tables import format_markdown_table, write_csv, write_json
from nerg_mi.maths.sphere import Z_UP, latlong_grid
from nerg_mi.probes.probes import REGION_LEVELS, format_level

from .gaze import SCORES, Baseline, GazeTest
from .uncertainty import RETAINED_FRACTIONS

# ---- What an evaluation of gaze writes: tables as Markdown, CSV and JSON, and pictures of truth and prediction ----

_DIGITS = {"MAE": 4}  # Digits of the scores that have others than three
_WORDS = ("method", "person", "signal", "error")  # Columns that hold words


def format_table(rows: list[dict], columns: tuple[str, ...] = ("method", *SCORES, "integral")) -> str:
    """A table of ``rows``, with intervals in brackets where they are known."""
    shown = [c for c in columns if any(c in r for r in rows)]
    numbers = [c for c in shown if c not in _WORDS]
    return format_markdown_table(shown, ([_cell(row, c) for c in shown] for row in rows), numbers) + "\n"


def _cell(row: dict, column: str) -> str:
    value = row.get(column)
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ""
    if not isinstance(value, float):
        return str(value)
    digits = _DIGITS.get(column, 3)
    text = f"{value:.{digits}f}"
    if f"{column}.low" in row:
        text += f" [{row[f'{column}.low']:.{digits}f}, {row[f'{column}.high']:.{digits}f}]"
    return text


def write_report(
    folder: Path,
    rows: list[dict],
    participants: list[dict],
    metadata: dict,
    notes: str,
    positions: list[dict] | None = None,
    ranks: list[dict] | None = None,
    regions: list[dict] | None = None,
) -> list[Path]:
    """Write ``gaze.md``, ``gaze.csv``, ``persons.csv``, ``gaze.json`` and ``positions.csv`` into ``folder``; the paths.

    ``rows``, ``persons``: a row a method, and a method and person; ``about``: what was scored (JSON); ``notes``: what
    the Markdown begins with; ``positions``, ``ranks``, ``regions``: rows of `uncertainty`.
    """
    positions, ranks, regions = positions or [], ranks or [], regions or []
    files = [folder / name for name in ("gaze.md", "gaze.csv", "persons.csv", "gaze.json", "positions.csv")]
    ours, bar = rows[0], next(r["method"] for r in reversed(rows) if r["method"] != "split half")
    difference = {k.replace(".less", ""): v for k, v in ours.items() if ".less" in k}
    differences = [{"method": f"{ours['method']} less {bar}", **difference}]
    each = format_table(participants, ("method", "person", "rays", "KLD", "CC", "NSS", "AUC", "bits", "loglik"))
    text = f"{notes}\n\n{format_table(rows)}\n{format_table(differences)}\n{format_uncertainty(ranks, regions)}"
    write_text(files[0], f"{text}## Each person\n\n{each}")
    for path, table in zip((*files[1:3], files[4]), (rows, participants, positions)):
        write_csv(path, table)
    of_all = {"methods": rows, "persons": participants, "uncertainty": ranks, "calibration": regions}
    write_json(files[3], {**metadata, **of_all})
    return files


def format_uncertainty(ranks: list[dict], regions: list[dict]) -> str:
    """What a page says of rows of `uncertainty.rank_rows` and `uncertainty.calibration_rows`, as Markdown."""
    text = ""
    if ranks:
        shares = tuple(f"{share:.0%}" for share in RETAINED_FRACTIONS)
        text += (
            "## Uncertainty\n\nrho: Spearman's rank correlation of what makes unsure (little support; a wide spread of "
            "an ensemble's members) with the error at a position: KLD, or its excess over that of half of the people "
            "under the other half. Then the mean error of the surest positions. A signal that is the same everywhere "
            f"has no rho.\n\n{format_table(ranks, ('signal', 'error', 'positions', 'rho', *shares))}\n"
        )
    if regions:
        text += (
            "## Calibration\n\nShare of the rays in the smallest regions that are said to hold so much of the gaze; "
            '"calibrated": that should hold so much, by what the training held out.'
            f"\n\n{format_table(regions, ('method', *(format_level(level) for level in REGION_LEVELS)))}\n"
        )
    return text


def draw_comparison(
    test: GazeTest,
    methods: dict[str, Baseline],
    path: Path,
    count: int = 4,
    height: int = 48,
    provenance: Provenance | None = None,
) -> None:
    """Truth and each of ``methods`` at ``count`` test positions, as panoramas (z up) on one scale a row, in 1/sr, with
    how many rays of how many people the truth is made of."""
    d, _ = latlong_grid(2 * height, height, Z_UP)
    which = np.unique(np.linspace(0, len(test.centres) - 1, count).astype(int))
    near = np.argmax(test.directions @ d.T, axis=0)  # the truth is smooth at the scale of its directions
    pictures = [("truth", test.truth[which][:, near])] + [
        (k, np.asarray(m(test.centres[which], d))) for k, m in methods.items()
    ]
    figure = new_page(374 * len(pictures), 209 * len(which))
    figure.set_layout_engine("constrained")
    axes = figure.subplots(len(which), len(pictures), squeeze=False)
    for i, row in enumerate(axes):
        top, images = np.quantile(pictures[0][1][i], 0.995), []
        for (name, maps), axis in zip(pictures, row):
            shown = maps[i].reshape(height, 2 * height)
            images.append(axis.imshow(shown, vmin=0, vmax=top, cmap=find_colormap("inferno")))
            axis.set(xticks=[], yticks=[])
            if i == 0:
                axis.set_title(name, fontsize=10)
        rays = test.counts[which[i]]
        words = f"{rays.sum():,.0f} rays of {np.count_nonzero(rays)} people"
        row[0].set_ylabel(", ".join(f"{x:.1f}" for x in test.centres[which[i]]) + f" m\n{words}", fontsize=8)
        figure.colorbar(images[-1], ax=row.tolist(), shrink=0.9).set_label("1/sr", fontsize=8)
    save(figure, path, provenance)


# ---- What `nerg eval gaze` has written, read again: the file ``gaze.json`` of its folder ----

MAX_FILE_BYTES = 4 << 20  # So many bytes of such a file are read at most

_ROWS = 20_000
_WORD = 200


@dataclass(frozen=True)
class GazeResults:
    """``gaze``: name of the scored checkpoint, and its ``sha256`` ("" where it is not known); ``split``;
    ``positions`` and ``people`` of the test; ``rows``: a row a method, the field's first; ``persons``: a row a method
    and person; ``kappa``: of the truth's kernel."""

    gaze: str
    sha256: str
    split: str
    num_positions: int
    num_participants: int
    kappa: float
    rows: tuple[dict[str, Any], ...]
    participant_rows: tuple[dict[str, Any], ...]


def read_results(path: str | Path) -> GazeResults:
    """The results in ``path``. Raises `NergError` for a file that holds none."""
    found = read_json(path, "evaluation", MAX_FILE_BYTES)
    if not isinstance(found, dict):
        raise _damaged(path, "it is no JSON object")
    missing = [k for k in ("gaze", "split", "positions", "methods") if k not in found]
    if missing:
        raise _damaged(path, f'it lacks "{missing[0]}"')
    rows, persons = _rows(found["methods"], path, "methods"), _rows(found.get("persons", []), path, "persons")
    if not rows or not is_count(found["positions"]):
        raise _damaged(path, 'its "methods" or "positions" are none')
    people = found.get("people", len({r.get("person") for r in persons}))
    kappa = found.get("kappa", math.nan)
    words = [found["gaze"], found["split"], found.get("gaze_sha256", "")]
    if not is_count(people) or not _is_number(kappa) or not all(isinstance(w, str) and len(w) <= _WORD for w in words):
        raise _damaged(path, "something in it is no number or no name")
    return GazeResults(words[0], words[2], words[1], found["positions"], people, float(kappa), rows, persons)


def _rows(given: object, path: str | Path, name: str) -> tuple[dict[str, Any], ...]:
    """Rows of names, numbers and missing numbers, each with the name of a method."""
    if not isinstance(given, list) or len(given) > _ROWS:
        raise _damaged(path, f'its "{name}" are no list of at most {_ROWS:,} rows')
    for row in given:
        if not isinstance(row, dict) or not isinstance(row.get("method"), str):
            raise _damaged(path, f'a row of its "{name}" names no method')
        for key, value in row.items():
            text = key in ("method", "person")
            if not (isinstance(value, str) and len(value) <= _WORD if text else value is None or _is_number(value)):
                raise _damaged(path, f'"{sanitize(key, 40)}" of a row of its "{name}" is {sanitize(value, 40)}')
    return tuple(given)


def _is_number(value: object) -> bool:
    return (
        isinstance(value, (int, float)) and not isinstance(value, bool) and -1e300 < value < 1e300
    ) or value != value


def _damaged(path: str | Path, why: str) -> NergError:
    return NergError(f'"{path}" is no evaluation of a gaze field ({why}); make one with "nerg eval gaze"')


# ---- Verdict ----
#
# Whether a gaze field is worth using, in a sentence: its scores beside those of what needs no field.
#
# The rule, for one split:
#
# 1. Fewer than `LEAST_PEOPLE` people or `LEAST_POSITIONS` positions give no verdict, whatever the scores are.
# 2. The field is compared with three references: the uniform density; the position-blind one, of whose kernels that
#    with the higher log score is taken; and the nearest rays. Where another baseline has a higher log score than all of
#    these, with that one, too. The scores are the log score (bits a ray), CC and KLD. One of them decides where the
#    95 % interval of the field's lead leaves out zero.
# 3. The field is better where at least two of the three scores decide for it and none against it, worse where two
#    decide against it and none for it, and undecided otherwise.
# 4. Worse than uniform or than position-blind: do not use it. Undecided beside position-blind: not shown to be of use.
#    Better than position-blind: of use, and the nearest rays, with whatever is stronger, say whether it is worth a
#    field. The sentence names the strongest baseline, which is the one with the highest log score.
#
# Intervals are those of the bootstrap over people (`workflows.evaluate_gaze`), made wider for few: by sqrt(n / (n -
# 1)), since a bootstrap of n people is too narrow by as much, and by Student's quantile of n - 1 degrees of freedom in
# place of 1.96 (Hesterberg, What Teachers Should Know About the Bootstrap, 2015). Where only the two methods' own
# intervals are known, the reach of the lead is the sum of theirs, which is never too small.

MIN_PARTICIPANTS, MIN_POSITIONS = 5, 10  # Below these there is no verdict

VERDICT_SCORES = {"bits": 1, "CC": 1, "KLD": -1}  # The scores that decide, and whether more (1) or less (-1) is better

UNIFORM, POSITION_BLIND, NEAREST_RAYS, SPLIT_HALF = "uniform", "position-blind", "4,096 nearest rays", "split half"
"""Names of the methods that a field is compared with."""

SPLIT_LABELS = {
    "both": "new people at new places",
    "pos": "known people at new places",
    "people": "new people at places where others were",
}
"""Each split, in words."""

BETTER, WORSE, UNDECIDED = "better", "worse", "undecided"


@dataclass(frozen=True)
class ScoreDifference:
    """By how much the field is ahead of a reference in one score, positive where it is better, and its 95 % interval;
    NaN where it is not known."""

    score: str
    value: float
    low: float
    high: float

    @property
    def outcome(self) -> str:
        """`BETTER`, `WORSE` or `UNDECIDED`."""
        return BETTER if self.low > 0 else WORSE if self.high < 0 else UNDECIDED


@dataclass(frozen=True)
class Comparison:
    """The field beside one ``reference``."""

    reference: str
    differences: tuple[ScoreDifference, ...]

    @property
    def outcome(self) -> str:
        """`BETTER`, `WORSE` or `UNDECIDED`, by at least two scores and none against them."""
        found = [lead.outcome for lead in self.differences]
        for one, other in ((BETTER, WORSE), (WORSE, BETTER)):
            if found.count(one) >= 2 and other not in found:
                return one
        return UNDECIDED


@dataclass(frozen=True)
class Verdict:
    """``grade``: "use", "limited", "unclear", "reject" or "none"; ``sentence``: the verdict; ``comparisons`` behind it;
    ``half``: the share of the way from position-blind to the other half of the people that the field goes in CC, None
    where it is not known."""

    grade: str
    sentence: str
    comparisons: tuple[Comparison, ...] = ()
    split_half_fraction: float | None = None


def compute_verdict(rows: Sequence[Mapping[str, Any]], split: str, num_participants: int, num_positions: int) -> Verdict:
    """The verdict on the first of ``rows``, the field's, beside the others, which are told apart by ``method``.

    ``split``: a word of `WORDS`; ``people``, ``positions``: in the test.
    """
    whom = SPLIT_LABELS.get(split, split)
    if num_participants < MIN_PARTICIPANTS or num_positions < MIN_POSITIONS:
        return Verdict(
            "none",
            f"No verdict for {whom}: {_count(num_participants, 'person', 'people')} at {_count(num_positions, 'place', 'places')} "
            f"are too few; it takes {MIN_PARTICIPANTS} people and {MIN_POSITIONS} places.",
        )
    field, blind, strongest = rows[0], _blind(rows), _strongest(rows)
    found = {name: _row(rows, name) for name in (UNIFORM, NEAREST_RAYS)}
    compare = lambda name, row: Comparison(name, tuple(compare_scores(field, row, score, num_participants) for score in VERDICT_SCORES))
    pairs = [(UNIFORM, found[UNIFORM]), (POSITION_BLIND, blind), (NEAREST_RAYS, found[NEAREST_RAYS])]
    if strongest not in ("", *(name for name, _ in pairs)):
        pairs.append((strongest, _row(rows, strongest)))
    comparisons = tuple(compare(name, row) for name, row in pairs if row is not None)
    half = _way_to_half(field, blind, _row(rows, SPLIT_HALF))
    grade, sentence = _words(comparisons, strongest, whom, num_participants)
    return Verdict(grade, sentence, comparisons, half)


def compare_scores(field: Mapping[str, Any], other: Mapping[str, Any], score: str, num_participants: int) -> ScoreDifference:
    """The lead of the row ``field`` before the row ``other`` in ``score``, with an interval for so many ``people``."""
    sign, nan = VERDICT_SCORES[score], math.nan
    value = sign * (_number(field, score) - _number(other, score))
    reach = _reach(other, f"{score}.gap")
    if math.isnan(reach):
        reach = _reach(field, score) + _reach(other, score)
    if math.isnan(value) or math.isnan(reach) or num_participants < 2:
        return ScoreDifference(score, value, nan, nan)
    reach *= small_sample_factor(num_participants)
    return ScoreDifference(score, value, value - reach, value + reach)


def small_sample_factor(num_participants: int) -> float:
    """How much wider the interval of a mean over so many ``people`` is than 1.96 standard errors of their bootstrap."""
    from scipy.special import stdtrit

    return float(math.sqrt(num_participants / (num_participants - 1)) * stdtrit(num_participants - 1, 0.975) / 1.96)


def _words(comparisons: Sequence[Comparison], strongest: str, whom: str, people: int) -> tuple[str, str]:
    outcome = {c.reference: c.outcome for c in comparisons}
    if POSITION_BLIND not in outcome:
        return "none", f"No verdict for {whom}: the evaluation has no position-blind density to compare with."
    for name, words in ((UNIFORM, "worse than knowing nothing"), (POSITION_BLIND, "worse than position-blind")):
        if outcome.get(name) == WORSE:
            return "reject", f"{words.capitalize()} for {whom}: do not use."
    if outcome[POSITION_BLIND] == UNDECIDED:
        return (
            "unclear",
            f"Not shown to be better than position-blind for {whom}: do not rely on where people stand without more of "
            "them.",
        )
    if NEAREST_RAYS not in outcome:
        return "limited", f"Better than position-blind for {whom}; it was not compared with nearest rays."
    others = {name: result for name, result in outcome.items() if name not in (UNIFORM, POSITION_BLIND)}
    shown = {NEAREST_RAYS: "nearest rays"}
    for name, result in others.items():
        if result == WORSE:
            worse = shown.get(name, name)
            return "limited", f"Better than position-blind, but worse than {worse} for {whom}: use the rays."
    for name, result in others.items():
        if result == UNDECIDED:
            return (
                "limited",
                f"Better than position-blind for {whom}; whether it is better than {shown.get(name, name)} is "
                f"undecided with {people} people.",
            )
    if not strongest:
        return "use", f"Better than nearest rays for {whom}."
    rest = "" if strongest == NEAREST_RAYS else "and than nearest rays "
    return "use", f"Better than {shown.get(strongest, strongest)}, the strongest baseline, {rest}for {whom}."


def _strongest(rows: Sequence[Mapping[str, Any]]) -> str:
    """The baseline whose log score is the highest, by its name; "" where none has one. The other half of the people is
    no baseline, and kernels of the position-blind density have one name."""
    scored = [r for r in rows[1:] if r.get("method") != SPLIT_HALF and not math.isnan(_number(r, "bits"))]
    best = max(scored, key=lambda r: _number(r, "bits"), default={})
    name = str(best.get("method", ""))
    return POSITION_BLIND if name.startswith(POSITION_BLIND) else name


def _blind(rows: Sequence[Mapping[str, Any]]) -> Mapping[str, Any] | None:
    """The position-blind density whose log score is the highest."""
    found = [r for r in rows[1:] if str(r.get("method", "")).startswith(POSITION_BLIND)]
    known = [r for r in found if not math.isnan(_number(r, "bits"))]
    return max(known or found, key=lambda r: _number(r, "bits"), default=None)


def _row(rows: Sequence[Mapping[str, Any]], name: str) -> Mapping[str, Any] | None:
    return next((r for r in rows[1:] if r.get("method") == name), None)


def _way_to_half(field: Mapping[str, Any], blind: Mapping[str, Any] | None, half: Mapping[str, Any] | None):
    if blind is None or half is None:
        return None
    way = _number(half, "CC") - _number(blind, "CC")
    share = (_number(field, "CC") - _number(blind, "CC")) / way if way > 0 else math.nan
    return share if math.isfinite(share) else None


def _number(row: Mapping[str, Any], key: str) -> float:
    value = row.get(key)
    return float(value) if isinstance(value, (int, float)) and math.isfinite(value) else math.nan


def _reach(row: Mapping[str, Any], key: str) -> float:
    return (_number(row, f"{key}.high") - _number(row, f"{key}.low")) / 2


def _count(number: int, one: str, several: str) -> str:
    return f"{number} {one if number == 1 else several}"
