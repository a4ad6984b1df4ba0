"""Draw how a bin was packed, box by box, as an animated GIF."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from marl_pack.files import write_atomically
from marl_pack.plan import Plan
from marl_pack.render.picture import draw, drawable

PIXELS = (720, 480)
SECONDS, LAST_SECONDS = 0.6, 3.0
"""How long each frame is shown, and how long the last frame is shown."""


def frames(plan: Plan, title: str = "") -> Iterator[NDArray[np.uint8]]:
    """Yield a picture of the empty bin, then one after each placement, uint8 [rows, columns, 3].

    The box that comes next is drawn beside the bin, as it will be placed.

    Args:
        plan: the boxes of one bin.
        title: the title of each picture, before the number of boxes and the utilization.
    """
    whole = drawable(plan)
    boxes = whole.boxes
    for count in range(len(boxes) + 1):
        following = None
        if count < len(boxes):
            w, d, h = boxes[count, 3:].tolist()
            following = (w, d, h)
        filled = plan.first(count).utilization
        caption = f"{title}: " if title else ""
        caption += f"box {count} of {len(boxes)}, {filled:.0%} of the bin filled"
        yield draw(
            whole.size, boxes[:count], following, title=caption, pixels=PIXELS, leave_space=True,
            parts=whole.parts,
        )  # fmt: skip


def save_gif(path: Path, plan: Plan, title: str = "") -> None:
    """Write an animated GIF of how one bin was packed.

    Args:
        path: the file to write.
        plan: the boxes of one bin.
        title: the title of each frame.

    Raises:
        OSError: if the file cannot be written.
    """
    pictures = list(frames(plan, title))
    # One palette for all frames, so that no colour changes from frame to frame.
    palette = Image.fromarray(np.concatenate(pictures)).quantize(128, dither=Image.Dither.NONE)
    first, *others = (
        Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE)
        for picture in pictures
    )
    durations = [round(1000 * SECONDS)] * len(others) + [round(1000 * LAST_SECONDS)]
    write_atomically(
        path,
        lambda file: first.save(
            file, format="GIF", save_all=True, append_images=others, duration=durations, loop=0
        ),
    )
