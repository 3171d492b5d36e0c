"""Reports of a gaze evaluation as Markdown, CSV, JSON and pictures, and the verdict."""

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
from nerg_mi.tracking.folds import NEW_POSITION_DISTANCE
from nerg_mi.tracking.probes import REGION_LEVELS, format_level

from .baselines import CONDITIONAL_HITS, CONDITIONAL_KDE, NEAREST_RAYS, PRIOR, REAIMED_HITS, STACK, UNIFORM, Baseline
from .gaze import MAP_SCORES, SCORES, SPLIT_HALF, GazeTest, find_split_half_fault
from .uncertainty import RETAINED_FRACTIONS

# ---- Reports of an evaluation: tables as Markdown, CSV and JSON, and pictures of reference and prediction ----

_DIGITS = {"MAE": 4}  # Digits of scores, if not three
_TEXT_COLUMNS = ("method", "kind", "person", "signal", "error", "component")  # Columns of text
_HEADINGS = {"person": "participant", "rays": "samples"}  # Headings that differ from the keys of rows


def format_table(rows: list[dict], columns: tuple[str, ...] = ("method", *SCORES, "integral")) -> str:
    """Format ``rows`` as a Markdown table, with confidence intervals in brackets."""
    shown_columns = [c for c in columns if any(c in r for r in rows)]
    numbers = [c for c in shown_columns if c not in _TEXT_COLUMNS]
    headings = [_HEADINGS.get(c, c) for c in shown_columns]
    cells = ([_format_cell(row, c) for c in shown_columns] for row in rows)
    return format_markdown_table(headings, cells, [_HEADINGS.get(c, c) for c in numbers]) + "\n"


def _format_cell(row: dict, column: str) -> str:
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
    verdicts: list[dict] | None = None,
) -> list[Path]:
    """Write ``gaze.md``, ``gaze.csv``, ``persons.csv``, ``gaze.json`` and ``positions.csv`` into ``folder``; returns
    the paths.

    Parameters
    ----------
    folder : Path
        Output folder.
    rows, participants : list of dict
        Scores per method, and per method and participant.
    metadata : dict
        Description of the evaluation (JSON).
    notes : str
        Introduction of the Markdown file.
    positions, ranks, regions : list of dict, optional
        Rows of `uncertainty`.
    verdicts : list of dict, optional
        Rows of `position_scores`.
    """
    positions, ranks, regions = positions or [], ranks or [], regions or []
    files = [folder / name for name in ("gaze.md", "gaze.csv", "persons.csv", "gaze.json", "positions.csv")]
    field_row, reference = rows[0], next(r["method"] for r in reversed(rows) if r["method"] != SPLIT_HALF)
    difference = {k.replace(".less", ""): v for k, v in field_row.items() if ".less" in k}
    differences = [{"method": f"{field_row['method']} less {reference}", **difference}]
    participant_table = format_table(
        participants, ("method", "person", "rays", "bits", "KLD", "CC", "NSS", "AUC", "loglik")
    )
    text = f"{notes}\n\n{format_table(rows)}\n{format_table(differences)}\n{format_verdict_table(verdicts or [])}"
    text += format_uncertainty(ranks, regions)
    write_text(files[0], f"{text}## Per participant\n\n{participant_table}")
    for path, table in zip((*files[1:3], files[4]), (rows, participants, positions)):
        write_csv(path, table)
    results = {"methods": rows, "persons": participants, "uncertainty": ranks, "calibration": regions}
    write_json(files[3], {**metadata, **results, "verdicts": verdicts or []})
    return files


def format_verdict_table(rows: list[dict]) -> str:
    """Format the scores at recorded positions and away from them as Markdown, the best baselines first."""
    if not rows:
        return ""
    return (
        "## Recorded and new positions\n\nHeld-out participants up to, and farther than, "
        f"{NEW_POSITION_DISTANCE:g} m from every training position: bits per ray above the position-independent prior "
        "at the origin of each ray, averaged over the rays of each participant, and by how much the gaze field exceeds "
        "each baseline, which is tuned on participants, for new positions also on zones, that are left out. Brackets: "
        "95 % intervals of Student's t over participants."
        f"\n\n{format_table(rows, ('kind', 'method', 'people', 'rays', 'bits', 'bits.gap'))}\n"
    )


