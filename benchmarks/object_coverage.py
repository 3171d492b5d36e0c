"""Coverage of 95 % intervals of AOI statistics, and the rate at which equal groups are found to differ.

    python benchmarks/object_coverage.py shares        # intervals of fractions of participants, computed exactly
    python benchmarks/object_coverage.py ratios        # methods for intervals of ratios of sums over participants
    python benchmarks/object_coverage.py numbers       # the interval of each statistic of `nerg stats`
    python benchmarks/object_coverage.py few           # methods for statistics that depend on few participants
    python benchmarks/object_coverage.py differences   # differences between two groups of one population
    python benchmarks/object_coverage.py tails         # means of skewed values, with and without smoothed draws

The population consists of 8,000 visits of the demo store's shoppers: 200 walks, each with 40 independent draws of gaze
from the store's law. Its statistics are the true values. A data set is a sample of visits with replacement. The AOIs
are the store's 30 goods, which almost all shoppers look at, and 15 labels of 12 cm on them, which few look at.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from pathlib import Path
from unittest import mock

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)
from nerg_mi.aoi.estimates import adjust_p_values
from nerg_mi.aoi.tables import COMPARED_MEASURES, MEASURES, MEASURES_BY_NAME
from object_statistics import Walks, counting_of, made_store
from timing import save_result

import numpy as np
from scipy import stats

WALKS, VISITS = 200, 40
RESAMPLES = 599
DRAWN = 50
"""Minimum number of data sets with an interval for a statement about an AOI."""


class Population:
    """Numerators and denominators (N, K) of each measure, its ``truth`` (K,), and which AOIs are ``common``: looked at
    by at least half of the participants."""

    def __init__(self, file: Path | None) -> None:
        if file is not None and file.is_file():
            with np.load(file) as selected:
                result = {
                    m.name: (selected[f"x_{m.name}"].astype(float), selected[f"y_{m.name}"].astype(float))
                    for m in MEASURES
                }
        else:
            result = _visits()
            if file is not None:
                np.savez(file, **{f"{w}_{k}": v for k, pair in result.items() for w, v in zip("xy", pair)})
        self.pairs = result
        self.truth = {k: x.sum(axis=0) / y.sum(axis=0) for k, (x, y) in result.items()}
        self.common = self.truth["hit_ratio"] >= 0.5
        self.count = len(result["hit_ratio"][0])

    def draw(self, measure: str, who: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x, y = self.pairs[measure]
        return x[who], y[who]


def _visits() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    from nerg_mi.aoi.areas import Areas
    from nerg_mi.aoi.measured import count_block
    from nerg_mi.aoi.placed import place_areas
    from nerg_mi.aoi.tables import Participants
    from nerg_mi.aoi.visits import ALL
    from nerg_mi.formats.boxes import Region

    store = made_store()
    goods, labels = store.areas, []
    for box in goods.boxes[::2]:
        middle, size = box.center, np.subtract(box.upper, box.lower)
        half = np.where(size == size.min(), size / 2, np.minimum(size / 2, 0.06))
        labels.append(Region.create(f"label of {box.name}", middle - half, middle + half))
    areas = Areas((*goods.areas, *labels))
    counting = counting_of(place_areas(store.environment, store.sampler, areas, {}))
    walks, rng = Walks(WALKS), np.random.default_rng(3)
    result: dict[str, list] = defaultdict(list)
    for _ in range(VISITS):
        people = Participants.from_sums(count_block(walks.rays(np.arange(WALKS), rng), counting), ALL, True)
        for m in MEASURES:
            result[m.name].append(m.numerator_denominator(people))
    made = {k: [np.concatenate(w).astype(float) for w in zip(*v)] for k, v in result.items()}
    return {k: (x, y) for k, (x, y) in made.items()}


def shares(people: tuple[int, ...]) -> None:
    """Coverage for all probabilities, from the binomial distribution."""
    p = np.linspace(0.001, 0.999, 1997)
    rows = []
    for name, interval in _share_intervals().items():
        for n in people:
            k = np.arange(n + 1)
            low, high = interval(k, np.full(n + 1, n))
            weight = stats.binom.pmf(k[:, None], n, p)
            held = (weight * ((low[:, None] <= p) & (p <= high[:, None]))).sum(axis=0)
            width = (weight * (high - low)[:, None]).sum(axis=0).mean()
            percent = [f"{100 * v:.1f} %" for v in (held.mean(), held.min(), (held < 0.9).mean())]
            rows.append([name, n, *percent, f"{width:.3f}"])
    head = ["interval of a proportion", "participants", "mean coverage", "minimum", "coverage below 90 %", "mean width"]
    save_result("statistics-proportions", head, rows)


def _share_intervals() -> dict:
    from nerg_mi.aoi.estimates import mid_p_interval

    z = stats.norm.ppf(0.975)
    cut = lambda low, high: (np.maximum(low, 0), np.minimum(high, 1))

    def wald(x, n):
        half = z * np.sqrt(x / n * (1 - x / n) / n)
        return cut(x / n - half, x / n + half)

    def wilson(x, n):
        middle = (x + z**2 / 2) / (n + z**2)
        half = z * np.sqrt(x * (n - x) / n + z**2 / 4) / (n + z**2)
        return cut(middle - half, middle + half)

    def agresti_coull(x, n):
        middle = (x + z**2 / 2) / (n + z**2)
        half = z * np.sqrt(middle * (1 - middle) / (n + z**2))
        return cut(middle - half, middle + half)

    def beta(extra):
        def ends(x, n):
            low = stats.beta.ppf(0.025, x + extra, n - x + 1 - extra)
            high = stats.beta.ppf(0.975, x + 1 - extra, n - x + extra)
            return np.where(x == 0, 0, low), np.where(x == n, 1, high)

        return ends

    return {
        "Wald": wald,
        "Wilson (1927)": wilson,
        "Agresti and Coull (1998)": agresti_coull,
        "Jeffreys": beta(0.5),
        "Clopper and Pearson (1934)": beta(0.0),
        "mid-p (kept)": mid_p_interval,
    }


def ratio_intervals(x: np.ndarray, y: np.ndarray, seed: int) -> dict:
    """Ends of the intervals (K,) of Σ x / Σ y by several methods."""
    n, count = (y > 0).sum(axis=0), len(x)
    m = x.sum(axis=0) / y.sum(axis=0)
    wider = n / (n - 1)
    s = np.sqrt(((x - m * y) ** 2).sum(axis=0) * wider) / y.sum(axis=0)
    without = (x.sum(axis=0) - x) / (y.sum(axis=0) - y)
    jack = np.sqrt((((without - m) ** 2) * (y > 0)).sum(axis=0) / wider)
    c = stats.t.ppf(0.975, n - 1)
    logit, expit = (lambda v: np.log(v / (1 - v))), (lambda v: 1 / (1 + np.exp(-v)))
    half = c * jack / (m * (1 - m))
    out = {
        "linearised, Student's t": (m - c * s, m + c * s),
        "jackknife, Student's t": (m - c * jack, m + c * jack),
        "jackknife, logit, Student's t": (expit(logit(m) - half), expit(logit(m) + half)),
    }
    w = np.random.default_rng(seed).multinomial(count, np.full(count, 1 / count), size=RESAMPLES).astype(float)
    sx, sy = w @ x, w @ y
    star = sx / sy
    spread = np.maximum((w @ x**2 - 2 * star * (w @ (x * y)) + star**2 * (w @ y**2)) / sy**2, 0) * wider
    t = (star - m) / np.sqrt(0.99 * spread + 0.01 * s**2)
    low, high = np.nanquantile(t, (0.025, 0.975), axis=0)
    out["bootstrap, percentiles"] = tuple(np.nanquantile(star, (0.025, 0.975), axis=0))
    out["BCa bootstrap"] = _bca(star, m, without)
    out["bootstrap-t, two tails"] = (m - high * s, m - low * s)
    for name, bandwidth in (("symmetric bootstrap-t, jackknife", 0.0), ("the same, smoothed upper limit (kept)", None)):
        selected = _estimate_with(bandwidth, x, y, seed)
        out[name] = (selected.low, selected.high)
    return out


def _estimate_with(bandwidth: float | None, x: np.ndarray, y: np.ndarray, seed: int = 0):
    """Estimates whose upper limit is from draws smoothed by ``bandwidth``; None: the default's."""
    from nerg_mi.aoi import estimates

    with mock.patch.object(estimates, "BANDWIDTH", estimates.BANDWIDTH if bandwidth is None else bandwidth):
        return estimates.estimate_ratios(x, y, resamples=RESAMPLES, seed=seed)


