"""Events and data quality of recordings, next to those of other libraries on the same samples.

    python benchmarks/gaze_events.py [--data DIR]

Needs ``pip install ETDQualitizer pymovements eyedentify3d``. One participant each of the supermarket (50 Hz) and of two
EyeNavGS scenes (71 Hz):

- Data quality: those of `nerg_mi.tracking.quality.measure_recordings`, and ETDQualitizer's for the same angles.
- Fixations by velocity: the samples of `nerg_mi.tracking.events.label_fixations`, and of pymovements' I-VT for the
  same velocities. There a sample has the velocity of the step before it, so that an event begins one sample later: its
  minimum duration is set one interval shorter.
- Events: those of `nerg_mi.tracking.events.detect_events`, and EyeDentify3D's. Cohen's kappa over samples, and the
fraction
  of saccades that overlap one of the other method. Pauses are filled with invalid samples for EyeDentify3D.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from nerg_mi.tracking.event_settings import EventRules
from nerg_mi.tracking.events import Events, angles_about, detect_events, label_fixations, measure_velocities
from nerg_mi.tracking.quality import measure_recordings
from nerg_mi.tracking.rays import Rays
from nerg_mi.tracking.readers.registry import read_rays
from timing import save_result

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
RECORDINGS = {
    "supermarket": ("vr_supermarket", "vr_supermarket/gaze_user10_supermarket.csv.gz"),
    "room": ("eyenavgs", "eyenavgs/room/user103_room.csv.gz"),
    "truck": ("eyenavgs", "eyenavgs/truck/user105_truck.csv.gz"),
}
FIXATIONS = ("fixation", "vor_fixation", "smooth_pursuit")


def compare_quality(name: str, rays: Rays, events: Events) -> list[dict]:
    import ETDQualitizer

    (quality,) = measure_recordings(rays, events=events)
    precision = []
    for k in np.flatnonzero(np.isin(events.kind, ("fixation", "vor_fixation"))):
        rows = slice(events.first[k], events.last[k] + 1)
        d = rays.direction[rows]
        angles = angles_about(d, np.broadcast_to(events.direction[k], d.shape))
        fixation = ETDQualitizer.DataQuality(*angles.T, rays.t[rows], "degrees")
        precision.append((fixation.precision_RMS_S2S()[0], fixation.precision_STD()[0]))
    recording = ETDQualitizer.DataQuality(rays.direction[:, 0], rays.direction[:, 1], rays.t, "degrees")
    rms, std = np.median(precision, axis=0)
    pairs = {
        "RMS-S2S [deg]": (quality.rms_s2s, rms),
        "STD [deg]": (quality.std, std),
        "effective frequency [Hz]": (quality.effective_frequency, recording.effective_frequency()),
        "data loss [%]": (quality.data_loss, recording.data_loss_from_expected(quality.frequency)),
    }
    return [
        {"recording": name, "measure": what, "nerg_mi": ours, "ETDQualitizer": theirs, "difference": abs(ours - theirs)}
        for what, (ours, theirs) in pairs.items()
    ]


def label_samples(rays: Rays, events: Events, kinds: tuple[str, ...]) -> np.ndarray:
    """Whether each sample is in an event of these kinds, (N,) bool: those after the first one of the event."""
    out = np.zeros(len(rays), bool)
    for k in np.flatnonzero(np.isin(events.kind, kinds)):
        out[events.first[k] + 1 : events.last[k] + 1] = True
    return out


def kappa(a: np.ndarray, b: np.ndarray) -> float:
    """Cohen's kappa of two labellings (N,) bool."""
    observed, chance = np.mean(a == b), a.mean() * b.mean() + (1 - a.mean()) * (1 - b.mean())
    return float((observed - chance) / (1 - chance))


def overlap(spans: list[tuple[int, int]], others: np.ndarray) -> float:
    """Fraction of spans of samples in which the labelling ``others`` (N,) is true somewhere."""
    return float(np.mean([others[a : b + 1].any() for a, b in spans])) if spans else float("nan")


def compare_velocity_threshold(name: str, rays: Rays) -> dict:
    from pymovements.events import ivt

    v = measure_velocities(rays)
    # By velocity alone.
    rules = EventRules(velocity_threshold=100.0, min_fixation=0.06, max_step=10.0, merge_gap=0.0, pursuit_velocity=1e6)
    ours, _ = label_fixations(rays, rules)
    velocity = np.r_[v.gaze[:1], v.gaze]
    t = np.rint(1000 * rays.t).astype(int)
    shortest = round(60 - 1000 * float(np.median(np.diff(rays.t))))
    frame = ivt(np.stack([velocity, 0 * velocity], axis=1), t, shortest, velocity_threshold=100.0).frame
    theirs = np.zeros(len(rays), bool)
    for onset, offset in zip(frame["onset"].to_list(), frame["offset"].to_list()):
        theirs[(t >= onset) & (t <= offset)] = True
    slow = np.r_[False, (ours[1:] >= 0) & (ours[1:] == ours[:-1])]
    return {
        "recording": name,
        "fixations": int(ours.max()) + 1,
        "of pymovements": len(frame),
        "kappa": kappa(slow, theirs),
    }


