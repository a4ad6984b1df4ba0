import sys
from itertools import pairwise

import numpy as np
import pytest
from matplotlib.image import imread
from PIL import Image, ImageSequence

from marl_pack.plan import Plan
from marl_pack.render.animation import Film, save_film
from marl_pack.render.picture import PALETTE, draw, paint_order, save

SIZE = (10, 10, 10)
TOWARDS_CAMERA = np.array([0.4722, -0.7556, 0.4540])  # elevation 27°, azimuth -58°
RING = np.array(  # each box hides a part of the next
    [
        (0, 4, 5, 8, 1, 1),
        (6, 0, 4, 1, 9, 1),
        (5, 3, 1, 1, 1, 7),
    ]
)
EMPTY = np.zeros((0, 6), dtype=np.int16)


def disjoint(rng, size, tries=60):
    """Random boxes that float and do not overlap."""
    filled = np.zeros(size, dtype=bool)
    boxes = []
    for _ in range(tries):
        sides = rng.integers(1, np.array(size) * 2 // 3 + 1)
        x, y, z = (int(rng.integers(0, size[k] - sides[k] + 1)) for k in range(3))
        w, d, h = sides.tolist()
        cells = filled[x : x + w, y : y + d, z : z + h]
        if not cells.any():
            cells[:] = True
            boxes.append((x, y, z, w, d, h))
    return np.array(boxes, dtype=np.int16)


def stacked(rng, size, n):
    """Random boxes stacked one on another."""
    tops = np.zeros(size[:2], dtype=int)
    boxes = []
    while len(boxes) < n:
        w, d, h = rng.integers(1, 5, 3).tolist()
        x, y = int(rng.integers(0, size[0] - w + 1)), int(rng.integers(0, size[1] - d + 1))
        z = int(tops[x : x + w, y : y + d].max())
        n -= z + h > size[2]
        if z + h <= size[2]:
            tops[x : x + w, y : y + d] = z + h
            boxes.append((x, y, z, w, d, h))
    return np.array(boxes, dtype=np.int16)


def met(rays, boxes):
    """When rays from far behind the bin enter and leave boxes on their way to the camera."""
    low, high = boxes[:, :3], boxes[:, :3] + boxes[:, 3:]
    first = (low - rays[:, None]) / TOWARDS_CAMERA
    second = (high - rays[:, None]) / TOWARDS_CAMERA
    enter, leave = np.minimum(first, second).max(-1), np.maximum(first, second).min(-1)
    return np.where(enter < leave, leave, -np.inf)


def rgb(colour):
    return np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)])


def assert_painted_right(boxes, size, rng, n=400):
    rays = rng.uniform(0, size, (n, 3))
    leave = met(rays, boxes)
    nearest = np.where(leave.max(1) > -np.inf, leave.argmax(1), -1)
    order = paint_order(boxes)
    strokes = boxes[[i for i, _ in order]].astype(int)
    level = np.array([level for _, level in order])
    strokes[:, 5] -= level - strokes[:, 2]
    strokes[:, 2] = level
    painted = met(rays, strokes) > -np.inf
    last = len(order) - 1 - painted[:, ::-1].argmax(1)
    painted_last = np.where(painted.any(1), np.array([i for i, _ in order])[last], -1)
    np.testing.assert_array_equal(painted_last, nearest)


@pytest.mark.parametrize("size", [SIZE, (20, 10, 12), (6, 30, 9)])
@pytest.mark.parametrize("packing", [disjoint, lambda rng, size: stacked(rng, size, 40)])
def test_on_every_ray_the_box_painted_last_is_the_one_nearest_to_the_camera(size, packing):
    rng = np.random.default_rng(0)
    for _ in range(40):
        assert_painted_right(packing(rng, size), size, rng)


def test_boxes_that_hide_one_another_in_a_ring_are_cut_at_the_heights_where_they_stand():
    order = paint_order(RING)
    assert len(order) > len(RING)
    assert all(level in (1, 4, 5) for _, level in order)
    assert_painted_right(RING, SIZE, np.random.default_rng(1), n=20000)


