"""A place where nobody was tracked yet: what a prior that was learnt in other places says, alone and with few people.

    OPENBLAS_NUM_THREADS=1 python benchmarks/gaze_prior.py [--only supermarket,stage] [--fields 2]
        [--out out/benchmarks/gaze_prior]

Places and their people are those of `places.py`. In each of four folds half of the people are scored, at 45 positions;
of the others 0, 1, 2 or 5 are known, drawn up to three times, by their rays 2R and more from there. What is learnt
elsewhere has seen no ray of the place, and every number that has to be chosen (kernels, shares, penalties) is the one
that scored best in the other places, with what was learnt in neither. Bits are those a ray is better told by than by
the uniform density; intervals are 95 % of a bootstrap over the people who are scored. `--fields N`: gaze fields of the
default recipe, trained on the same rays in so many folds, one draw each.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)
from output import write_rows
from place_rays import asked_places, makers, parse, place_parser
from prior_cases import Fold, PriorPlace, prior_place
from prior_features import FEATURES
from prior_law import LOG_UNIFORM, basis, blind, concentration, fit, normalised
from prior_scores import Scored, summarise

import numpy as np

REAL = ("supermarket", "room", "playroom", "truck")
PEOPLE = (1, 2, 5)
DRAWS = {1: 3, 2: 3, 5: 2}
FIELD = "gaze field"
Logs = tuple[np.ndarray, np.ndarray]

# Penalty of what is learnt from whole places.
_RIDGE = 1e-2
# Folds of the other places by which numbers are chosen.
_CHOOSING = 2


class Study:
    """Laws that were learnt in some of ``places`` and the densities that follow, each made once."""

    def __init__(self, places: dict[str, PriorPlace]):
        self.places = places
        self.weights = cache(self._weights)
        self.choose = cache(self._choose)
        self._hats: dict[tuple, np.ndarray] = {}

    def sources(self, kind: str, without: frozenset[str]) -> tuple[str, ...]:
        """Places that a law of ``kind`` is learnt in."""
        names = [n for n in self.places if n not in without]
        if kind == "elevation, real":
            return tuple(n for n in names if n in REAL)
        if kind == "geometry, real":
            return tuple(n for n in names if n == "supermarket")
        return tuple(n for n in names if kind.startswith("elevation") or not self.places[n].flat)

    def _weights(self, kind: str, names: tuple[str, ...]) -> np.ndarray:
        """A law learnt in the places ``names``. One of kind "law" is what their blind densities are multiplied by."""
        parts = []
        for name in names:
            place = self.places[name]
            offset = place.log_blind if kind == "law" else np.zeros_like(place.truth)
            parts.append((self.hats(kind, place.features, (name, "all")), place.truth, offset))
        return fit(parts, _RIDGE)

    def hats(self, kind: str, features: np.ndarray, key: tuple) -> np.ndarray:
        count = 1 if kind.startswith("elevation") else 2 if kind == "distance" else len(FEATURES)
        if (count, *key) not in self._hats:
            self._hats[(count, *key)] = basis(features, count)
        return self._hats[(count, *key)]

    def forward(self, name: str) -> float | None:
        """Concentration of gaze about the head in the other places."""
        means = [p.ahead for n, p in self.places.items() if n != name and np.isfinite(p.ahead)]
        return concentration(float(np.mean(means))) if means else None

    def prior(self, name: str):
        """The log of what `training.gaze.prior` makes of the rays of the other real places, in directions (..., 3)."""
        from nerg_mi.training.gaze.prior import elevation_density

        others = [p.rays for n, p in self.places.items() if n in REAL and n != name]
        if not others:
            return None
        sine = np.linspace(-1, 1, 1025)
        log = np.log(elevation_density(others, sine))
        return lambda directions: np.interp(directions[..., 2], sine, log)

    def elsewhere(self, kind: str, without: frozenset[str], name: str, k: int) -> Logs | None:
        """What is learnt outside of ``without`` says in fold ``k`` of ``name``; None where there is nothing to learn
        it from."""
        names = self.sources(kind, without)
        if not names or (self.places[name].flat and not kind.startswith("elevation")):
            return None
        w = self.weights(kind, names)
        return normalised(*(hats @ w for hats in self.test_hats(kind, name, k)))

    def test_hats(self, kind: str, name: str, k: int) -> Logs:
        fold = self.places[name].folds[k]
        return (self.hats(kind, fold.features, (name, k, "map")), self.hats(kind, fold.ray_features, (name, k, "rays")))

    def candidates(
        self, method: str, without: frozenset[str], name: str, k: int, people: tuple[int, ...]
    ) -> Iterator[tuple[tuple, Logs]]:
        """Densities by ``method`` with each number that could be chosen."""
        if method == "blind":
            for kappa in (3.0, 6.0, 12.0, 25.0):
                yield (kappa,), self.blind(name, k, people, kappa)
        elif method.startswith("blind, prior"):
            own = self.elsewhere(method.removeprefix("blind, prior "), without, name, k)
            for kappa in (6.0, 12.0, 25.0) if own is not None else ():
                known = self.blind(name, k, people, kappa)
                for a, b in ((0.25, 1.0), (0.5, 0.5), (0.5, 0.75), (0.5, 1.0)):
                    yield (kappa, "product", a, b), normalised(*(a * x + b * y for x, y in zip(own, known)))
                for m in (0.25, 0.5):
                    yield (
                        (kappa, "mixture", m),
                        tuple(np.log(m * np.exp(x) + (1 - m) * np.exp(y)) for x, y in zip(own, known)),
                    )
        elif not self.places[name].flat:
            yield from self._laws(method, without, name, k, people)

    def _laws(self, method: str, without: frozenset[str], name: str, k: int, people: tuple) -> Iterator:
        apart, kind = not method.startswith("blind x their law"), "distance" if method.endswith("distance") else "law"
        start = self.weights("law", self.sources("law", without)) if apart else None
        kappas = (3.0, 6.0, 12.0) if method == "blind x law of elsewhere" else (3.0, 6.0)
        for kappa in kappas:
            known = self.blind(name, k, people, kappa)
            if method == "blind x law of elsewhere":
                found = [((kappa, s), s * start) for s in (0.25, 0.5, 1.0)]
            else:
                found = [
                    ((kappa, ridge), self.fitted(kind, name, k, people, kappa, ridge, without if apart else None))
                    for ridge in ((1e-3, 3e-3, 1e-2, 3e-2) if not apart else (3e-3, 1e-2, 3e-2))
                ]
            hats = self.test_hats(kind, name, k)
            for number, w in found:
                yield number, normalised(*(h @ w + y for h, y in zip(hats, known)))

    def fitted(
        self, kind: str, name: str, k: int, people: tuple, kappa: float, ridge: float, without: frozenset[str] | None
    ) -> np.ndarray:
        """The law of ``people`` beside their blind density, pulled towards that of elsewhere, or towards none."""
        names = None if without is None else self.sources("law", without)
        return self._fitted(kind, name, k, people, kappa, ridge, names)

    @cache  # noqa: B019 (one study a run)
    def _fitted(self, kind, name, k, people, kappa, ridge, names) -> np.ndarray:
        fold = self.places[name].folds[k]
        has, truth = fold.learnt(list(people))
        hats = self.hats(kind, fold.probe_features, (name, k, "probes"))[has]
        offset = np.broadcast_to(self._known(name, k, people, kappa, "probes"), truth.shape)
        return fit([(hats, truth, offset)], ridge, None if names is None else self.weights("law", names))

    def blind(self, name: str, k: int, people: tuple[int, ...], kappa: float) -> Logs:
        shared = self._known(name, k, people, kappa, "map")
        at = self._known(name, k, people, kappa, "rays")
        return np.broadcast_to(shared, (len(at), len(shared))), at

    @cache  # noqa: B019
    def _known(self, name: str, k: int, people: tuple[int, ...], kappa: float, where: str) -> np.ndarray:
        fold = self.places[name].folds[k]
        mine = np.isin(fold.pool.person, people)
        at = {"map": fold.test.directions, "rays": fold.at, "probes": fold.probes.directions}[where]
        return blind(fold.pool.direction[mine], fold.pool.person[mine], kappa, at)

    def _choose(self, method: str, name: str, count: int) -> tuple:
        """The number for ``name``: that of most bits in the other places."""
        found: dict[tuple, list[float]] = {}
        for other, place in self.places.items():
            if other == name:
                continue
            for k in range(_CHOOSING):
                people = draw(place.folds[k], count, 0)
                for number, (_, at) in self.candidates(method, frozenset((name, other)), other, k, people):
                    found.setdefault(number, []).append(float(at.mean()))
        return max(found, key=lambda number: float(np.mean(found[number])))

    def density(self, method: str, name: str, k: int, people: tuple[int, ...], count: int) -> Logs | None:
        """By ``method``, with the number that is chosen elsewhere; None where it cannot be said."""
        if self.places[name].flat and "law" in method:
            return None
        chosen = self.choose(method, name, count)
        found = dict(self.candidates(method, frozenset((name,)), name, k, people))
        return found.get(chosen)


def draw(fold: Fold, count: int, number: int) -> tuple[int, ...]:
    """So many of the pool's people, or all."""
    return tuple(np.random.default_rng((count, number)).permutation(fold.people)[:count].tolist())