def compare_events(name: str, rays: Rays, events: Events) -> list[dict]:
    labels = run_eyedentify3d(rays)
    ours = {"saccade": ("saccade",), "fixation or pursuit": FIXATIONS}
    theirs = {"saccade": labels["saccade"], "fixation or pursuit": labels["fixation"] | labels["smooth_pursuit"]}
    rows = []
    for kind, kinds in ours.items():
        mask = np.isin(events.kind, kinds)
        mine = label_samples(rays, events, kinds)
        spans = list(zip(events.first[mask] + 1, events.last[mask]))
        other = find_spans(theirs[kind])
        rows.append(
            {
                "recording": name,
                "kind": kind,
                "nerg_mi": int(mask.sum()),
                "EyeDentify3D": len(other),
                "share of samples": float(mine.mean()),
                "of EyeDentify3D": float(theirs[kind].mean()),
                "kappa": kappa(mine, theirs[kind]),
                "ours that overlap": overlap(spans, theirs[kind]),
                "theirs that overlap": overlap(other, mine),
            }
        )
    return rows


def find_spans(mask: np.ndarray) -> list[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.r_[False, mask, False].astype(int)))
    return [(int(a), int(b) - 1) for a, b in edges.reshape(-1, 2)]


def run_eyedentify3d(rays: Rays) -> dict[str, np.ndarray]:
    """Labels (N,) bool of the samples by kind."""
    from eyedentify3d import GazeBehaviorIdentifier
    from eyedentify3d.data_parsers.reduced_data import ReducedData

    interval = float(np.median(np.diff(rays.t)))
    # A sample for each interval of a pause, which is invalid.
    missing = np.maximum(np.rint(np.diff(rays.t) / interval).astype(int) - 1, 0)
    position = np.r_[0, np.cumsum(1 + missing)]
    n = position[-1] + 1
    t, gaze, eye = np.interp(np.arange(n), position, rays.t), np.full((3, n), np.nan), np.full((3, n), np.nan)
    gaze[:, position] = rays.direction.T
    # Axes of an upright head.
    forward = rays.head.astype(float)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    axes = np.stack([right, np.cross(right, forward), forward], axis=1)
    eye[:, position] = np.einsum("nij,nj->in", axes, rays.direction)
    eye /= np.linalg.norm(eye, axis=0)
    invalid = np.isnan(gaze[0])
    still = np.zeros((3, n))
    data = ReducedData(interval, t, np.ones(n), np.ones(n), eye, still, gaze, still, np.zeros(n), invalid)
    identifier = GazeBehaviorIdentifier(data)
    identifier.detect_invalid_sequences()
    identifier.detect_saccade_sequences()
    identifier.detect_visual_scanning_sequences()
    # Its default windows of 22 ms, made for 200 Hz, have too few samples at these rates.
    windows = {"inter_saccade_minimal_duration": 6 * interval, "window_duration": 6 * interval}
    identifier.detect_fixation_and_smooth_pursuit_sequences(**windows, window_overlap=3 * interval)
    out = {}
    for kind in ("saccade", "visual_scanning", "fixation", "smooth_pursuit"):
        label = np.zeros(n, bool)
        for sequence in getattr(identifier, kind).sequences:
            label[sequence] = True
        out[kind] = label[position]
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    default = Path(os.environ.get("NERG_DATA", ROOT.parent / "shared" / "data"))
    parser.add_argument("--data", type=Path, default=default, help="Folder of the recordings.")
    arguments = parser.parse_args()
    quality, fixations, kinds = [], [], []
    for name, (preset, file) in RECORDINGS.items():
        rays = read_rays(preset, arguments.data / file)
        events = detect_events(rays)
        quality += compare_quality(name, rays, events)
        fixations.append(compare_velocity_threshold(name, rays))
        kinds += compare_events(name, rays, events)
    tables = {"events-quality": quality, "events-fixations": fixations, "events-kinds": kinds}
    for name, rows in tables.items():
        cells = [[f"{v:.4g}" if isinstance(v, float) else v for v in row.values()] for row in rows]
        save_result(name, list(rows[0]), cells)


if __name__ == "__main__":
    main()
