"""Draw pictures and films of a stack as it is built in physics, box by box.

All boxes and the bin's walls collide, so that fallen boxes come to rest as they would in a
real bin. PyVista (VTK) draws them; it needs neither a GPU nor a display.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from marl_pack.extras import missing
from marl_pack.files import check_writable, moved_into_place
from marl_pack.render.colours import PALETTE
from marl_pack.sapien_check.stack import Floats, Stack
from marl_pack.sapien_check.world import DEFAULT, Pass, Physics, World

try:
    import imageio.v2 as imageio
    import pyvista
    from vtkmodules.vtkCommonCore import vtkLogger
except ModuleNotFoundError as error:
    raise missing(error, "pictures need PyVista and imageio", "film") from None

vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)  # it warns of missing displays

FPS = 25
EACH = 0.4  # seconds between two placements
REST = 2.0  # seconds after the last box, or after a fall
STEP = Pass(1 / 1000, 50)
ENDINGS = (".png", ".gif", ".mp4")
PIXELS = (800, 800)
FALLEN = "#d62728"
# Without the two colours that are too similar to FALLEN.
COLOURS = [colour for colour in PALETTE if colour not in ("#e15759", "#ff9da7")]


@dataclass(frozen=True)
class Frame:
    """The poses of the boxes at one moment."""

    middles: Floats  # [k, 3]  metres
    rotations: Floats  # [k, 4]  quaternions, w first
    moved: tuple[int, ...]  # indices of boxes that moved by more than a threshold


def simulate(stack: Stack, physics: Physics = DEFAULT) -> Iterator[Frame]:
    """Yield the frames of the stack being built; after a fall no more boxes are added.

    A new box appears at its nominal position; the earlier boxes begin where they have settled.
    """
    physics = replace(physics, everything=True)
    stack = stack.scaled(1.0)  # in its own size, with masses that the solver can handle
    frame = Frame(np.zeros((0, 3)), np.zeros((0, 4)), ())
    for count in range(1, len(stack) + 1):
        world = World(stack.first(count), physics, STEP)
        world.set_poses(frame.middles, frame.rotations)
        for frame in _watch(world, EACH):
            yield frame
        if frame.moved:
            break
    if len(stack):
        yield from _watch(world, REST)


def _watch(world: World, seconds: float) -> Iterator[Frame]:
    """Simulate this number of seconds and yield the frames."""
    for _ in range(round(seconds * FPS)):
        world.run(1 / FPS)
        yield Frame(*world.poses(), world.moved())


class View:
    """A view of the bin from above one corner, drawn without a window.

    Args:
        stack: all boxes that will be shown.
        title: the text above the picture; the number of boxes placed so far is added.
    """

    def __init__(self, stack: Stack, title: str = "") -> None:
        self.plotter = pyvista.Plotter(off_screen=True, window_size=list(PIXELS))
        self.plotter.set_background("white")
        self.plotter.enable_anti_aliasing("msaa", multi_samples=4)
        w, d, h = (float(s) for s in stack.size)
        outline = pyvista.Box((0, w, 0, d, 0, h))
        self.plotter.add_mesh(outline, style="wireframe", color="#707070", line_width=2)
        floor = pyvista.Box((0, w, 0, d, -0.01 * h, 0))
        self.plotter.add_mesh(floor, color="#e8e8e8")
        self.title = title
        self.boxes = [self._add(stack, i) for i in range(len(stack))]
        self.plotter.view_vector((1.0, -1.4, 0.9), viewup=(0, 0, 1))
        self.plotter.camera.zoom(0.95)

    def _add(self, stack: Stack, i: int) -> list[Any]:
        """Add a box and its edges, hidden and with the middle at the origin; return both."""
        w, d, h = (float(s) for s in stack.sides[i])
        cube = pyvista.Cube(x_length=w, y_length=d, z_length=h)
        colour = COLOURS[i % len(COLOURS)]
        edges = cube.extract_feature_edges(30)
        actors = [
            self.plotter.add_mesh(cube, color=colour, ambient=0.35),
            self.plotter.add_mesh(edges, color="#202020", line_width=2),
        ]
        for actor in actors:
            actor.visibility = False
        return actors

    def picture(self, frame: Frame) -> NDArray[np.uint8]:
        """Draw one frame, uint8 [height, width, 3]; boxes that have moved are red."""
        for i, actors in enumerate(self.boxes):
            visible = i < len(frame.middles)
            for actor in actors:
                actor.visibility = visible
                if visible:
                    actor.user_matrix = _matrix(frame.middles[i], frame.rotations[i])
            if i in frame.moved:
                actors[0].prop.color = FALLEN
        if self.title:
            caption = caption_of(self.title, len(frame.middles), len(self.boxes))
            self.plotter.add_text(caption, font_size=9, color="black", name="caption")
        self.plotter.render()
        image: NDArray[np.uint8] = self.plotter.screenshot(return_img=True)
        return image

    def close(self) -> None:
        """Free the memory of the plotter."""
        self.plotter.close()


def caption_of(title: str, placed: int, boxes: int) -> str:
    """Return the text above one frame of a film."""
    return f"{title}: {placed} of {boxes} boxes"


def _matrix(middle: Floats, rotation: Floats) -> Floats:
    """Return the matrix [4, 4] of a pose.

    Args:
        middle: x, y, z of the box's middle in metres.
        rotation: a quaternion, w first.
    """
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat(rotation, scalar_first=True).as_matrix()
    matrix[:3, 3] = middle
    return matrix


def check_path(path: Path) -> None:
    """Raise ValueError if no picture or film can be written to this path."""
    if path.suffix.lower() not in ENDINGS:
        raise ValueError(f"{path}: needs one of the endings {', '.join(ENDINGS)}")
    check_writable(path)


def render(
    stack: Stack,
    path: Path,
    title: str = "",
    physics: Physics = DEFAULT,
    progress: Callable[[int], object] = lambda boxes: None,
) -> Frame:
    """Write a film of the stack being built (.mp4, .gif), or a picture of its end (.png).

    Args:
        stack: the stack to build.
        path: the file of the film or picture.
        title: the text above each frame.
        physics: settings of the simulation.
        progress: a function that is called with the number of boxes placed so far.

    Returns:
        The last frame.

    Raises:
        ValueError: if the path has another ending or its folder is missing, or the stack is empty.
    """
    check_path(path)
    if not len(stack):
        raise ValueError("the stack has no boxes: nothing to show")
    view = View(stack, title)
    try:
        with moved_into_place(path) as part:
            if path.suffix.lower() == ".png":
                for frame in simulate(stack, physics):
                    progress(len(frame.middles))
                imageio.imwrite(part, view.picture(frame))
                return frame
            options: dict[str, Any] = {"fps": FPS}
            if path.suffix.lower() == ".gif":
                options = {"duration": 1000 / FPS, "loop": 0}
            writer: Any = imageio.get_writer(part, mode="I", **options)
            with writer as film:
                for frame in simulate(stack, physics):
                    film.append_data(view.picture(frame))
                    progress(len(frame.middles))
            return frame
    finally:
        view.close()