def forward(cosine: np.ndarray, kappa: float) -> np.ndarray:
    """Log density (1/sr) of gaze at angles of ``cosine`` from the head, of which a tenth is uniform; uniform where the
    head is not known."""
    peak = kappa / (2 * np.pi * (1 - np.exp(-2 * kappa))) * np.exp(kappa * (cosine - 1))
    return np.where(np.isfinite(cosine), np.log(0.9 * peak + 0.1 * np.exp(LOG_UNIFORM)), LOG_UNIFORM)


ALONE = ("elevation, real", "elevation", "geometry", "geometry, real")
HEADS, PRIOR = "head known", "elevation, product, real"
WITH = (
    "blind",
    "blind, prior elevation, real",
    "blind, prior geometry",
    "blind x law of elsewhere",
    "blind x law adapted",
    "blind x their law",
    "blind x their law of distance",
)


def score(study: Study, name: str, fields: int) -> list[Scored]:
    """Every method in every fold of the place ``name``."""
    out = []
    for k, fold in enumerate(study.places[name].folds):
        put = lambda method, count, logs, fold=fold, k=k: out.append(Scored.of(method, count, k, fold.test, logs))
        flat = np.full(fold.test.truth.shape, LOG_UNIFORM), np.full(fold.at.shape[:2], LOG_UNIFORM)
        put("uniform", 0, flat)
        for kind in ALONE:
            if (logs := study.elsewhere(kind, frozenset((name,)), name, k)) is not None:
                put(kind, 0, logs)
        if (prior := study.prior(name)) is not None:
            put(
                PRIOR,
                0,
                tuple(prior(d) for d in (np.broadcast_to(fold.test.directions, flat[0].shape + (3,)), fold.at)),
            )
        if fold.ahead is not None and (kappa := study.forward(name)) is not None:
            at = forward(fold.ahead, kappa)
            out.append(Scored.of_rays(HEADS, 0, k, fold.test, at))
        for count in PEOPLE:
            for number in range(DRAWS[count]):
                people = draw(fold, count, number)
                for method in WITH:
                    if (logs := study.density(method, name, k, people, count)) is not None:
                        put(method, count, logs)
                if number == 0 and k < fields:
                    put(FIELD, count, trained(fold, people))
    return out


