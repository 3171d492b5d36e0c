"""Whether a gaze field is worth using, in a sentence: its scores beside those of what needs no field.

The rule, for one split:

1. Fewer than `LEAST_PEOPLE` people or `LEAST_POSITIONS` positions give no verdict, whatever the scores are.
2. The field is compared with three references: the uniform density; the position-blind one, of whose kernels that
   with the higher log score is taken; and the nearest rays. Where another baseline has a higher log score than all of
   these, with that one, too. The scores are the log score (bits a ray), CC and KLD. One of them decides where the 95 %
   interval of the field's lead leaves out zero.
3. The field is better where at least two of the three scores decide for it and none against it, worse where two decide
   against it and none for it, and undecided otherwise.
4. Worse than uniform or than position-blind: do not use it. Undecided beside position-blind: not shown to be of use.
   Better than position-blind: of use, and the nearest rays, with whatever is stronger, say whether it is worth a field.
   The sentence names the strongest baseline, which is the one with the highest log score.

Intervals are those of the bootstrap over people (`evaluation.evaluate_gaze`), made wider for few: by sqrt(n / (n -
1)), since a bootstrap of n people is too narrow by as much, and by Student's quantile of n - 1 degrees of freedom in
place of 1.96 (Hesterberg, What Teachers Should Know About the Bootstrap, 2015). Where only the two methods' own
intervals are known, the reach of the lead is the sum of theirs, which is never too small.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

LEAST_PEOPLE, LEAST_POSITIONS = 5, 10
"""Below these there is no verdict."""

DECIDING = {"bits": 1, "CC": 1, "KLD": -1}
"""The scores that decide, and whether more (1) or less (-1) is better."""

UNIFORM, BLIND, NEAREST, HALF = "uniform", "position-blind", "4,096 nearest rays", "split half"
"""Names of the methods that a field is compared with."""

WORDS = {
    "both": "new people at new places",
    "pos": "known people at new places",
    "people": "new people at places where others were",
}
"""Each split, in words."""

BETTER, WORSE, UNDECIDED = "better", "worse", "undecided"


@dataclass(frozen=True)
class Lead:
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
    leads: tuple[Lead, ...]

    @property
    def outcome(self) -> str:
        """`BETTER`, `WORSE` or `UNDECIDED`, by at least two scores and none against them."""
        found = [lead.outcome for lead in self.leads]
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
    half: float | None = None


def judge(rows: Sequence[Mapping[str, Any]], split: str, people: int, positions: int) -> Verdict:
    """The verdict on the first of ``rows``, the field's, beside the others, which are told apart by ``method``.

    ``split``: a word of `WORDS`; ``people``, ``positions``: in the test.
    """
    whom = WORDS.get(split, split)
    if people < LEAST_PEOPLE or positions < LEAST_POSITIONS:
        return Verdict(
            "none",
            f"No verdict for {whom}: {_count(people, 'person', 'people')} at {_count(positions, 'place', 'places')} "
            f"are too few; it takes {LEAST_PEOPLE} people and {LEAST_POSITIONS} places.",
        )
    field, blind, strongest = rows[0], _blind(rows), _strongest(rows)
    found = {name: _row(rows, name) for name in (UNIFORM, NEAREST)}
    compare = lambda name, row: Comparison(name, tuple(lead_of(field, row, score, people) for score in DECIDING))
    pairs = [(UNIFORM, found[UNIFORM]), (BLIND, blind), (NEAREST, found[NEAREST])]
    if strongest not in ("", *(name for name, _ in pairs)):
        pairs.append((strongest, _row(rows, strongest)))
    comparisons = tuple(compare(name, row) for name, row in pairs if row is not None)
    half = _way_to_half(field, blind, _row(rows, HALF))
    grade, sentence = _words(comparisons, strongest, whom, people)
    return Verdict(grade, sentence, comparisons, half)


def lead_of(field: Mapping[str, Any], other: Mapping[str, Any], score: str, people: int) -> Lead:
    """The lead of the row ``field`` before the row ``other`` in ``score``, with an interval for so many ``people``."""
    sign, nan = DECIDING[score], math.nan
    value = sign * (_number(field, score) - _number(other, score))
    reach = _reach(other, f"{score}.gap")
    if math.isnan(reach):
        reach = _reach(field, score) + _reach(other, score)
    if math.isnan(value) or math.isnan(reach) or people < 2:
        return Lead(score, value, nan, nan)
    reach *= widening(people)
    return Lead(score, value, value - reach, value + reach)


def widening(people: int) -> float:
    """How much wider the interval of a mean over so many ``people`` is than 1.96 standard errors of their bootstrap."""
    from scipy.special import stdtrit

    return float(math.sqrt(people / (people - 1)) * stdtrit(people - 1, 0.975) / 1.96)


def _words(comparisons: Sequence[Comparison], strongest: str, whom: str, people: int) -> tuple[str, str]:
    outcome = {c.reference: c.outcome for c in comparisons}
    if BLIND not in outcome:
        return "none", f"No verdict for {whom}: the evaluation has no position-blind density to compare with."
    for name, words in ((UNIFORM, "worse than knowing nothing"), (BLIND, "worse than position-blind")):
        if outcome.get(name) == WORSE:
            return "reject", f"{words.capitalize()} for {whom}: do not use."
    if outcome[BLIND] == UNDECIDED:
        return (
            "unclear",
            f"Not shown to be better than position-blind for {whom}: do not rely on where people stand without more of "
            "them.",
        )
    if NEAREST not in outcome:
        return "limited", f"Better than position-blind for {whom}; it was not compared with nearest rays."
    others = {name: result for name, result in outcome.items() if name not in (UNIFORM, BLIND)}
    shown = {NEAREST: "nearest rays"}
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
    rest = "" if strongest == NEAREST else "and than nearest rays "
    return "use", f"Better than {shown.get(strongest, strongest)}, the strongest baseline, {rest}for {whom}."


def _strongest(rows: Sequence[Mapping[str, Any]]) -> str:
    """The baseline whose log score is the highest, by its name; "" where none has one. The other half of the people is
    no baseline, and kernels of the position-blind density have one name."""
    scored = [r for r in rows[1:] if r.get("method") != HALF and not math.isnan(_number(r, "bits"))]
    best = max(scored, key=lambda r: _number(r, "bits"), default={})
    name = str(best.get("method", ""))
    return BLIND if name.startswith(BLIND) else name


def _blind(rows: Sequence[Mapping[str, Any]]) -> Mapping[str, Any] | None:
    """The position-blind density whose log score is the highest."""
    found = [r for r in rows[1:] if str(r.get("method", "")).startswith(BLIND)]
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
