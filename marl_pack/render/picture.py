"""A picture of one bin: the item to come, the boxes in 3D, and where the item may be placed.

The camera is orthographic and always sees the faces of a box towards +x, -y and +z. Matplotlib's
3D axes sort objects by their middles, which is wrong for boxes of different sizes. So boxes are
projected here and painted from back to front (:func:`paint_order`). This module does not use pyplot
or any other global state, so pictures can be drawn in any thread or process.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.image import imsave
from matplotlib.patches import Rectangle
from numpy.typing import ArrayLike, NDArray

from marl_pack.files import moved_into_place
from marl_pack.geometry.rotated import inner_sides
from marl_pack.plan import Plan
from marl_pack.render.colours import PALETTE

LEGAL = "#18a558"
"""Colour of the cells where the item may be placed."""

ENOUGH = 1000
"""Parts of a bin's longest side that rotated boxes need."""
FINEST = 1e-6
"""Share of a bin's longest side to which lengths are rounded."""

_INK, _FAINT, _BARRED = "#202020", "#909090", "#c0392b"

_ELEVATION, _AZIMUTH = np.radians((27.0, -58.0))
_TOWARDS_CAMERA = np.array(
    [
        np.cos(_ELEVATION) * np.cos(_AZIMUTH),
        np.cos(_ELEVATION) * np.sin(_AZIMUTH),
        np.sin(_ELEVATION),
    ]
)
_PROJECTION = np.array(  # x, y, z to right, up
    [
        [-np.sin(_AZIMUTH), -np.sin(_ELEVATION) * np.cos(_AZIMUTH)],
        [np.cos(_AZIMUTH), -np.sin(_ELEVATION) * np.sin(_AZIMUTH)],
        [0.0, np.cos(_ELEVATION)],
    ]
)

# A unit box: its corners, its edges, its floor, and the outlines of its faces towards +z, +x and
# -y. The outlines of upright faces begin and end at the bottom.
_CORNERS = np.array(list(product((0, 1), repeat=3)))
_EDGES = np.array(
    [(c, c + axis) for axis in np.eye(3, dtype=int) for c in _CORNERS if not np.dot(c, axis)]
)
_FLOOR = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)])
_FACES = np.array(
    [
        [(0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1), (0, 0, 1)],
        [(1, 0, 0), (1, 0, 1), (1, 1, 1), (1, 1, 0), (1, 0, 0)],
        [(0, 0, 0), (0, 0, 1), (1, 0, 1), (1, 0, 0), (0, 0, 0)],
    ]
)
_BRIGHTNESS = np.array([1.0, 0.66, 0.83])

_Rect = tuple[float, float, float, float]  # left, bottom, width, height in fractions of the figure


def paint_order(boxes: NDArray[np.integer]) -> list[tuple[int, int]]:
    """Return the order in which to paint boxes, from back to front, so that nothing hidden shows.

    Box a, moved by t away from the camera in direction v, meets box b while their intervals overlap
    on every axis. With y reversed all v_k > 0, and they overlap for::

        max_k (low_a - high_b)_k / v_k  <  t  <  min_k (high_a - low_b)_k / v_k

    The boxes are disjoint, so t = 0 does not satisfy this. If any t does, then all such t are
    positive, and a hides a part of b; or all are negative, and b hides a part of a.

    Boxes can hide one another in a ring, so they are painted by levels: one level for each height
    at which a box stands, from the floor upwards. A part above a level is never hidden by a part
    below it. Boxes that reach through one level are disjoint seen from above, and convex shapes in
    a plane never hide one another in a ring. So at each level the boxes that reach through it can
    be painted in order, each from that level upwards. This is needed only for boxes that stand on
    the level or hide a part of a box painted at it.

    Args:
        boxes: int [n, 6], rows x, y, z, w, d, h.

    Returns:
        Pairs of a box's index and a height; the box is painted from that height upwards.

    Raises:
        ValueError: if boxes overlap.
    """
    view = np.abs(_TOWARDS_CAMERA)
    low, sides = boxes[:, :3].astype(np.int64), boxes[:, 3:].astype(np.int64)
    low[:, 1] = -low[:, 1] - sides[:, 1]
    high = low + sides
    enter = ((low[:, None] - high) / view).max(-1)
    leave = ((high[:, None] - low) / view).min(-1)
    hides = (enter < leave - 1e-9) & (leave > 1e-9)  # [a, b]: a hides a part of b
    np.fill_diagonal(hides, False)

    order: list[tuple[int, int]] = []
    for level in np.unique(low[:, 2]).tolist():
        stands = low[:, 2] == level
        waiting = (low[:, 2] <= level) & (level < high[:, 2])
        painted = np.zeros(len(boxes), dtype=bool)
        while waiting.any():
            following = waiting & ~hides[:, waiting].any(1)
            if not following.any():
                raise ValueError(
                    f"boxes overlap, some of {np.flatnonzero(waiting).tolist()}: a picture needs "
                    "boxes that do not"
                )
            paint = following & (stands | hides[:, painted].any(1))
            order.extend((i, level) for i in np.flatnonzero(paint).tolist())
            painted |= paint
            waiting &= ~following
    return order


