"""The card in words; what its figures are is tried in test_summary.py."""

import numpy as np

from nerg_mi.rays.quality import WARNING, card_lines, card_table, summarise
from nerg_mi.rays.rays import FRAME, Rays


def card(**change):
    n = 200
    origin = np.stack([0.02 * np.arange(n), np.zeros(n), np.full(n, 1.6)], axis=1)
    values = dict(
        t=0.02 * np.arange(n),
        person=np.arange(n) // 20,
        persons=tuple("abcdefghij"),
        origin=origin,
        direction=np.tile([1.0, 0, 0], (n, 1)),
        confidence=np.ones(n),
    )
    rays = Rays(**{**values, **change})
    return card_lines(rays, summarise(rays))


def test_lines():
    about = {
        "frame": dict(FRAME),
        "source_frame": {"up": "y", "handedness": "left", "units": "cm"},
        "rows_read": 210,
        "dropped": [
            {"reason": "blink", "file": "a.csv", "count": 9, "rows": [[2, 4], [7, 7], [9, 9], [11, 14]]},
            {"reason": "blink", "file": "b.csv", "count": 1, "rows": [[3, 3]]},
        ],
        "steps": [{"step": "split", "side": "test", "kept": 200, "of": 300}],
    }
    lines = dict(card(metadata=about))
    assert lines["rays"] == "200 of 210 rows" and lines["persons"] == "10: a, b, c, d, e, f, g, h, ..."
    assert lines["recorded time"] == "3.8 s at 50 rays a second"
    assert lines["dropped"] == "10 (4.8 %): blink; lines 2-4, 7, 9, ... of a.csv and of 1 more"
    assert lines["then"] == "split test: 200 of 300 rays kept" and lines["from"] == "y up, left-handed, cm"
    assert lines["eye height"] == "1.60 m (5 to 95 %: 1.60 to 1.60)" and lines["speed"] == "95 % below 1.00 m/s"
    assert not {"cohorts", "hit points", "duplicates", WARNING} & set(lines)


def test_lines_that_are_not_always_there():
    n = 200
    hit = np.tile([9.0, 0, 1.6], (n, 1))
    hit[50:] = np.nan
    lines = dict(card(hit=hit, cohort=np.arange(n) % 2, cohorts=("new", "old"), t=np.zeros(n)))
    assert lines["cohorts"] == "new 100, old 100" and lines["hit points"].startswith("25.0 % of the rays")
    assert lines["recorded time"].startswith("unknown") and lines["speed"].startswith("unknown")
    assert lines["duplicates"] == "190 rays share person and time with another"
    assert "have the same time" in lines[WARNING]
    slow = dict(card(t=10.0 * np.arange(n)))
    assert slow["recorded time"].startswith("none: each ray of a person comes more than 1 s")


def test_names_are_shown_as_they_are():
    """A person or a file may be called what the terminal's library takes for a colour."""
    eyes, ahead = np.zeros((3, 3)), np.tile([1.0, 0.0, 0.0], (3, 1))
    rays = Rays(np.arange(3.0), [0, 0, 1], ("[red]", "[/b]"), eyes, ahead, np.ones(3))
    shown = card_table(rays, summarise(rays), "[bold].npz")
    assert "[bold].npz" in shown and "[red]" in shown and "[/b]" in shown
