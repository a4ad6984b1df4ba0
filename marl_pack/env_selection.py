"""The packing game with a buffer, a preview or several bins, as a PettingZoo environment.

`env_aec.env(buffer=5)` returns it: :mod:`marl_pack.env_aec` with one or more of the settings
`buffer` = k, `preview` = p, `bins` = b and `closings`. k boxes are visible, and b bins are open. An
agent that acts first selects a box and a bin. Turns, masks, the shared reward and all other
arguments are those of :mod:`marl_pack.env_aec`.

| | |
|---|---|
| Agents | `["selection_0", "orientation_0", "placement_0"]`, in this order each cycle |
| … with k = b = 1 | `["orientation_0", "placement_0"]` |
| Action spaces | `Discrete(k · b)`, `Discrete(6)` and `Discrete(W · D)` |
| Observation spaces | `Dict` of `observation` and `action_mask` |
| … `observation` | `Box(0, 1, (P, W, D), float32)` |
| … `action_mask` | `Box(0, 1, (n,), int8)`, n = k · b, 6 and W · D |
| State space | `Box(0, 1, (P + 1, W, D), float32)` |

```python
from marl_pack import env_aec

env = env_aec.env(buffer=3, preview=2, bins=2)
env.reset(seed=42)
for agent in env.agent_iter():
    observation, reward, termination, truncation, info = env.last()
    action = None  # for an agent that has ended
    if not (termination or truncation):
        action = env.action_space(agent).sample(observation["action_mask"])  # your policy
    env.step(action)
print(info["utilization"], info["closed"])
env.close()
```

## A cycle

The selection agent chooses an *option*: number `i · b + j` is the box in slot i and the bin j. It
is legal if the box has a place in this bin, so a choice never leads into a dead end. Then the
orientation agent and the placement agent act on this box and this bin. The next box of the conveyor
takes the empty slot.

When no visible box has a place in any bin, the fullest bin is closed and replaced by an empty one
(`docs/buffer.md`). The last closing ends the episode.

## Observation

| planes | what they show |
|---|---|
| 4 | heightmap of the selected bin, and sides of the selected box, as in `env_aec` |
| b | heightmap of each open bin |
| 3 k | sides of each visible box; 0 for an empty slot |
| 3 p | sides of each box of the preview, the next one first; 0 after the end of the sequence |

So P = 4 + b + 3 k + 3 p. The selection agent sees 0 in the first four. With k = b = 1 there are no
planes of bins and slots, and P = 4 + 3 p. All lengths are divided by the longest side of the bin.
With `pad_actions=True` all agents have the same spaces, and one more plane says who acts: 0 for the
orientation agent, 1 for the placement agent, 0.5 for the selection agent. `state()` has the P
planes of the acting agent, and this plane.

## Reward

It is that of `env_aec`, as a share of one bin: with several bins, a reward of 1 fills one of
them.

## What was packed

`info["utilization"]` is the packed volume of all bins opened so far, as a share of theirs;
`info["packed"]` is the number of boxes in them, `info["opened"]` and `info["closed"]` are numbers
of bins. `env.unwrapped.plan` has the boxes of all bins.
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Unpack

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from marl_pack.env_cells import RENDER_MODES, TAKEN, CellEnv, fill_planes
from marl_pack.env_turns import ORIENTATION, PLACEMENT, SELECTION
from marl_pack.game.packing import Packing
from marl_pack.game.selection import SelectionPacking
from marl_pack.game.spec import SelectionOptions, SelectionSpec
from marl_pack.geometry import ORIENTATIONS
from marl_pack.items import DEFAULT_SIDES, Items, Stream
from marl_pack.option_record import document, with_options

TURN = {ORIENTATION: 0.0, PLACEMENT: 1.0, SELECTION: 0.5}
"""The number in the plane that says who acts."""


@document(SelectionSpec, " " * 8)
class raw_env(CellEnv):  # noqa: N801  # PettingZoo's name for it
    """The environment with a buffer, a preview or several bins, without wrappers.

    The module's docstring describes agents, spaces and masks. Copies and pickles continue exactly
    from the same state, without the original's window.

    Args:
        bin_size, items, sides, max_cycles, render_mode, pad_actions, mask_in, illegal: as for
            :class:`marl_pack.env_aec.raw_env`.
        **options: the other options of the game (``bin`` is ``bin_size`` here):
        {options}

    Attributes:
        utilization: share of the volume of all opened bins that is filled, in [0, 1].
        plan: the boxes placed so far, bin by bin (:class:`marl_pack.plan.Plan`).

    Raises:
        ValueError: if an argument is impossible; says what would be right.
    """

    metadata = {  # noqa: RUF012  # PettingZoo reads it from the class
        "name": "marl_pack_selection_v0",
        "render_modes": RENDER_MODES,
        "render_fps": 2,
        "is_parallelizable": True,
    }

    def __init__(
        self,
        bin_size: tuple[int, int, int] = (10, 10, 10),
        items: str | Path | ArrayLike | Items | Mapping[str, Any] | Stream = "rs",
        *,
        sides: tuple[int, int] = DEFAULT_SIDES,
        max_cycles: int | None = None,
        render_mode: str | None = None,
        pad_actions: bool = False,
        mask_in: str = "observation",
        illegal: str = "terminate",
        **options: Unpack[SelectionOptions],
    ) -> None:
        self._spec = spec = SelectionSpec(bin=bin_size).with_options(options, TAKEN)
        game = SelectionPacking(1, items, spec=spec, sides=sides)
        choices = {ORIENTATION: len(ORIENTATIONS), PLACEMENT: game.floor.cells}
        planes = 4 + 3 * game.preview
        self._selects = game.options > 1
        if self._selects:
            choices = {SELECTION: game.options, **choices}
            planes += game.b + 3 * game.k
        self._planes_shown = planes
        self._selected: int | None = None
        super().__init__(
            game, choices, planes, max_cycles=max_cycles, render_mode=render_mode,
            pad_actions=pad_actions, mask_in=mask_in, illegal=illegal,
        )  # fmt: skip

    @property
    def game(self) -> SelectionPacking:
        """The game behind this view, for policies; only ``reset`` and ``step`` may change it."""
        game: SelectionPacking = self._game
        return game

    @property
    def selected(self) -> int | None:
        """The selected option; None in the selection agent's turn."""
        return self._selected

    def view(self) -> Packing:
        """Return the selected box and bin as a game of one box and one bin.

        Raises:
            ValueError: if no option is selected.
        """
        if self._selected is None:
            raise ValueError("view: no option is selected yet")
        return self.game.view(torch.tensor([self._selected]))

    # --- the game ---------------------------------------------------------------------------------

    def _new_game(self, items: Any) -> SelectionPacking:
        return SelectionPacking(1, items, spec=self._spec)

    def _play(self, choice: int) -> None:
        if self._selected is None:
            self._selected = choice
            self._read_selected()
        else:
            super()._play(choice)

    def _choose(self, orientation: int) -> None:
        self._chosen = orientation

    def _place(self, orientation: int, choice: int) -> None:
        option = self._selected
        outcome = self._game.place(  # step has checked that it is legal
            *(torch.tensor([number]) for number in (option, orientation, choice)), check=False
        )
        self._read_game()
        self._placed(float(outcome.reward), bool(outcome.done))

    def _nearest(self, action: int, legal: NDArray[np.intp]) -> int:
        return self.game.floor.nearest(action, legal)

    # --- observations -----------------------------------------------------------------------------

    def _read_game(self) -> None:
        """Read this cycle's numbers from the game."""
        game = self.game
        self._packed = int(game.state.placed)
        self.utilization = float(game.utilization)
        self._heightmaps = game.bins.heightmap.numpy()
        self._visible = game.items().sides.numpy()[:: game.b]
        self._previewed = game.previews().sides.numpy()
        self._selected = None if self._selects else 0
        self._read_selected()

    def _read_selected(self) -> None:
        """Read the box, the bin and the masks of the selected option."""
        game, option = self.game, self._selected
        self._item = np.zeros(3, np.int16)
        self._heightmap = np.zeros(game.size[:2], np.int16)
        self._masks = np.zeros((len(ORIENTATIONS), game.floor.cells), np.bool_)
        if option is None:
            return
        self._masks = game.state.mask.numpy()[0, option].reshape(len(ORIENTATIONS), -1)
        self._orientation_mask = np.asarray(self._masks.any(1))
        self._item = self._visible[option // game.b]
        self._heightmap = self._heightmaps[option % game.b]

    @property
    def _acting(self) -> str:
        """The agent whose turn it is."""
        return SELECTION if self._selected is None else super()._acting

    @property
    def legal_actions(self) -> NDArray[np.bool_]:
        """The legal actions of the acting agent, bool [k · b], [6] or [W · D]."""
        if self._selected is None:
            legal: NDArray[np.bool_] = self.game.selection_mask.numpy()[0]
            return legal
        if self._chosen is None:
            return self._orientation_mask
        cells: NDArray[np.bool_] = self._masks[self._chosen]
        return cells

    def _planes(self, agent: str | None) -> NDArray[np.float32]:
        game, whose_turn = self.game, agent is None or self.pad_actions
        count = self._planes_shown
        planes = np.zeros((count + whose_turn, *game.size[:2]), np.float32)
        if agent != SELECTION:
            chosen = 0 if agent == ORIENTATION else self._chosen or 0
            fill_planes(self._heightmap, self._item, ORIENTATIONS[chosen], self._unit, planes)
        first = 4
        if self._selects:
            planes[4 : 4 + game.b] = self._heightmaps / np.float32(self._unit)
            first += game.b
        boxes = np.concatenate(
            (self._visible[: len(self._visible) * self._selects], self._previewed)
        )
        sides = boxes.astype(np.float32).ravel() / np.float32(self._unit)
        planes[first : first + len(sides)] = sides[:, None, None]
        if whose_turn:
            planes[-1] = TURN[self._acting]
        return planes

    def _info(self, agent: str) -> dict[str, Any]:
        bins = {"opened": int(self.game.opened), "closed": int(self.game.state.closed)}
        return super()._info(agent) | bins

    # --- rendering --------------------------------------------------------------------------------

    def _title(self) -> str:
        closed = int(self.game.state.closed)
        more = f", {closed} closed" if closed else ""
        return f"{self._packed} boxes, utilization {self.utilization:.1%}{more}"

    def _text(self) -> str:
        from marl_pack.render.turn import turn_text

        def listed(name: str, boxes: NDArray[np.integer]) -> str:
            return f"{name} " + ", ".join(
                "x".join(map(str, box)) for box in boxes.tolist() if any(box)
            )

        game = self.game
        sides = self._item[list(ORIENTATIONS[self._chosen or 0])].tolist()
        lines = [self._title()]
        if self._selects:
            lines.append(listed("visible", self._visible))
        if game.preview:
            lines.append(listed("preview", self._previewed))
        maps = [
            turn_text(
                f"bin {j}", sides if self._is_selected(j) else (0, 0, 0), heights, game.size[2]
            )
            for j, heights in enumerate(self._heightmaps)
        ]
        return "\n".join(lines) + "\n" + "".join(maps)

    def _is_selected(self, bin: int) -> bool:
        return self._selected is not None and self._selected % self.game.b == bin

    def _picture(self) -> NDArray[np.uint8]:
        from marl_pack.render.turn import turn_picture

        game, bins = self.game, self.game.bins
        pictures = []
        for j in range(game.b):
            boxes = bins.boxes[j, : int(bins.count[j])].numpy()
            if self._is_selected(j):
                item, masks, chosen = self._item.tolist(), self._masks, self._chosen
            else:
                item, masks, chosen = [0, 0, 0], np.zeros_like(self._masks), None
            title = self._title() if game.b == 1 else f"bin {j}: {self._title()}"
            shaped = masks.reshape(len(ORIENTATIONS), *game.size[:2])
            pictures.append(turn_picture(title, game.size, boxes, item, shaped, chosen))
        return np.concatenate(pictures, axis=1)


raw_env.__signature__ = with_options(
    SelectionSpec, inspect.signature(raw_env), leave_out=tuple(TAKEN)
)