@pytest.mark.parametrize("seed", [None, 0, 1, 2])
def test_each_pixel_has_the_colour_of_the_face_nearest_to_the_camera(seed):
    rng = np.random.default_rng(seed)
    boxes = RING if seed is None else disjoint(rng, SIZE)
    image = draw(SIZE, boxes, pixels=(960, 600)).astype(int)

    rays = rng.uniform(0, SIZE, (4000, 3))
    near = boxes[:, :3] + boxes[:, 3:] * (1, 0, 1)
    leave = met(rays, boxes)
    hit = leave.max(1) > -np.inf
    rays, box = rays[hit], leave[hit].argmax(1)
    face = ((near[box] - rays) / TOWARDS_CAMERA).argmin(1)  # the first plane met: +x, -y or +z
    colours = np.array([rgb(colour) for colour in PALETTE])[box % len(PALETTE)]
    expected = colours * np.array([0.66, 0.83, 1.0])[face, None]

    # The middle of the bin is drawn in the middle of its part of the picture, 80 % of its height.
    right = np.array([-TOWARDS_CAMERA[1], TOWARDS_CAMERA[0], 0])
    right /= np.linalg.norm(right)
    up = np.cross(TOWARDS_CAMERA, right)
    scale = 0.8 * 600 / (np.abs(up) @ SIZE)
    from_middle = (rays - np.array(SIZE) / 2) * scale
    column = np.floor(0.49 * 960.5 + from_middle @ right).astype(int)
    row = np.floor(600 - 0.5 * 600.5 - from_middle @ up).astype(int)
    pixels = image[row, column]
    wrong = (np.abs(pixels - expected).max(-1) > 3) & (pixels.max(-1) > 90)  # darker ones are edges
    assert wrong.mean() < 0.08  # at most what borders on an edge


def test_in_the_plain_case_each_box_is_painted_once_from_the_back_corner_to_the_camera():
    grid = [(x, y, z, 2, 2, 2) for x in (0, 2) for y in (0, 2) for z in (0, 2)]
    order = paint_order(np.array(grid))
    assert len(order) == 8
    assert grid[order[0][0]][:3] == (0, 2, 0)
    assert grid[order[-1][0]][:3] == (2, 0, 2)


def test_a_box_behind_another_is_invisible():
    front = (3, 0, 0, 6, 1, 9)
    first, second = (
        draw(SIZE, np.array([hidden, front])) for hidden in [(4, 2, 0, 1, 1, 2), (5, 3, 0, 1, 1, 1)]
    )
    np.testing.assert_array_equal(first, second)


def test_a_picture_has_the_pixels_asked_for_and_draws_on_no_global_figure():
    for columns, rows in [(960, 600), (481, 303), (500, 700)]:
        image = draw(SIZE, RING[:1], pixels=(columns, rows))
        assert image.shape == (rows, columns, 3)
        assert image.dtype == np.uint8
    pyplot = sys.modules.get("matplotlib.pyplot")
    assert pyplot is None or not pyplot.get_fignums()


def test_each_argument_changes_the_picture():
    boxes = np.array([(0, 0, 0, 5, 5, 5), (5, 0, 0, 5, 5, 5)])
    masks = np.zeros((6, 10, 10), dtype=bool)
    legal = masks.copy()
    legal[3, 7, 7] = True
    pictures = [
        draw(SIZE, EMPTY),
        draw(SIZE, boxes),
        draw(SIZE, boxes[:1]),
        draw(SIZE, boxes * (1, 1, 1, 1, 1, 2)),
        draw(SIZE, boxes, title="full"),
        draw(SIZE, boxes, (3, 5, 2)),
        draw(SIZE, boxes, (3, 5, 2), masks),
        draw(SIZE, boxes, (3, 5, 2), legal),
        draw(SIZE, boxes, (3, 5, 2), legal, list("abcdef")),
        draw(SIZE, boxes, (3, 5, 2), legal[3:4], ["3 × 5 × 2"]),
    ]
    for i, one in enumerate(pictures):
        assert all((one != other).any() for other in pictures[:i])