def format_uncertainty(ranks: list[dict], regions: list[dict]) -> str:
    """Format two tables as Markdown: ``ranks``, correlations of uncertainty with error, and ``regions``, coverage of
    highest-density regions.
    """
    text = ""
    if ranks:
        shares = tuple(f"{share:.0%}" for share in RETAINED_FRACTIONS)
        text += (
            "## Uncertainty\n\nrho: Spearman's rank correlation of the uncertainty (low support, or spread of an "
            "ensemble) with the error at a position: KLD, or its excess over the split-half KLD. The next columns are "
            "the mean errors of the given fraction of the most certain positions. A constant signal has no rho."
            f"\n\n{format_table(ranks, ('signal', 'error', 'positions', 'rho', *shares))}\n"
        )
    if regions:
        text += (
            "## Calibration\n\nFraction of the held-out samples inside the highest-density regions of each nominal "
            "level, at the centres of the test positions, and at the origins of samples at recorded and at new "
            'positions; "calibrated": with levels calibrated on the training folds.'
            f"\n\n{format_table(regions, ('method', *(format_level(level) for level in REGION_LEVELS)))}\n"
        )
    return text


_MISSING = {
    "gap": "the difference of the first method to the others",
    "less": "the difference of the first method to the last one",
    "integral": "not a score, so that there is no difference",
    "rho": "fewer than 3 positions, or a constant signal or error",
    **dict.fromkeys(("half", "excess"), "too few samples of a half of the participants"),
    "support": "the checkpoint of the gaze field does not store it",
    "spread": "the gaze field is no ensemble",
    **dict.fromkeys(MAP_SCORES, "no position with enough samples of the participant"),
}
_NO_INTERVAL = {
    "folds": "of a single fold",
    "rho": "fewer than 5 groups of positions, or no resamples",
    "method": "fewer than 3 participants, or no resamples",
}


def explain_missing(row: Mapping[str, Any], column: str) -> tuple[str, str]:
    """Return the name of a missing value of any table of an evaluation, and why it is missing
    (`nerg_mi.files.tables.add_notes`).
    """
    value, is_limit = column, column.endswith((".low", ".high"))
    if is_limit:
        value = column.rsplit(".", 1)[0]
    if row.get("method") == SPLIT_HALF and "." in column:
        return "intervals and differences", "not computed for the split half"
    if is_limit and math.isfinite(_read_number(row, value)):
        return f"interval of {value}", next(reason for key, reason in _NO_INTERVAL.items() if key in row)
    kind = value.rsplit(".", 1)[-1]
    return value, _MISSING.get(kind, "no sample to score")


def draw_comparison(
    test: GazeTest,
    methods: dict[str, Baseline],
    path: Path,
    count: int = 4,
    height: int = 48,
    provenance: Provenance | None = None,
) -> None:
    """Draw the reference and each of ``methods`` at ``count`` test positions as panoramas (z up) in 1/sr.

    Each row has one colour scale and names the number of samples and participants of its reference. Azimuths increase
    clockwise, seen from above, from +y at the left edge.
    """
    d, _ = latlong_grid(2 * height, height, Z_UP)
    positions = np.unique(np.linspace(0, len(test.centres) - 1, count).astype(int))
    near = np.argmax(test.directions @ d.T, axis=0)  # the reference is smooth at the scale of its directions
    pictures = [("reference", test.truth[positions][:, near])] + [
        (k, np.asarray(m(test.centres[positions], d))) for k, m in methods.items()
    ]
    figure = new_page(374 * len(pictures), 209 * len(positions) + 40)
    figure.set_layout_engine("constrained")
    axes = figure.subplots(len(positions), len(pictures), squeeze=False)
    for i, row in enumerate(axes):
        top, images = np.quantile(pictures[0][1][i], 0.995), []
        for (name, maps), axis in zip(pictures, row):
            shown = maps[i].reshape(height, 2 * height)
            images.append(axis.imshow(shown, vmin=0, vmax=top, cmap=find_colormap("inferno"), extent=(0, 360, -90, 90)))
            axis.set(xticks=range(0, 361, 90), yticks=(-90, 0, 90))
            axis.tick_params(labelsize=7, labelbottom=i == len(axes) - 1, labelleft=axis is row[0])
            if i == len(axes) - 1:
                axis.set_xlabel("azimuth (degrees, clockwise from +y)", fontsize=8)
            if i == 0:
                axis.set_title(name, fontsize=10)
        rays = test.counts[positions[i]]
        label = f"{rays.sum():,.0f} samples of {np.count_nonzero(rays)} participants"
        row[0].set_ylabel(
            ", ".join(f"{x:.1f}" for x in test.centres[positions[i]]) + f" m\n{label}\nelevation (degrees)", fontsize=7
        )
        figure.colorbar(images[-1], ax=row.tolist(), shrink=0.9).set_label("gaze density (1/sr)", fontsize=8)
    save(figure, path, provenance)


