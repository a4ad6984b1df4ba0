"""A window that shows pictures one after another."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray


class Window:
    """A window of matplotlib that opens with the first picture."""

    def __init__(self) -> None:
        self._parts: tuple[Any, Any] | None = None  # matplotlib's figure and AxesImage

    def show(self, image: NDArray[np.uint8]) -> None:
        """Show a picture, uint8 [rows, columns, 3]; all pictures must have the same size."""
        from matplotlib import pyplot

        if self._parts is None:
            figure, axes = pyplot.subplots(figsize=(image.shape[1] / 100, image.shape[0] / 100))
            if figure.canvas.required_interactive_framework is None:
                warnings.warn(
                    "no display for render_mode='human': matplotlib found no window system; "
                    "use render_mode='rgb_array' for pictures",
                    stacklevel=4,
                )
            axes.set_position((0, 0, 1, 1))
            axes.axis("off")
            self._parts = figure, axes.imshow(image)
            figure.show(warn=False)
        figure, axes_image = self._parts
        axes_image.set_data(image)
        figure.canvas.draw_idle()
        figure.canvas.flush_events()

    def close(self) -> None:
        """Close the window, if it was opened."""
        if self._parts is not None:
            from matplotlib import pyplot

            pyplot.close(self._parts[0])
            self._parts = None