def test_the_last_box_has_a_thick_outline_until_another_is_added_and_keeps_its_colour():
    boxes = np.array([(0, 0, 0, 3, 3, 3), (6, 6, 0, 3, 3, 3)])
    one, both = (draw(SIZE, boxes[:n])[:, :470].astype(int) for n in (1, 2))
    assert (one.max(-1) < 60).sum() > 2 * (both.max(-1) < 60).sum()
    for image in (one, both):
        assert (np.abs(image - rgb(PALETTE[0])).max(-1) <= 1).sum() > 1000


@pytest.mark.parametrize("size", [(1, 1, 1), (120, 120, 120), (20, 10, 12), (3, 40, 5)])
def test_any_bin_lies_wholly_inside_the_picture(size):
    masks = np.ones((6, *size[:2]), dtype=bool)
    full = np.array([(0, 0, 0, *size)])
    for item, mask in [(None, None), (size, None), (size, masks), (None, masks[:1])]:
        image = draw(size, full, item, mask, title="title")
        rim = np.concatenate([image[[0, -1]].reshape(-1, 3), image[:, [0, -1]].reshape(-1, 3)])
        assert (rim == 255).all()
        assert (image < 255).any()


def test_a_saved_picture_reads_back_as_it_was(tmp_path):
    image = draw(SIZE, RING[:1], (1, 2, 3))
    save(tmp_path / "bin.png", image)
    read = imread(tmp_path / "bin.png")[..., :3]
    np.testing.assert_array_equal(np.round(read * 255).astype(np.uint8), image)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"size": (10, 10)}, "three sides W, D, H"),
        ({"boxes": np.zeros((2, 5), dtype=int)}, r"need int \[n, 6\]"),
        ({"boxes": np.zeros((0, 6))}, r"need int \[n, 6\]"),
        ({"boxes": np.array([(0, 0, 0, 1, 1, 1), (6, 0, 0, 5, 1, 1)])}, "box 1 .* at most"),
        ({"boxes": np.array([(0, -1, 0, 5, 1, 1)])}, "at least 0"),
        ({"boxes": np.array([(0, 0, 0, 5, 0, 1)])}, "at least 1"),
        (
            {"boxes": np.array([(0, 0, 0, 5, 5, 5), (4, 4, 4, 5, 5, 5)])},
            r"overlap, some of \[0, 1\]",
        ),
        ({"item": (1, 2)}, "three sides w, d, h"),
        ({"item": (1, 2, 0)}, "three sides w, d, h"),
        ({"masks": np.ones((6, 9, 10), dtype=bool)}, r"need \[A, 10, 10\]"),
        ({"masks": np.ones((10, 10), dtype=bool)}, r"need \[A, 10, 10\]"),
        ({"masks": np.ones((2, 10, 10), dtype=bool), "labels": ["one"]}, "each of 2 masks"),
        ({"labels": ["one"]}, "each of 0 masks"),
        ({"pixels": (0, 10)}, "at least one column"),
    ],
)
def test_impossible_arguments_are_refused_with_what_would_be_right(change, words):
    with pytest.raises(ValueError, match=words):
        draw(**{"size": SIZE, "boxes": EMPTY} | change)


def test_a_title_is_drawn_as_it_is() -> None:
    boxes = np.zeros((0, 6), int)
    plain, titled = (draw((4, 4, 4), boxes, title=t) for t in ("", "runs/$a_$ plays"))
    assert np.any(plain != titled)


def test_an_animation_shows_every_placement_and_keeps_the_bin_in_its_place(tmp_path) -> None:
    boxes = np.array([(0, 0, 0, 4, 4, 2), (0, 0, 2, 4, 4, 2), (0, 4, 0, 2, 2, 3)])
    film = Film(Plan.of_boxes((8, 8, 8), boxes), "a policy")
    save_film(tmp_path / "bin.gif", film)
    with Image.open(tmp_path / "bin.gif") as images:
        frames = [
            np.asarray(frame.convert("RGB")).astype(int) for frame in ImageSequence.Iterator(images)
        ]
    assert len(frames) == len(boxes) + 1
    floor = [np.argwhere((frame == 232).all(2))[:, 0].max() for frame in frames]
    assert len(set(floor)) == 1  # the front corner of the floor, which no box hides
    assert all(np.any(before != after) for before, after in pairwise(frames))