@dataclass(frozen=True)
class Drawable:
    """A plan of one bin in whole numbers, as :func:`draw` needs it."""

    size: tuple[int, int, int]
    boxes: NDArray[np.int64]  # [n, 6]
    parts: float  # the numbers are this many times the plan's


def drawable(plan: Plan) -> Drawable:
    """Return a plan of one bin in whole numbers.

    A box with a yaw becomes a large box without it inside. Lengths of more than four decimals are
    rounded to :data:`FINEST` of the bin's longest side.

    Raises:
        ValueError: for a plan of several bins.
    """
    if len(plan.bin_sizes) != 1:
        raise ValueError(f"a plan of {len(plan.bin_sizes)} bins: needs one, plan.in_bin(k)")
    boxes, size = plan.boxes.astype(np.float64), plan.bin_sizes[0].astype(np.float64)
    finest = 1.0 / (FINEST * size.max())
    for parts in (1.0, 10.0, 100.0, 1000.0, 10_000.0, finest):
        whole_size = np.round(size * parts)
        straight = np.vstack((boxes[plan.yaws == 0, :3], boxes[plan.yaws == 0, 3:], size)) * parts
        exact = np.allclose(np.round(straight), straight, rtol=0, atol=1e-6)
        if exact and (not plan.yaws.any() or parts * size.max() >= ENOUGH):
            break
    whole = np.hstack((boxes[:, :3], boxes[:, :3] + boxes[:, 3:])) * parts  # low, high
    for i in np.flatnonzero(plan.yaws):
        angle = math.radians(abs(float(plan.yaws[i])))
        w, d = boxes[i, 3:5].tolist()
        inside = inner_sides(w, d, math.cos(angle), math.sin(angle))
        middle = boxes[i, :2] + boxes[i, 3:5] / 2
        whole[i, :2] = np.ceil((middle - np.array(inside) / 2) * parts)
        whole[i, 3:5] = np.floor((middle + np.array(inside) / 2) * parts)
    whole = np.clip(np.round(whole), 0, np.tile(whole_size, 2))
    whole[:, 3:] = np.maximum(whole[:, 3:] - whole[:, :3], 1)
    width, depth, height = whole_size.astype(int).tolist()
    return Drawable((width, depth, height), whole.astype(np.int64), parts)


def draw_plan(
    plan: Plan,
    title: str = "",
    pixels: tuple[int, int] = (960, 600),
    colours: Sequence[str] = PALETTE,
) -> NDArray[np.uint8]:
    """Draw a plan of one bin (:func:`draw`)."""
    whole = drawable(plan)
    return draw(
        whole.size, whole.boxes, title=title, pixels=pixels, parts=whole.parts, colours=colours
    )


