"""Draw how bins were packed, box by box: frames, animated GIF and MP4."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from marl_pack.extras import missing
from marl_pack.files import moved_into_place
from marl_pack.plan import Plan
from marl_pack.render.choices import ENDINGS
from marl_pack.render.colours import PALETTE, colour_plan
from marl_pack.render.picture import draw, draw_plan, drawable

PIXELS = (720, 480)
SECONDS, LAST_SECONDS = 0.6, 3.0
"""How long each frame is shown, and how long the last frame is shown."""
RATE = 20
"""Pictures a second in an MP4; a frame is shown for one or several of them."""
MOST_PIXELS = 100_000_000
"""Pixels of the largest picture of several bins."""
BAR = 6
"""Height in pixels of the bar that shows how many boxes are placed."""
DONE, WAITING = (11, 92, 173), (222, 226, 230)
"""Colours of the bar."""
LONGEST_TITLE = 60
"""Characters of a title; the rest of a longer one is left out."""
SAMPLES = 12
"""Frames from which the palette of a GIF is made."""

Frame = NDArray[np.uint8]


class Film:
    """The frames of a plan: one before the first box, and one after each placement.

    A frame shows the bin in which the last box was placed, and the next box beside it.

    Args:
        plan: the boxes.
        title: the title of each frame, before the number of boxes and the utilization.
        pixels: (columns, rows) of a frame.
        colouring: what the colours show (:func:`marl_pack.render.colours.colour_plan`).

    Raises:
        ValueError: if the plan has nothing that the colouring could show.
    """

    def __init__(
        self,
        plan: Plan,
        title: str = "",
        pixels: tuple[int, int] = PIXELS,
        colouring: str = "item",
    ) -> None:
        self.plan, self.pixels = plan, pixels
        self.title = title if len(title) <= LONGEST_TITLE else f"{title[: LONGEST_TITLE - 1]}…"
        colours = colour_plan(plan, colouring)
        if colours is None:
            raise ValueError(f"colours by {colouring}: the plan has no such values, or only one")
        self.colours = colours.boxes
        self._bins = [plan.in_bin(k) for k in range(len(plan.bin_sizes))]
        self._whole = [drawable(of_bin) for of_bin in self._bins]

    def __len__(self) -> int:
        return len(self.plan) + 1

    def caption(self, step: int) -> str:
        """Return the caption after ``step`` boxes, such as "box 7 of 23, bin 0, 61 %"."""
        bin = self.bin_at(step)
        words = [f"box {step} of {len(self.plan)}"]
        if len(self._bins) > 1:
            words.append(f"bin {bin}")
        here = int((self.plan.bins[:step] == bin).sum())
        words.append(f"{100 * self._bins[bin].first(here).utilization:.0f} %")
        return (f"{self.title}: " if self.title else "") + ", ".join(words)

    def bin_at(self, step: int) -> int:
        """Return the bin in which the last box was placed after ``step`` boxes."""
        return int(self.plan.bins[max(0, step - 1)]) if len(self.plan) else 0

    def frame(self, step: int) -> Frame:
        """Draw the frame after ``step`` boxes, uint8 [rows, columns, 3]."""
        bin = self.bin_at(step)
        of_bin = np.flatnonzero(self.plan.bins == bin)
        here = int((of_bin < step).sum())
        following = None
        if step < len(self.plan):
            other = int(self.plan.bins[step])
            place = int((self.plan.bins[:step] == other).sum())
            scale = self._whole[bin].parts / self._whole[other].parts
            w, d, h = (self._whole[other].boxes[place, 3:] * scale).round().astype(int).tolist()
            following = (w, d, h)
        colours = [self.colours[i] for i in of_bin[:here]]
        if step < len(self.plan):
            colours.append(self.colours[step])
        whole = self._whole[bin]
        picture = draw(
            whole.size, whole.boxes[:here], following, title=self.caption(step),
            pixels=self.pixels, leave_space=True, parts=whole.parts, colours=colours or PALETTE,
        )  # fmt: skip
        picture[-BAR:] = WAITING
        picture[-BAR:, : round(picture.shape[1] * step / max(1, len(self.plan)))] = DONE
        return picture

    def frames(self) -> Iterator[Frame]:
        """Draw all frames, one after the other."""
        return (self.frame(step) for step in range(len(self)))


def bins_picture(film: Film, step: int) -> Frame:
    """Draw all bins that were opened after ``step`` boxes, side by side, uint8 [rows, columns, 3].

    Four bins share a row. The picture of each bin has the film's size.

    Raises:
        ValueError: if it would have more than :data:`MOST_PIXELS` pixels.
    """
    plan, opened = film.plan, max(film.plan.bins[:step].tolist(), default=0) + 1
    if opened == 1:
        return film.frame(step)
    columns, rows = film.pixels
    if opened * columns * rows > MOST_PIXELS:
        raise ValueError(
            f"a picture of {opened} bins of {columns} x {rows} pixels each has more than "
            f"{MOST_PIXELS:,} pixels: needs fewer pixels"
        )
    pictures = []
    for k in range(opened):
        of_bin = np.flatnonzero(plan.bins[:step] == k)
        packed = plan.in_bin(k).first(len(of_bin))
        title = f"bin {k}: {len(packed)} boxes, {packed.utilization:.0%}"
        colours = [film.colours[i] for i in of_bin] or PALETTE
        pictures.append(draw_plan(packed, title, film.pixels, colours))
    across = min(4, opened)
    pictures += [np.full_like(pictures[0], 255)] * (-opened % across)
    return np.vstack([np.hstack(pictures[k : k + across]) for k in range(0, len(pictures), across)])


def save_film(
    path: Path,
    film: Film,
    *,
    seconds: float = SECONDS,
    step: int | None = None,
    progress: Callable[[], object] = lambda: None,
) -> None:
    """Write a picture (.png) or a film (.gif, .mp4).

    Args:
        path: the file to write; its ending says what.
        film: the frames.
        seconds: how long each frame is shown; the last one is shown for :data:`LAST_SECONDS`.
        step: number of boxes on a picture, all by default.
        progress: called after each frame.

    Raises:
        ValueError: for another ending.
        ModuleNotFoundError: if imageio is not installed, which writes .mp4 files.
        OSError: if the file cannot be written.
    """
    ending = path.suffix.lower()
    if ending == ".png":
        picture = bins_picture(film, len(film.plan) if step is None else step)
        with moved_into_place(path) as part:
            Image.fromarray(picture).save(part, "PNG")
        progress()
        return
    writers: dict[str, Callable[[Path, Film, float, Callable[[], object]], None]] = {
        ".gif": _write_gif, ".mp4": _write_mp4,
    }  # fmt: skip
    if ending not in writers:
        raise ValueError(f"{path}: needs the ending {', '.join(ENDINGS)}")
    with moved_into_place(path) as part:
        writers[ending](part, film, seconds, progress)


def _counted(film: Film, progress: Callable[[], object]) -> Iterator[Frame]:
    """Draw the frames, and call ``progress`` after each."""
    for frame in film.frames():
        yield frame
        progress()


def _write_gif(path: Path, film: Film, seconds: float, progress: Callable[[], object]) -> None:
    """Write an animated GIF, one frame after the other."""
    # One palette for all frames, so that no colour changes from frame to frame.
    steps = np.unique(np.linspace(0, len(film) - 1, SAMPLES).round().astype(int))
    sample = np.concatenate([film.frame(step) for step in steps.tolist()])
    palette = Image.fromarray(sample).quantize(128, dither=Image.Dither.NONE)
    images = (
        Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE)
        for frame in _counted(film, progress)
    )
    first = next(images)
    durations = [round(1000 * seconds)] * (len(film) - 1) + [round(1000 * LAST_SECONDS)]
    first.save(
        path, format="GIF", save_all=True, append_images=images, duration=durations, loop=0
    )  # fmt: skip


def _write_mp4(path: Path, film: Film, seconds: float, progress: Callable[[], object]) -> None:
    """Write an MP4 film, one frame after the other."""
    try:
        import imageio.v2 as imageio
        import imageio_ffmpeg  # noqa: F401  # imageio asks for it late
    except ModuleNotFoundError as error:
        raise missing(error, "MP4 films need imageio and its ffmpeg", "video") from None
    options: dict[str, Any] = {"fps": RATE, "codec": "libx264", "macro_block_size": 2}
    film_writer: Any = imageio.get_writer(path, format="FFMPEG", mode="I", **options)
    with film_writer as writer:
        written = 0
        for step, frame in enumerate(_counted(film, progress)):
            # The sum is rounded, not each frame, so that a film has the right length.
            end = LAST_SECONDS if step == len(film) - 1 else seconds
            end = round(RATE * (step * seconds + end))
            while written < end:
                writer.append_data(_even(frame))
                written += 1


def _even(frame: Frame) -> Frame:
    """Return a frame with even numbers of rows and columns, as the codec needs."""
    rows, columns = (side - side % 2 for side in frame.shape[:2])
    return frame[:rows, :columns]