def _bca(star: np.ndarray, m: np.ndarray, without: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Efron (1987)."""
    order = np.sort(star, axis=0)
    bias = stats.norm.ppf(np.clip((star < m).mean(axis=0) + 0.5 * (star == m).mean(axis=0), 1e-3, 1 - 1e-3))
    pull = without.mean(axis=0) - without
    bend = (pull**3).sum(axis=0) / (6 * (pull**2).sum(axis=0) ** 1.5)
    ends = []
    for z in stats.norm.ppf((0.025, 0.975)):
        at = stats.norm.cdf(bias + (bias + z) / (1 - bend * (bias + z)))
        row = np.clip((np.nan_to_num(at, nan=0.5) * len(star)).astype(int), 0, len(star) - 1)
        ends.append(order[row, np.arange(order.shape[1])])
    return ends[0], ends[1]


class Held:
    """Coverage of the ``truth`` (K,) by intervals, per AOI."""

    def __init__(self, truth: np.ndarray, common: np.ndarray, maximum: float):
        self.truth, self.common, self.max_error = truth, common, maximum
        self.rows: list[np.ndarray] = []

    def add(self, low: np.ndarray, high: np.ndarray, expected: np.ndarray) -> None:
        low, high = np.clip(low, 0, self.max_error), np.clip(high, 0, self.max_error)
        inside = expected & (low <= self.truth + 1e-12) & (self.truth <= high + 1e-12)
        self.rows.append(np.stack([inside, expected, np.where(expected, (high - low) / self.truth, np.nan)]))

    def cells(self, common: bool) -> list[str]:
        """Mean, minimum, median width and number of missing intervals, for common and rare AOIs."""
        inside, expected, width = (v[:, self.common == common] for v in np.moveaxis(np.array(self.rows, float), 1, 0))
        some = expected.sum(axis=0) >= DRAWN
        if not some.any():
            return ["", "", "", "100 %"]
        each = inside.sum(axis=0)[some] / expected.sum(axis=0)[some]
        middle = np.nanmedian(np.nanmedian(width[:, some], axis=0))
        missing = f"{100 * (1 - expected.mean()):.0f} %"
        return [f"{100 * each.mean():.1f} %", f"{100 * each.min():.1f} %", f"{100 * middle:.0f} %", missing]


_OF_INTERVALS = ["coverage", "minimum over AOIs", "median width", "without interval"]
HEAD = ["participants", *_OF_INTERVALS, *(f"rare AOIs: {title}" for title in _OF_INTERVALS)]


def compare(
    population: Population, sets: int, people: tuple[int, ...], names: tuple[str, ...], variants=ratio_intervals
) -> list[list]:
    """The statistic, the interval and the cells of `HEAD` for each row."""
    rows = []
    for name in names:
        for n in people:
            rng, result = np.random.default_rng(n), {}
            for _ in range(sets):
                x, y = population.draw(name, rng.integers(0, population.count, n))
                with np.errstate(all="ignore"):
                    made = variants(x, y, int(rng.integers(1 << 30)))
                expected = np.isfinite(next(ends for method, ends in made.items() if "kept" in method)[0])
                for direction, (low, high) in made.items():
                    held = Held(population.truth[name], population.common, MEASURES_BY_NAME[name].upper_limit)
                    result.setdefault(direction, held).add(low, high, expected)
            rows += [[name, kind, n, *held.cells(True), *held.cells(False)] for kind, held in result.items()]
    return rows


def few_intervals(x: np.ndarray, y: np.ndarray, seed: int) -> dict:
    """Ends of the intervals (K,) with other factors of the error where few participants determine a number."""
    from nerg_mi.aoi import estimates

    selected = _estimate_with(0.0, x, y, seed)
    value, _, people = estimates._linearize(x, y)
    difference = estimates._jackknife(x, y, value, people)
    error, square = np.sqrt((difference**2).sum(axis=0)), difference**2
    c = (selected.high - value) / error
    few = (people <= len(x) / 2) & (np.where(y > 0, y, np.inf).min(axis=0) < y.max(axis=0))
    t = lambda freedom: stats.t.ppf(0.975, np.maximum(freedom, 1.0))
    effective = square.sum(axis=0) ** 2 / (square**2).sum(axis=0)
    adds = (x != 0).sum(axis=0)
    factors = {
        "symmetric": c,
        "at least t of half the freedom": np.where(few, np.maximum(c, t((effective - 1) / 2)), c),
        "at least t of all by the largest": np.where(few, np.maximum(c, t(square.sum(0) / square.max(0) - 1)), c),
        "at least t, two thirds": np.where(people <= len(x) * 2 / 3, np.maximum(c, t(effective - 1)), c),
        "t alone": np.where(adds <= len(x) / 2, t(effective - 1), c),
        "at most t of those who add": np.where(adds <= len(x) / 2, np.minimum(c, t(adds - 1)), c),
    }
    made = {name: (value - factor * error, value + factor * error) for name, factor in factors.items()}
    smoothed = _estimate_with(None, x, y, seed)
    return made | {"smoothed upper limit (kept)": (smoothed.low, smoothed.high)}


def numbers(population: Population, sets: int, people: tuple[int, ...]) -> None:
    from nerg_mi.aoi.estimates import estimate_proportions, estimate_ratios

    rows = []
    for n in people:
        rng = np.random.default_rng(n)
        result = {m.name: Held(population.truth[m.name], population.common, m.upper_limit) for m in MEASURES}
        for _ in range(sets):
            who, seed = rng.integers(0, population.count, n), int(rng.integers(1 << 30))
            for m in MEASURES:
                x, y = population.draw(m.name, who)
                e = (
                    estimate_proportions(x, y)
                    if m.is_proportion
                    else estimate_ratios(x, y, resamples=RESAMPLES, seed=seed, upper_limit=m.upper_limit)
                )
                result[m.name].add(e.low, e.high, np.isfinite(e.low))
        rows += [[name, n, *held.cells(True), *held.cells(False)] for name, held in result.items()]
    save_result("statistics-coverage", ["statistic", *HEAD], rows, "the number of participants")


def differences(population: Population, sets: int, pairs: tuple[tuple[int, int], ...]) -> None:
    """Rate at which two groups of one population are found to differ, p <= 0.05, before and after the adjustment."""
    from nerg_mi.aoi.estimates import estimate_proportion_differences, estimate_ratio_differences

    rows = []
    for m, n in pairs:
        rng, result, wrong = np.random.default_rng([m, n]), defaultdict(list), []
        first = (np.arange(m + n) < m).astype(float)[:, None]
        for _ in range(sets):
            who, seed = rng.integers(0, population.count, m + n), int(rng.integers(1 << 30))
            every = []
            for name in COMPARED_MEASURES:
                x, y = population.draw(name, who)
                a, b = (x * first, y * first), (x * (1 - first), y * (1 - first))
                if MEASURES_BY_NAME[name].is_proportion:
                    d = estimate_proportion_differences(a, b)
                else:
                    d = estimate_ratio_differences(a, b, resamples=RESAMPLES, seed=seed)
                result[name].append(d.p)
                every.append(d.p)
            wrong.append(bool((adjust_p_values(np.concatenate(every)) <= 0.05).any()))
        for name, p in result.items():
            rate = (np.array(p) <= 0.05).mean(axis=0)
            cells = [f"{100 * f(rate[population.common == c]):.1f} %" for c in (True, False) for f in (np.mean, np.max)]
            rows.append([f"{m} and {n}", name, *cells, f"{100 * np.mean(wrong):.1f} %"])
    head = ["participants", "statistic", "p <= 0.05", "maximum over AOIs", "rare AOIs: p <= 0.05"]
    head += ["rare AOIs: maximum", "sets with a false discovery"]
    save_result("statistics-false-positives", head, rows, "the numbers of participants")


def _draw_lognormal(spread: float):
    return lambda rng, shape: np.exp(rng.normal(-(spread**2) / 2, spread, shape))


# Distributions of mean 1. The first group chose the bandwidth of the smoothed draws, the second judges it.
TAILS = {
    "normal, spread 0.3 (tuned)": lambda rng, shape: np.maximum(rng.normal(1, 0.3, shape), 0),
    "gamma, shape 2 (tuned)": lambda rng, shape: rng.gamma(2, 1 / 2, shape),
    "exponential (tuned)": lambda rng, shape: rng.gamma(1, 1, shape),
    "log-normal, spread 1 (tuned)": _draw_lognormal(1.0),
    "log-normal, spread 1.5 (tuned)": _draw_lognormal(1.5),
    "gamma, shape 3": lambda rng, shape: rng.gamma(3, 1 / 3, shape),
    "gamma, shape 0.5": lambda rng, shape: rng.gamma(0.5, 2, shape),
    "log-normal, spread 0.7": _draw_lognormal(0.7),
    "log-normal, spread 1.2": _draw_lognormal(1.2),
    "log-normal, spread 2": _draw_lognormal(2.0),
    "Pareto from 0, exponent 3": lambda rng, shape: 2 * rng.pareto(3, shape),
    "Pareto from 0.6, exponent 2.5": lambda rng, shape: 0.6 * (1 + rng.pareto(2.5, shape)),
}


def tails(sets: int, people: tuple[int, ...]) -> None:
    """Coverage of the mean of skewed values that all or 40 % of the participants have, and of a ratio of sums."""

    def measure(x: np.ndarray, y: np.ndarray, truth: float, bandwidth: float | None) -> tuple[float, float]:
        e = _estimate_with(bandwidth, x, y)
        has_interval = np.isfinite(e.low)
        covered = (e.low <= truth) & (truth <= e.high)
        return covered[has_interval].mean(), (e.high - e.low)[has_interval].mean()

    rows = []
    for name, draw in TAILS.items():
        for n in people:
            rng, result = np.random.default_rng([n, *name.encode()]), {}
            x, y = draw(rng, (n, sets)), np.ones((n, sets))
            result["mean"] = x, y, 1.0
            result["mean, 40 % contribute"] = x * (rng.random(x.shape) < 0.4), y, 0.4
            time = _draw_lognormal(1.5)(rng, x.shape)
            result["ratio, times of spread 1.5"] = x * time, time, 1.0
            for what, case in result.items():
                (before, width), (now, new_width) = measure(*case, 0.0), measure(*case, None)
                percent = [f"{100 * v:.1f} %" for v in (before, now)]
                rows.append([name, n, what, *percent, f"{new_width / width:.2f}"])
    head = ["distribution", "participants", "statistic", "coverage without smoothing", "coverage", "width ratio"]
    save_result("statistics-tails", head, rows, "the number of participants and the name")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "what",
        choices=("shares", "ratios", "few", "numbers", "differences", "tails"),
        help="Table to compute; see above.",
    )
    parser.add_argument("--sets", type=int, default=1000, help="Number of data sets. Default: %(default)s.")
    parser.add_argument(
        "--people",
        type=int,
        nargs="+",
        default=[8, 16, 40],
        help="Numbers of participants in a data set. Default: 8 16 40.",
    )
    parser.add_argument(
        "--of",
        nargs="+",
        default=["share", "share_when_visible", "distance"],
        help="Statistics for the tables ratios and few. Default: share share_when_visible distance.",
    )
    parser.add_argument(
        "--population",
        type=Path,
        help="File (.npz) of the population, which is written if it does not exist. Default: none.",
    )
    arguments = parser.parse_args()
    people = tuple(arguments.people)
    if arguments.what == "shares":
        shares(people)
        return
    if arguments.what == "tails":
        tails(arguments.sets, people)
        return
    population = Population(arguments.population)
    truth = population.truth["hit_ratio"]
    print(
        f"{arguments.sets} data sets; hit ratio of {population.common.sum()} common AOIs "
        f"{truth[population.common].min():.2f}"
    )
    print(
        f"to {truth.max():.4f}, of {(~population.common).sum()} rare ones {truth.min():.2f} to "
        f"{truth[~population.common].max():.2f}"
    )
    if arguments.what in ("ratios", "few"):
        variants = ratio_intervals if arguments.what == "ratios" else few_intervals
        rows = compare(population, arguments.sets, people, tuple(arguments.of), variants)
        name = "statistics-intervals" if arguments.what == "ratios" else "statistics-few"
        save_result(name, ["statistic", "interval", *HEAD], rows, "the number of participants")
    elif arguments.what == "numbers":
        numbers(population, arguments.sets, people)
    else:
        differences(population, arguments.sets, tuple((n, n) for n in people) + ((6, 20),))


if __name__ == "__main__":
    main()