# ---- Reading the results of `nerg eval gaze`, the file ``gaze.json`` of its folder ----

MAX_FILE_BYTES = 4 << 20  # Maximum size of a results file

_MAX_ROWS = 20_000
_MAX_NAME_LENGTH, _MAX_NOTE_LENGTH = 200, 4000


@dataclass(frozen=True)
class GazeResults:
    """Results of a gaze evaluation.

    Attributes
    ----------
    gaze : str
        Name of the evaluated checkpoint.
    sha256 : str
        Its checksum, "" if unknown.
    split : str
        Kind of split.
    num_positions, num_participants : int
        Size of the test data.
    kappa : float
        Concentration of the kernels of the truth.
    rows, participant_rows : tuple of dict
        Scores per method, the field's first, and per method and participant.
    split_half_note : str
        Why there is no split half; "" if there is one or the reason is unknown.
    """

    gaze: str
    sha256: str
    split: str
    num_positions: int
    num_participants: int
    kappa: float
    rows: tuple[dict[str, Any], ...]
    participant_rows: tuple[dict[str, Any], ...]
    split_half_note: str = ""


def read_results(path: str | Path) -> GazeResults:
    """Read the results in ``path``. Raises `NergError` if the file is not a results file."""
    data = read_json(path, "evaluation", MAX_FILE_BYTES)
    if not isinstance(data, dict):
        raise _make_error(path, "it is not a JSON object")
    missing = [k for k in ("gaze", "split", "positions", "methods") if k not in data]
    if missing:
        raise _make_error(path, f'it lacks "{missing[0]}"')
    rows, persons = _check_rows(data["methods"], path, "methods"), _check_rows(data.get("persons", []), path, "persons")
    if not rows or not is_count(data["positions"]):
        raise _make_error(path, 'its "methods" or "positions" are invalid')
    people = data.get("people", len({r.get("person") for r in persons}))
    kappa = data.get("kappa", math.nan)
    names = [data["gaze"], data["split"], data.get("gaze_sha256", ""), data.get("split_half_note", "")]
    if (
        not is_count(people)
        or not _is_number(kappa)
        or not all(isinstance(w, str) and len(w) <= _MAX_NAME_LENGTH for w in names)
    ):
        raise _make_error(path, "one of its values is not a valid number or name")
    half = _find_row(rows, SPLIT_HALF)
    if half is not None:
        # Files of earlier versions have scores that are noise.
        names[3] = find_split_half_fault(people // 2, _read_number(half, "bits"))
        rows = tuple(row for row in rows if row is not half or not names[3])
    return GazeResults(names[0], names[2], names[1], data["positions"], people, float(kappa), rows, persons, names[3])


def _check_rows(rows: object, path: str | Path, name: str) -> tuple[dict[str, Any], ...]:
    """Validate rows of text, numbers and missing numbers, each with the name of a method."""
    if not isinstance(rows, list) or len(rows) > _MAX_ROWS:
        raise _make_error(path, f'its "{name}" are not a list of at most {_MAX_ROWS:,} rows')
    for row in rows:
        if not isinstance(row, dict) or not isinstance(row.get("method"), str):
            raise _make_error(path, f'a row of its "{name}" has no method')
        for key, value in row.items():
            limit = {"method": _MAX_NAME_LENGTH, "person": _MAX_NAME_LENGTH, "note": _MAX_NOTE_LENGTH}.get(key)
            if not (
                value is None or _is_number(value) if limit is None else isinstance(value, str) and len(value) <= limit
            ):
                raise _make_error(path, f'"{sanitize(key, 40)}" of a row of its "{name}" is {sanitize(value, 40)}')
    return tuple({**row, "method": _rename_method(row["method"])} for row in rows)


def _rename_method(name: str) -> str:
    """Return the present name of a method in a file of any version."""
    for old, new in _OLD_METHODS.items():
        name = name.replace(old, new)
    return name


def _is_number(value: object) -> bool:
    return (
        isinstance(value, (int, float)) and not isinstance(value, bool) and -1e300 < value < 1e300
    ) or value != value


def _make_error(path: str | Path, why: str) -> NergError:
    return NergError(f'"{path}" is no evaluation of a gaze field ({why}); make one with "nerg eval gaze"')


# ---- Verdict ----
#
# A one-sentence verdict on whether a gaze field is useful, based on its scores and those of the baselines.
#
# Rules, for one split:
#
# 1. With fewer than `MIN_PARTICIPANTS` participants or `MIN_POSITIONS` positions there is no verdict.
# 2. The field is compared with three baselines: the uniform density; the position-independent prior, with the kernel
#   that has the higher log score; and the nearest rays. If another baseline has a higher log score than these, it is
#   compared with that, too. The scores are the log score (bits per ray), CC and KLD. A score is decisive if the 95 %
#   confidence interval of the difference excludes zero.
# 3. The field is better if at least two of the three scores are decisive for it and none against it, worse if two are
#   decisive against it and none for it, and undecided otherwise.
# 4. Worse than uniform or the prior: do not use. Undecided against the prior: not shown to be useful. Better
#   than the prior: useful, and the comparison with the nearest rays and any stronger baseline decides whether it
#   is worth a field. The sentence names the strongest baseline, the one with the highest log score.
#
# The intervals are those of the bootstrap over participants (`held_out.evaluate_gaze`), widened for small samples: by
# sqrt(n / (n - 1)), because a bootstrap of n participants is too narrow by this factor, and by Student's quantile with
# n - 1 degrees of freedom in place of 1.96 (Hesterberg, What Teachers Should Know About the Bootstrap, 2015). If only
# the intervals of both methods are known, the half-width of the difference is the sum of theirs, which is never too
# small.

MIN_PARTICIPANTS, MIN_POSITIONS = 5, 10  # Minimum sizes for a verdict

VERDICT_SCORES = {"bits": 1, "CC": 1, "KLD": -1}  # Scores of the verdict; 1: higher is better, -1: lower is better

_BASELINE_NAMES = {
    UNIFORM: "the uniform density",
    PRIOR: f"the {PRIOR}",
    NEAREST_RAYS: "the nearest rays",
    CONDITIONAL_KDE: f"the {CONDITIONAL_KDE}",
    REAIMED_HITS: f"the {REAIMED_HITS}",
    CONDITIONAL_HITS: f"the {CONDITIONAL_HITS}",
    STACK: "the stack of kernels",
}
_OLD_METHODS = {"position-blind": PRIOR, "4,096 nearest rays": NEAREST_RAYS}  # In files of earlier versions

SPLIT_LABELS = {
    "both": "held-out participants at held-out positions",
    "pos": "training participants at held-out positions",
    "people": "held-out participants at training positions",
}
"""Description of each split."""

BETTER, WORSE, UNDECIDED = "better", "worse", "undecided"


@dataclass(frozen=True)
class ScoreDifference:
    """Difference of the field to a baseline in one score, positive if the field is better, with its 95 % confidence
    interval.

    Unknown values are NaN.
    """

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
    """Comparison of the field with one baseline, ``reference``."""

    reference: str
    differences: tuple[ScoreDifference, ...]

    @property
    def outcome(self) -> str:
        """`BETTER` or `WORSE` if at least two scores agree and none disagrees, otherwise `UNDECIDED`."""
        outcomes = [lead.outcome for lead in self.differences]
        for one, other in ((BETTER, WORSE), (WORSE, BETTER)):
            if outcomes.count(one) >= 2 and other not in outcomes:
                return one
        return UNDECIDED


@dataclass(frozen=True)
class Verdict:
    """Verdict on a gaze field.

    Attributes
    ----------
    grade : str
        "use", "limited", "unclear", "reject" or "none".
    sentence : str
        The verdict in a sentence.
    comparisons : tuple of Comparison
        Comparisons with the baselines.
    split_half_fraction : float or None
        CC gain over the position-independent prior as a fraction of the gain of the other half of the participants;
        None if unknown.
    """

    grade: str
    sentence: str
    comparisons: tuple[Comparison, ...] = ()
    split_half_fraction: float | None = None


def compute_verdict(
    rows: Sequence[Mapping[str, Any]], split: str, num_participants: int, num_positions: int
) -> Verdict:
    """Compute the verdict on the first of ``rows``, the field's, compared with the others, which are identified by
    ``method``.

    ``split`` is a key of `SPLIT_LABELS`; ``num_participants`` and ``num_positions`` are those of the test.
    """
    label = SPLIT_LABELS.get(split, split)
    if num_participants < MIN_PARTICIPANTS or num_positions < MIN_POSITIONS:
        return Verdict(
            "none",
            f"No verdict for {label}: {_format_count(num_participants, 'participant', 'participants')} at "
            f"{_format_count(num_positions, 'position', 'positions')} are too few; at least "
            f"{MIN_PARTICIPANTS} participants and {MIN_POSITIONS} positions are needed.",
        )
    field, prior, strongest = rows[0], _find_prior(rows), _find_strongest(rows)
    baselines = {name: _find_row(rows, name) for name in (UNIFORM, NEAREST_RAYS)}
    compare = lambda name, row: Comparison(
        name, tuple(compare_scores(field, row, score, num_participants) for score in VERDICT_SCORES)
    )
    pairs = [(UNIFORM, baselines[UNIFORM]), (PRIOR, prior), (NEAREST_RAYS, baselines[NEAREST_RAYS])]
    if strongest not in ("", *(name for name, _ in pairs)):
        pairs.append((strongest, _find_row(rows, strongest)))
    comparisons = tuple(compare(name, row) for name, row in pairs if row is not None)
    split_half_fraction = _compute_split_half_fraction(field, prior, _find_row(rows, SPLIT_HALF))
    grade, sentence = _write_verdict(comparisons, strongest, label, num_participants)
    return Verdict(grade, sentence, comparisons, split_half_fraction)


_PLAIN_SPLITS = {
    "both": "other participants at other positions than in its training",
    "pos": "the participants of its training at other positions",
    "people": "other participants at the positions of its training",
}
_PLAIN_PRIOR = f"one average for all positions ({PRIOR})"
_PLAIN_RAYS = f"copying the gaze recorded closest by ({NEAREST_RAYS})"


def explain_verdict(verdict: Verdict, split: str) -> str:
    """Return the verdict for readers who do not know the terms, which follow in parentheses."""
    outcome = {c.reference: c.outcome for c in verdict.comparisons}
    where = f'tested on {_PLAIN_SPLITS.get(split, split)} (split "{split}")'
    if verdict.grade == "none":
        return f"Verdict: there is too little test data to judge the prediction, {where}."
    if verdict.grade == "reject":
        return f"Verdict: do not use the prediction of where people look; {where}, it is worse than simple guesses."
    if verdict.grade == "unclear":
        return f"Verdict: {where}, the prediction of where people look is not shown to be better than {_PLAIN_PRIOR}."
    better = f"Verdict: {where}, the prediction of where people look is better than {_PLAIN_PRIOR}"
    if verdict.grade == "use":
        return f"{better}, than {_PLAIN_RAYS}, and than the best of all simple methods (baselines)."
    if outcome.get(NEAREST_RAYS) == BETTER:
        return f"{better} and than {_PLAIN_RAYS}, but not shown to be better than every simple method (baseline)."
    return f"{better}, but not shown to be better than {_PLAIN_RAYS}."


def compare_scores(
    field: Mapping[str, Any], other: Mapping[str, Any], score: str, num_participants: int
) -> ScoreDifference:
    """Return the difference in ``score`` between the rows ``field`` and ``other``, with its confidence interval."""
    sign, nan = VERDICT_SCORES[score], math.nan
    value = sign * (_read_number(field, score) - _read_number(other, score))
    half_width = _read_half_width(other, f"{score}.gap")
    if math.isnan(half_width):
        half_width = _read_half_width(field, score) + _read_half_width(other, score)
    if math.isnan(value) or math.isnan(half_width) or num_participants < 2:
        return ScoreDifference(score, value, nan, nan)
    half_width *= small_sample_factor(num_participants)
    return ScoreDifference(score, value, value - half_width, value + half_width)


def small_sample_factor(num_participants: int) -> float:
    """Return the factor by which a small sample widens a bootstrap interval of 1.96 standard errors."""
    from scipy.special import stdtrit

    return float(math.sqrt(num_participants / (num_participants - 1)) * stdtrit(num_participants - 1, 0.975) / 1.96)


def _write_verdict(
    comparisons: Sequence[Comparison], strongest: str, label: str, num_participants: int
) -> tuple[str, str]:
    outcome = {c.reference: c.outcome for c in comparisons}
    name_baseline = lambda name: _BASELINE_NAMES.get(name, name)
    if PRIOR not in outcome:
        return "none", f"No verdict for {label}: the evaluation has no {PRIOR}."
    if all(math.isnan(difference.low) for c in comparisons for difference in c.differences):
        return "none", f"No verdict for {label}: the scores have no intervals; evaluate with bootstrap resamples."
    for name in (UNIFORM, PRIOR):
        if outcome.get(name) == WORSE:
            return "reject", f"Worse than {name_baseline(name)} for {label}: do not use."
    if outcome[PRIOR] == UNDECIDED:
        return (
            "unclear",
            f"Not shown to be better than {name_baseline(PRIOR)} for {label}: record more participants before relying "
            "on the position.",
        )
    better = f"Better than {name_baseline(PRIOR)}"
    if NEAREST_RAYS not in outcome:
        return "limited", f"{better} for {label}; not compared with {name_baseline(NEAREST_RAYS)}."
    other_outcomes = {name: result for name, result in outcome.items() if name not in (UNIFORM, PRIOR)}
    for name, result in other_outcomes.items():
        if result == WORSE:
            return "limited", f"{better}, but worse than {name_baseline(name)} for {label}: use the rays directly."
    for name, result in other_outcomes.items():
        if result == UNDECIDED:
            return (
                "limited",
                f"{better} for {label}; the comparison with {name_baseline(name)} is undecided with {num_participants} "
                "participants.",
            )
    if not strongest:
        return "use", f"Better than {name_baseline(NEAREST_RAYS)} for {label}."
    rest = "" if strongest == NEAREST_RAYS else f"and than {name_baseline(NEAREST_RAYS)} "
    return "use", f"Better than {name_baseline(strongest)}, the strongest baseline, {rest}for {label}."


def _find_strongest(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the name of the baseline with the highest log score; "" if none has one.

    The samples that score choose it, which favours the baselines and never the field. The split half is not a baseline,
    and all kernels of the prior share one name.
    """
    scored = [r for r in rows[1:] if r.get("method") != SPLIT_HALF and not math.isnan(_read_number(r, "bits"))]
    best = max(scored, key=lambda r: _read_number(r, "bits"), default={})
    name = str(best.get("method", ""))
    return PRIOR if name.startswith(PRIOR) else name


def _find_prior(rows: Sequence[Mapping[str, Any]]) -> Mapping[str, Any] | None:
    """Return the row of the position-independent prior with the highest log score."""
    candidates = [r for r in rows[1:] if str(r.get("method", "")).startswith(PRIOR)]
    scored = [r for r in candidates if not math.isnan(_read_number(r, "bits"))]
    return max(scored or candidates, key=lambda r: _read_number(r, "bits"), default=None)


def _find_row(rows: Sequence[Mapping[str, Any]], name: str) -> Mapping[str, Any] | None:
    return next((r for r in rows[1:] if r.get("method") == name), None)


def _compute_split_half_fraction(
    field: Mapping[str, Any], prior: Mapping[str, Any] | None, half: Mapping[str, Any] | None
):
    if prior is None or half is None:
        return None
    half_gain = _read_number(half, "CC") - _read_number(prior, "CC")
    fraction = (_read_number(field, "CC") - _read_number(prior, "CC")) / half_gain if half_gain > 0 else math.nan
    return fraction if math.isfinite(fraction) else None


def _read_number(row: Mapping[str, Any], key: str) -> float:
    value = row.get(key)
    return float(value) if isinstance(value, (int, float)) and math.isfinite(value) else math.nan


def _read_half_width(row: Mapping[str, Any], key: str) -> float:
    return (_read_number(row, f"{key}.high") - _read_number(row, f"{key}.low")) / 2


def _format_count(number: int, one: str, several: str) -> str:
    return f"{number} {one if number == 1 else several}"