def draw(
    size: tuple[int, int, int],
    boxes: NDArray[np.integer],
    item: tuple[int, int, int] | None = None,
    masks: NDArray[np.bool_] | None = None,
    labels: Sequence[str] = (),
    title: str = "",
    pixels: tuple[int, int] = (960, 600),
    leave_space: bool = False,
    parts: float = 1,
    colours: Sequence[str] = PALETTE,
) -> NDArray[np.uint8]:
    """Draw, from left to right, the item to come, the bin, and where the item may be placed.

    The box placed last has a thick outline, in the bin and on the heightmaps. The item has the
    colour that it will have in the bin. It is drawn at the bin's scale, or smaller if there is too
    little space.

    Args:
        size: (W, D, H) in cells.
        boxes: int [n, 6], rows x, y, z, w, d, h in cells, in order of placement; n may be 0.
        item: w, d, h in cells of the item to come, as it lies now.
        masks: bool [A, W, D], the cells where the item's low corner may lie, in A orientations.
        labels: a title for each of the A masks, or an empty sequence.
        title: the title of the whole picture.
        pixels: (columns, rows) of the picture.
        leave_space: whether to leave space for an item even without one, so that the bin is at
            the same place in every picture.
        parts: the numbers on the picture are lengths divided by this.
        colours: "#rrggbb" of the boxes in order, then of the item; after the last colour the first
            one comes again.

    Returns:
        uint8 [rows, columns, 3], RGB.

    Raises:
        ValueError: if shapes do not match, a box reaches out of the bin, or boxes overlap.
    """
    checked = _check(size, boxes, item, masks, labels, pixels)
    columns, rows = pixels
    dpi = 100 * min(columns / 960, rows / 600)  # lettering grows with the picture
    # Half a pixel more, as the canvas rounds down.
    figure = Figure(((columns + 0.5) / dpi, (rows + 0.5) / dpi), dpi=dpi, facecolor="white")
    canvas = FigureCanvasAgg(figure)
    printable = "".join(c if c.isprintable() or c == "\n" else "?" for c in title)
    plain = printable.replace("$", r"\$")  # "$" would start a formula
    figure.text(0.5, 0.975, plain, ha="center", va="top", size=12, color=_INK, wrap=True)

    beside = 0.28 if masks is None else 0.18
    left = 0.05 if item is None and not leave_space else beside + 0.04
    right = 0.93 if masks is None else 0.61
    scale = _draw_bin(figure, (left, 0.10, right - left, 0.80), size, checked, parts, colours)
    if item is not None:
        colour = colours[len(boxes) % len(colours)]
        _draw_item(figure, (0.01, 0.36, beside, 0.40), item, colour, scale, parts)
    if masks is not None:
        legend = "green: where the item's low corner may lie"
        figure.text(0.01, 0.02, legend, size=9, color=LEGAL)
        _draw_masks(figure, (0.68, 0.035, 0.315, 0.89), size, checked, masks, labels)

    figure.canvas.draw()
    image: NDArray[np.uint8] = np.asarray(canvas.renderer.buffer_rgba())[..., :3].copy()
    return image


def save(path: str | Path, image: NDArray[np.uint8]) -> None:
    """Write a picture, uint8 [rows, columns, 3]; the file's ending chooses the format, e.g. PNG."""
    with moved_into_place(Path(path)) as part:
        imsave(part, image)


def _check(
    size: tuple[int, int, int],
    boxes: NDArray[np.integer],
    item: tuple[int, int, int] | None,
    masks: NDArray[np.bool_] | None,
    labels: Sequence[str],
    pixels: tuple[int, int],
) -> NDArray[np.int64]:
    """Check the arguments of :func:`draw`, and return the boxes as int64 [n, 6]."""
    boxes = np.asarray(boxes)
    if len(size) != 3 or min(size) < 1:
        raise ValueError(f"size {size!r}: needs three sides W, D, H of at least 1")
    if boxes.ndim != 2 or boxes.shape[1] != 6 or not np.issubdtype(boxes.dtype, np.integer):
        raise ValueError(
            f"boxes are {boxes.dtype} {list(boxes.shape)}: need int [n, 6], rows x, y, z, w, d, h"
        )
    checked: NDArray[np.int64] = boxes.astype(np.int64)
    low, sides = checked[:, :3], checked[:, 3:]
    outside = (low < 0).any(1) | (sides < 1).any(1) | (low + sides > size).any(1)
    if outside.any():
        which = int(outside.argmax())
        raise ValueError(
            f"box {which} is {checked[which].tolist()}: x, y, z must be at least 0, w, d, h at "
            f"least 1, and their sums at most {list(size)}"
        )
    if item is not None and (len(item) != 3 or min(item) < 1):
        raise ValueError(f"item {item!r}: needs three sides w, d, h of at least 1")
    count = 0
    if masks is not None:
        if masks.ndim != 3 or len(masks) < 1 or masks.shape[1:] != tuple(size[:2]):
            raise ValueError(
                f"masks are {list(masks.shape)}: need [A, {size[0]}, {size[1]}] with A at least 1"
            )
        count = len(masks)
    if len(labels) not in (0, count):
        raise ValueError(f"{len(labels)} labels: need one for each of {count} masks, or none")
    if min(pixels) < 1:
        raise ValueError(f"pixels {pixels!r}: needs at least one column and one row")
    return checked