def trained(fold: Fold, people: tuple[int, ...]) -> Logs:
    """A gaze field of the default recipe, of the rays of ``people`` in the fold's place."""
    from nerg_mi.evaluation.gaze.scores import gaze_field
    from nerg_mi.field.backend import namespace
    from nerg_mi.jobs.gaze_plan import plan_gaze
    from nerg_mi.jobs.options.gaze import GazeOptions
    from nerg_mi.training.gaze.run import train_gaze
    from nerg_mi.training.gaze.supervision import Supervision

    rays = fold.pool.select(np.isin(fold.pool.person, people))
    options = GazeOptions(geometry="none" if fold.place.medium is None else "hits")
    plan = plan_gaze(options, fold.place)
    made = train_gaze(Supervision(rays), fold.place, plan, namespace("llvm"))
    density = gaze_field(made.field, fold.place.medium, fold.place.align)
    logs = [np.log(np.maximum(density(fold.test.centres, d), 1e-9)) for d in (fold.test.directions, fold.at)]
    return normalised(*logs)


def main(argv=None) -> None:
    from nerg_mi.jobs.backend import select_backend

    # All places are learnt from; --only says which are scored.
    parser = place_parser(__doc__, "gaze_prior", folds=4)
    parser.add_argument("--fields", type=int, default=0, help="folds in which gaze fields are trained, too")
    args = parse(parser, argv)
    select_backend("llvm_ad_rgb", args.threads)
    places = {}
    for name, make in makers(args.data).items():
        places[name] = prior_place(name, make, args.folds, args.out / name)
        known = np.mean([fold.known for fold in places[name].folds])
        print(f"{name}: {100 * known:.0f} % of directions meet a surface", flush=True)
    study, rows = Study(places), []
    for name in asked_places(args):
        found = summarise(name, score(study, name, args.fields))
        rows += found
        print(f"\n{name:12s} people  KLD    CC     bits                   bits less blind")
        for r in found:
            less = f"{r['less']:+.3f} ({r['less.low']:+.3f} to {r['less.high']:+.3f})" if r["less"] == r["less"] else ""
            print(
                f"{r['method']:30s}{r['people']:2d} {r['KLD']:6.3f} {r['CC']:6.3f} {r['bits']:6.3f} "
                f"({r['bits.low']:.3f} to {r['bits.high']:.3f})  {less}",
                flush=True,
            )
    write_rows(args.out / "gaze_prior.csv", rows)


if __name__ == "__main__":
    main()
