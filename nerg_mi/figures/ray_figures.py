"""Rays from above: how densely a floor is walked, and the layout with every ray's place.

Both return a matplotlib ``Figure`` with axes in metres, x to the right and y up; ``figures.save`` writes it. pyplot
stays out of it.
"""

from __future__ import annotations

import numpy as np

from nerg_mi.errors import NergError

from .sheet import INK, PAPER, new_page

_POINTS, _SURFACES = "#2b6cb0", "#b9b4aa"
_MOST_POINTS = 60_000  # drawn; more of them only hide each other
_MOST_CELLS = 4_000_000
_SIDE = 640  # pixels of the plan's longer side


def floor_plan(rays, cell: float | None = None, title: str = "Where people stood"):
    """Density of the rays' origins on the floor, in rays/m², on a logarithmic scale; cells without a ray stay white,
    as the scale says.

    ``cell``: edge of a cell in metres (default: a fiftieth of the plan's shorter side, 5 cm at least). Short lines show
    where the people of a coarser cell look on average; the longer, the more they agree. Raises `NergError` for no rays,
    and for cells that are no length or too many.
    """
    from matplotlib.colors import LogNorm

    xy = rays.origin[:, :2]
    low, high = _box(xy)
    size = high - low
    cell = max(0.05, round(float(size.min()) / 50, 2)) if cell is None else cell
    if not 0 < cell < np.inf:
        raise NergError(f"the edge of a cell is a positive length in metres, got {cell:g} (--cell)")
    if not np.prod(size / cell + 1) <= _MOST_CELLS:
        raise NergError(
            f"a plan of {size[0]:.4g} x {size[1]:.4g} m has more than {_MOST_CELLS:,} cells of {cell:g} m; name "
            "larger ones (--cell)"
        )
    edges = [np.arange(a, b + cell, cell) for a, b in zip(low, high)]
    counts, *_ = np.histogram2d(xy[:, 0], xy[:, 1], edges)
    density = np.ma.masked_equal(counts.T / cell**2, 0)
    figure, axes = _sheet(low, high, f"{title}: {_of(rays)}", bar=True)
    top = float(density.max())
    bottom = max(float(density.min()), top * 1e-4)
    image = axes.pcolormesh(
        *edges, density, cmap="viridis", norm=LogNorm(bottom, max(top, bottom * 1.01)), rasterized=True
    )
    _arrows(axes, rays, low, high)
    bar = figure.colorbar(image, cax=figure.axes[1])
    bar.set_label(f"rays/m² in cells of {cell:g} m; white: no ray", fontsize=7, color=INK)
    bar.ax.tick_params(labelsize=7, colors=INK, length=2)
    return figure


def layout_figure(rays, test=None, centres=None, radius: float | None = None, title: str = "Layout"):
    """The paper's layout figure: a point for every ray's place (blue) within the place and its dimensions in metres.

    The place is drawn as what was looked at: hit points between knee and reach (0.3 to 2 m above the floor), in grey.
    ``test``: rays held out, in orange. ``centres`` (T, 3) with ``radius``: test positions, as circles.
    """
    points = [rays.origin[:, :2]] + ([] if test is None else [test.origin[:, :2]])
    walls = _walls([rays] if test is None else [rays, test])
    low, high = _box(np.concatenate([*points, *([] if walls is None else [walls])]))
    figure, axes = _sheet(low, high, f"{title}: {_of(rays, test)}", pad=0.13)
    if walls is not None:
        axes.plot(*_some(walls).T, ",", color=_SURFACES, rasterized=True, zorder=1)
    for xy, color in zip(points, (_POINTS, "#d9730d")):
        size = 3.5 - 0.5 * np.log10(max(len(xy), 10))  # few points are drawn larger
        axes.plot(
            *_some(xy).T, ".", markersize=max(size, 1.1), markeredgewidth=0, color=color, rasterized=True, zorder=2
        )
    if centres is not None and radius is not None:
        from matplotlib.collections import PatchCollection
        from matplotlib.patches import Circle

        circles = [Circle(c, radius) for c in np.asarray(centres)[:, :2]]
        axes.add_collection(PatchCollection(circles, facecolor="#d9730d", edgecolor="none", alpha=0.02, zorder=1.5))
    first, last = _box(np.concatenate(points), margin=0.0)
    _dimension(axes, first, last)
    names = [(_POINTS, "rays" if test is None else "training rays")]
    names += ([] if test is None else [("#d9730d", "test rays")]) + (
        [] if walls is None else [(_SURFACES, "what was looked at")]
    )
    handles = [axes.plot([], [], "s", markersize=5, color=color, label=name)[0] for color, name in names]
    axes.legend(
        handles=handles,
        fontsize=7,
        frameon=False,
        loc="lower left",
        bbox_to_anchor=(0.0, 1.0),
        ncols=3,
        borderaxespad=0.2,
        handletextpad=0.1,
    )
    return figure


