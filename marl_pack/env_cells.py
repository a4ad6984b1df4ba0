"""What the environments on whole cells share: spaces, episodes, planes and pictures.

:mod:`marl_pack.env_aec` is the paper's game, :mod:`marl_pack.env_selection` the one with a buffer,
a preview or several bins. Both derive from :class:`CellEnv`.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from marl_pack.checks import truth_value
from marl_pack.env_turns import TurnEnv, one_of
from marl_pack.game.packing import Packing
from marl_pack.game.selection import SelectionPacking
from marl_pack.installation import njit
from marl_pack.plan import Plan

TAKEN = {"bin": "bin_size"}  # options of the game that have another name here
RENDER_MODES = ["human", "rgb_array", "ansi"]


class CellEnv(TurnEnv):
    """A view of one packing game on whole cells.

    An environment defines ``_new_game``, ``_read_game``, ``_planes``, ``_text`` and ``_picture`` in
    addition to what :class:`marl_pack.env_turns.TurnEnv` needs.

    Args:
        game: the game, with one bin or several, without ``auto_reset``.
        choices: number of actions of each agent, in the order of their turns.
        planes: number of planes that an agent observes.
        max_cycles, render_mode, pad_actions, mask_in, illegal: the arguments of
            :class:`marl_pack.env_aec.raw_env`.
    """

    def __init__(
        self, game: Packing | SelectionPacking, choices: Mapping[str, int], planes: int, *,
        max_cycles: int | None, render_mode: str | None, pad_actions: bool, mask_in: str,
        illegal: str,
    ) -> None:  # fmt: skip
        super().__init__(list(choices), max_cycles, mask_in, illegal)
        if render_mode is not None:
            one_of("render_mode", render_mode, RENDER_MODES)
        self.render_mode = render_mode
        self.pad_actions = truth_value(pad_actions, "pad_actions")
        self._stream_game: Any = game
        self._game: Any = game
        self._unit = max(game.size)
        self._choices = dict(choices)
        if pad_actions:
            self._choices = dict.fromkeys(choices, max(choices.values()))
        width, depth, _ = game.size
        observed = spaces.Box(0.0, 1.0, (planes + self.pad_actions, width, depth), np.float32)
        self.action_spaces = {agent: spaces.Discrete(n) for agent, n in self._choices.items()}
        self.observation_spaces = {
            agent: observed
            if mask_in == "info"
            else spaces.Dict(  # pairs, since Gymnasium sorts the keys of a plain dict
                [("observation", observed), ("action_mask", spaces.Box(0, 1, (n,), np.int8))]
            )
            for agent, n in self._choices.items()
        }
        self.state_space = spaces.Box(0.0, 1.0, (planes + 1, width, depth), np.float32)
        self._window: Any = None  # opened by the first picture
        self._read_game()

    @property
    def plan(self) -> Plan:
        """The boxes placed so far in this episode; bin by bin, each in its order."""
        plan: Plan = self._game.plans()[0]
        return plan

    def _new_game(self, items: Any) -> Any:
        """Return a game with other items and the same options."""
        raise NotImplementedError

    def _read_game(self) -> None:
        """Read this turn's numbers from the game."""
        raise NotImplementedError

    # --- episodes ---------------------------------------------------------------------------------

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> None:
        """Empty the bin and begin an episode.

        Args:
            seed: seed from which the item stream begins again. Without a seed the stream continues
                with its next episode (from a random seed if there never was one).
            options: ``{"items": …}`` plays these items once instead of the stream's: an array
                [L, 3], or items with attributes.

        Raises:
            ValueError: for an impossible seed or impossible items, or if no episode has a legal
                first item; then nothing has changed.
        """
        seed, episode = self._next_episode(seed, options)
        if options and options.get("items") is not None:
            try:
                game = self._new_game(options["items"])
            except ValueError as error:
                raise ValueError(f'options["items"]: {error}') from None
            if not bool(game.alive):
                first = (game.items if isinstance(game, Packing) else game.items()).sides[0]
                raise ValueError(
                    f'options["items"]: the first item {first.tolist()} may be placed nowhere in '
                    "the empty bin: check orientations, the rule's margin and com_offset"
                )
        else:
            game = self._stream_game
            # An episode may have no legal first item: skip it.
            game.reset(seed, first_episode=episode + 1, skip=True)
            episode = int(game.episode)
        self._seed, self._episode, self._game = seed, episode, game
        self._begin()
        self._read_game()
        self.infos = {agent: self._info(agent) for agent in self.possible_agents}

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for a copy or a pickle: everything except the window."""
        return vars(self) | {"_window": None}

    # --- observations -----------------------------------------------------------------------------

    def _planes(self, agent: str | None) -> NDArray[np.float32]:
        """Return what an agent observes, or with None the state, float32 [P, W, D]."""
        raise NotImplementedError

    def observe(self, agent: str) -> Any:
        """Return the agent's observation; this works in all agents' turns and after the end."""
        planes = self._planes(agent)
        if self.mask_in == "info":
            return planes
        return {"observation": planes, "action_mask": self.action_mask(agent)}

    def state(self) -> NDArray[np.float32]:
        """Return float32 [P, W, D]: what the acting agent sees, and a plane that says who acts."""
        return self._planes(None)

    # --- rendering --------------------------------------------------------------------------------

    def render(self) -> NDArray[np.uint8] | str | None:
        """Show the bin, the visible item and the cells where it may be placed.

        Returns:
            uint8 [rows, columns, 3] for ``"rgb_array"``, text for ``"ansi"``, None for ``"human"``
            (a window shows the picture).
        """
        if self.render_mode is None:
            warnings.warn(
                f"render() without a render_mode: make the environment with one of {RENDER_MODES}",
                stacklevel=2,
            )
            return None
        if self.render_mode == "ansi":
            return self._text()
        image = self._picture()
        if self.render_mode == "rgb_array":
            return image
        if self._window is None:
            from marl_pack.render.window import Window

            self._window = Window()
        self._window.show(image)
        return None

    def _text(self) -> str:
        """Return the turn as text."""
        raise NotImplementedError

    def _picture(self) -> NDArray[np.uint8]:
        """Draw the turn, uint8 [rows, columns, 3]."""
        raise NotImplementedError

    def close(self) -> None:
        """Close the window, if one was opened."""
        if self._window is not None:
            self._window.close()
            self._window = None


@njit(cache=True)
def fill_planes(
    heightmap: Any, item: Any, orientation: tuple[int, int, int], unit: int, planes: Any
) -> None:
    """Write the planes float32 [4, W, D] of a bin and an item: the heightmap and three sides.

    Args:
        heightmap: int16 [W, D], in cells.
        item: int16 [3], sides w, d, h in cells.
        orientation: the axes of the item's sides along x, y, z.
        unit: longest side of the bin, by which all lengths are divided.
        planes: float32 [4 or more, W, D], where they are written.
    """
    longest = np.float32(unit)
    for x in range(heightmap.shape[0]):
        for y in range(heightmap.shape[1]):
            planes[0, x, y] = np.float32(heightmap[x, y]) / longest
    for axis in range(3):
        planes[1 + axis] = np.float32(item[orientation[axis]]) / longest