def _draw_bin(
    figure: Figure,
    rect: _Rect,
    size: tuple[int, int, int],
    boxes: NDArray[np.int64],
    parts: float,
    colours: Sequence[str],
) -> float:
    """Draw the bin in 3D so that it fills ``rect``, and return its scale in pixels per cell."""
    axes, scale = _axes(figure, rect, size)
    edges = _EDGES * size
    near = (_EDGES == (1, 0, 1)).all(-1).any(-1)  # edges that lie in front of all boxes
    axes.add_collection(PolyCollection([_project(_FLOOR * size)], facecolors="#e8e8e8"))
    _add_lines(axes, edges[~near], _FAINT, 0.9)
    _add_boxes(axes, boxes, colours)
    _add_lines(axes, edges[near], _FAINT, 0.6)
    if len(boxes):  # the outline of the last box, where others hide it
        visible = (_EDGES != (0, 1, 0)).any(-1).all(-1)
        _add_lines(axes, boxes[-1, :3] + _EDGES[visible] * boxes[-1, 3:], _INK, 1.0, ":")

    # Scales along the three edges of the bin that bound its picture below and to the right.
    origins = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0)]) * size
    outwards = np.array([(-0.45, -1.0), (0.75, -0.8), (1.0, 0.0)])
    for axis, name in enumerate("xyz"):
        side = size[axis]
        # Each scale begins where the previous one ends, so only the first has a 0.
        ticks = sorted({0, side // 2, side} if name == "x" else {side // 2, side} - {0})
        marks = [(float(tick), f"{tick / parts:g}", 9, 8) for tick in ticks]
        for at, text, away, letters in [*marks, (side / 2, name, 22, 10)]:
            right, up = _project(origins[axis] + at * np.eye(3)[axis])
            axes.annotate(
                text,
                (right, up),
                xytext=away * outwards[axis],
                textcoords="offset points",
                ha="center",
                va="center",
                size=letters,
                color=_INK,
                annotation_clip=False,
            )
    return scale


def _draw_item(
    figure: Figure,
    rect: _Rect,
    item: tuple[int, int, int],
    colour: str,
    scale: float,
    parts: float,
) -> None:
    """Draw the item to come in the middle of ``rect``, with its sides below."""
    axes, own_scale = _axes(figure, rect, item, scale)
    _add_boxes(axes, np.array([(0, 0, 0, *item)]), [colour], last_edge=0.6)
    text = "item {:g} × {:g} × {:g}".format(*(side / parts for side in item))
    if own_scale < 0.99 * scale:
        text += f"\n(drawn at {own_scale / scale:.0%})"
    left, bottom, width, _ = rect
    figure.text(left + width / 2, bottom - 0.03, text, ha="center", va="top", size=11, color=_INK)


def _draw_masks(
    figure: Figure,
    rect: _Rect,
    size: tuple[int, int, int],
    boxes: NDArray[np.int64],
    masks: NDArray[np.bool_],
    labels: Sequence[str],
) -> None:
    """Draw a heightmap with legal cells for each mask, in two columns unless there is just one."""
    width, depth, height = size
    tops = np.zeros((width, depth))
    for x, y, z, w, d, h in boxes.tolist():
        under = tops[x : x + w, y : y + d]
        np.maximum(under, z + h, out=under)
    grey = np.repeat((0.97 - 0.52 * tops / height)[..., None], 3, axis=-1)
    lit = 0.25 * grey + 0.75 * np.array(to_rgb(LEGAL))

    columns = min(len(masks), 2)
    rows = -(-len(masks) // columns)
    left, bottom, wide, high = rect[0], rect[1], rect[2] / columns, rect[3] / rows
    for i, mask in enumerate(masks):
        row, across = divmod(i, columns)
        # Each panel leaves space for its title above and its ticks below.
        axes = figure.add_axes(
            (left + across * wide, bottom + (rows - 1 - row) * high, wide - 0.025, high - 0.095)
        )
        axes.imshow(
            np.where(mask[..., None], lit, grey).transpose(1, 0, 2),
            origin="lower",
            extent=(0, width, 0, depth),
            interpolation="nearest",
        )
        if len(boxes):
            x, y, _, w, d, _ = boxes[-1].tolist()
            axes.add_patch(Rectangle((x, y), w, d, fill=False, edgecolor=_INK, linewidth=1.6))
        cells = int(np.count_nonzero(mask))
        amount = {0: "none", 1: "1 cell"}.get(cells, f"{cells} cells")
        heading = f"{labels[i]}\n{amount}" if labels else amount
        axes.set_title(heading, size=9, pad=5, color=_INK if cells else _BARRED)
        axes.set_xticks((0, width))
        axes.set_yticks((0, depth))
        axes.tick_params(labelsize=7, length=2, pad=1, colors=_INK)
        axes.set_xlabel("x", size=8, labelpad=-8, color=_INK)
        axes.set_ylabel("y", size=8, labelpad=-8, color=_INK)
        if not cells:
            axes.plot((0, width), (0, depth), (0, width), (depth, 0), color=_BARRED, linewidth=0.8)
        for spine in axes.spines.values():
            spine.set_color(_FAINT if cells else _BARRED)


def _axes(
    figure: Figure, rect: _Rect, size: tuple[int, int, int], scale: float = np.inf
) -> tuple[Axes, float]:
    """Return axes in which a projected box of ``size`` fills ``rect``, and the scale of the axes.

    The returned scale is in pixels per cell, and at most ``scale``.
    """
    axes = figure.add_axes(rect)
    axes.set_axis_off()
    corners = _project(_CORNERS * size)
    low, high = corners.min(0), corners.max(0)
    space = np.multiply(figure.bbox.size, rect[2:])
    scale = min(scale, float((space / (high - low)).min()))
    left, bottom = (low + high - space / scale) / 2
    right, top = (low + high + space / scale) / 2
    axes.set(xlim=(left, right), ylim=(bottom, top))
    return axes, scale


def _project(points: ArrayLike) -> NDArray[np.float64]:
    """Project points [..., 3] to the picture, right and up [..., 2], without changing scale."""
    picture: NDArray[np.float64] = np.asarray(points) @ _PROJECTION
    return picture


def _add_lines(
    axes: Axes, lines: NDArray[np.number], colour: str, width: float, style: str = "-"
) -> None:
    """Add lines [m, 2, 3] from point to point."""
    axes.add_collection(
        LineCollection(
            list(_project(lines)),
            colors=colour,
            linewidths=width,
            linestyles=style,
            clip_on=False,
            zorder=1,  # the same as for patches, so that all is drawn in the order of adding
        )
    )


def _add_boxes(
    axes: Axes,
    boxes: NDArray[np.int64],
    colours: Sequence[str],
    last_edge: float = 2.4,
) -> None:
    """Add the visible faces of boxes, the last box with edges ``last_edge`` points wide."""
    outlines: list[NDArray[np.float64]] = []
    fills: list[NDArray[np.float64]] = []
    edges: list[float] = []
    for i, level in paint_order(boxes):
        outline = boxes[i, :3] + _FACES * boxes[i, 3:]
        if level > boxes[i, 2]:  # The upright faces continue below, so they have no edge here.
            outline[1:, :, 2] = np.maximum(outline[1:, :, 2], level)
            outline[1:, 4] = outline[1:, 3]
        outlines.extend(_project(outline))
        fills.extend(_BRIGHTNESS[:, None] * to_rgb(colours[i % len(colours)]))
        edges.extend([last_edge if i == len(boxes) - 1 else 0.6] * len(_FACES))
    axes.add_collection(
        PolyCollection(
            outlines,
            closed=False,
            facecolors=fills,
            edgecolors=_INK,
            linewidths=edges,
            joinstyle="round",
            clip_on=False,
        )
    )