def _walls(sets) -> np.ndarray | None:
    hits = [r.hit[np.isfinite(r.hit).all(axis=1)] for r in sets if r.hit is not None]
    found = [h[(h[:, 2] > 0.3) & (h[:, 2] < 2.0), :2] for h in hits]
    found = [f for f in found if len(f)]
    if not found:
        return None
    walls = np.concatenate(found)
    # A glance through a gap ends tens of metres away.
    low, high = np.percentile(walls, [1, 99], axis=0)
    return walls[((walls >= low) & (walls <= high)).all(axis=1)]


def _box(xy: np.ndarray, margin: float = 0.03) -> tuple[np.ndarray, np.ndarray]:
    if not len(xy):
        raise NergError("there are no rays to draw; select fewer away")
    low, high = xy.min(axis=0), xy.max(axis=0)
    edge = np.maximum(margin * (high - low).max(), 0.05 if margin else 0.0)
    return low - edge, high + edge


def _some(xy: np.ndarray) -> np.ndarray:
    return xy if len(xy) <= _MOST_POINTS else xy[np.random.default_rng(0).choice(len(xy), _MOST_POINTS, replace=False)]


def _of(rays, test=None) -> str:
    people = np.unique(
        np.concatenate([np.asarray(rays.persons)[np.unique(r.person)] for r in (rays, test) if r is not None])
    ).size
    count = f"{len(rays):,} rays" if test is None else f"{len(rays):,} + {len(test):,} rays"
    return f"{count} of {people} {'person' if people == 1 else 'people'}"


def _arrows(axes, rays, low, high) -> None:
    step = float((high - low).max()) / 24
    at = np.floor((rays.origin[:, :2] - low) / step).astype(int)
    width = int(np.ceil((high - low)[0] / step)) + 1
    _, cell, count = np.unique(at[:, 1] * width + at[:, 0], return_inverse=True, return_counts=True)
    mean = lambda v: np.stack([np.bincount(cell, weights=c) for c in v.T], axis=1) / count[:, None]
    place, level = mean(rays.origin[:, :2]), mean(rays.direction[:, :2])
    enough = count >= max(20, len(rays) * 1e-4)
    place, level = place[enough], level[enough]
    axes.quiver(
        *place.T,
        *(level.T * step),
        angles="xy",
        scale_units="xy",
        scale=1.0,
        width=0.0028,
        color="white",
        edgecolor=INK,
        linewidth=0.4,
        headwidth=4,
        headlength=4,
        headaxislength=3.5,
        zorder=3,
    )


def _dimension(axes, low, high) -> None:
    """Lines along two sides that say how far the rays reach."""
    x0, x1 = axes.get_xlim()
    y0, y1 = axes.get_ylim()
    line = dict(
        arrowprops=dict(arrowstyle="|-|, widthA=0.25, widthB=0.25", color=INK, linewidth=0.8, shrinkA=0, shrinkB=0)
    )
    y, x = y0 + 0.045 * (y1 - y0), x1 - 0.045 * (x1 - x0)
    axes.annotate("", (low[0], y), (high[0], y), **line)
    axes.annotate("", (x, low[1]), (x, high[1]), **line)
    text = dict(fontsize=7, color=INK, ha="center", va="center", bbox=dict(facecolor=PAPER, edgecolor="none", pad=1))
    axes.text(0.5 * (low[0] + high[0]), y, f"{high[0] - low[0]:.2f} m", **text)
    axes.text(x, 0.5 * (low[1] + high[1]), f"{high[1] - low[1]:.2f} m", rotation=90, **text)


def _sheet(low, high, title: str, bar: bool = False, pad: float = 0.0):
    """A figure with axes in metres, of equal scale: so large that the plan's longer side has a fixed number of
    pixels. ``bar``: the figure's second axes are those of a colour bar."""
    # Room for the lines of dimension, outside of what they measure.
    room = pad * (high - low).max()
    low, high = low - (0, room), high + (room, 0)
    size = np.maximum((high - low) / (high - low).max() * _SIDE, 160)
    left, foot, head, right = 48, 40, 46, 96 if bar else 14
    width, height = left + size[0] + right, foot + size[1] + head
    figure = new_page(width, height)
    axes = figure.add_axes((left / width, foot / height, size[0] / width, size[1] / height))
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("x [m]", fontsize=7, color=INK)
    axes.set_ylabel("y [m]", fontsize=7, color=INK)
    axes.tick_params(labelsize=7, colors=INK, length=2)
    for spine in axes.spines.values():
        spine.set_linewidth(0.5)
    axes.set_title(title, fontsize=9, color=INK, loc="left", pad=19 if not bar else 6)
    if bar:
        figure.add_axes(((left + size[0] + 12) / width, foot / height, 12 / width, size[1] / height))
    return figure, axes
