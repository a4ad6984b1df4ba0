"""The packing game as a two-agent PettingZoo environment (AEC).

A conveyor shows one box at a time. The agent `orientation_0` chooses one of its orientations, then
the agent `placement_0` places it in the bin, for good. Both agents get the same reward. Masks allow
exactly the actions after which the stack still stands (Zhou et al. 2024, Algorithms 1 and 2).

| | |
|---|---|
| Import | `from marl_pack import env_aec` |
| Registered as | `marl_pack/Packing-v0`, by `import marl_pack` (PettingZoo ≥ 1.27) |
| Actions | discrete |
| Parallel API | yes, turn by turn |
| Manual control | no |
| Agents | `["orientation_0", "placement_0"]`, in this order each cycle |
| Number of agents | 2 |
| Action spaces | `Discrete(6)` and `Discrete(W · D)` |
| Observation spaces | `Dict` of `observation` and `action_mask` |
| … `observation` | `Box(0, 1, (4, W, D), float32)` |
| … `action_mask` | `Box(0, 1, (n,), int8)`, n = 6 and W · D |
| State space | `Box(0, 1, (5, W, D), float32)` |
| Reward | dense, shared |
| Render modes | `rgb_array`, `human`, `ansi` |

```python
from marl_pack import env_aec

env = env_aec.env(render_mode="ansi")
env.reset(seed=42)
for agent in env.agent_iter():
    observation, reward, termination, truncation, info = env.last()
    action = None  # for an agent that has ended
    if not (termination or truncation):
        action = env.action_space(agent).sample(observation["action_mask"])  # your policy
    env.step(action)
print(info["utilization"])
env.close()
```

## A cycle

An item w × d × h arrives. The orientation agent chooses one of six orientations. The placement
agent chooses the cell of the item's low corner, `x · D + y`. The item comes to rest on the highest
column of its footprint. Then the next item arrives.

| orientation | 0 | 1 | 2 | 3 | 4 | 5 |
|---|---|---|---|---|---|---|
| sides along x, y, z | w d h | d w h | w h d | h w d | d h w | h d w |

For orientation o, `o // 2` says which side is vertical (h, d, w), and `o ^ 1` is o rotated by 90°
about the vertical. So `orientations=(0, 1)` keeps all items upright, and `(0,)` does not rotate
them. An item may be restricted further (`docs/items.md`): the masks then exclude its other
orientations.

## Observation

The observation has four planes: the heightmap, and one constant plane for each of the item's three
sides. All lengths are divided by the longest side of the bin. The orientation agent always sees the
sides w, d, h of the item as it comes. The placement agent sees the sides along x, y, z in the
chosen orientation.

`observe(agent)` and `state()` work at any time, also after the end. `state()` has the heightmap,
the item as it lies now, and a plane that is 0 in the orientation agent's turn and 1 in the
placement agent's turn.

## Legal actions

`observation["action_mask"]` (or `info["action_mask"]`, with `mask_in="info"`) is 1 for the legal
actions of the agent whose turn it is. It is 0 everywhere for the other agent.

- A cell is legal if the item placed there is inside the bin and stands under the stability rule
  (`docs/stability.md`).
- An orientation is legal if it has a legal cell. So until the episode ends, each turn has at least
  one legal action. (With `mask_orientations=False` every orientation is legal; choosing one without
  a legal cell ends the episode, with nothing placed and no reward.)

An illegal action ends the game, with a reward of -1 (`illegal_reward`) for its agent and 0 for the
other agent, as in PettingZoo's `TerminateIllegalWrapper`. With `illegal="repair"` the nearest legal
action is played instead.

## Reward

After each placement, both agents get `alpha · w d h / (W D H) - beta · waste / (W D H)` (Eq. 5-7).
`waste` is the empty space that the item newly encloses below it. After an orientation the reward
is 0.

## End of an episode

Both agents terminate in the same step: when the next item has no legal action, the stream has no
next item, or the bin holds `max_items` boxes. They are truncated together after `max_cycles` items.

## Arguments

`env()` takes its own arguments and the options of the game. `Packing`, settings files (`game:`) and
the commands that play have the same options; they call the bin's size `bin`, which is `bin_size`
here. An impossible value is refused with a message that says what would be right; for an unknown
option the message names the nearest valid name.

`env()` adds PettingZoo's wrappers in the usual order: `raw_env` → `TerminateIllegal` (not with
`illegal="repair"`) → `AssertOutOfBounds` → `OrderEnforcing`. `raw_env()` takes all arguments except
`illegal_reward`, and raises `ValueError` on an illegal action.

A game with `buffer`, `preview`, `bins` or `closings` has other agents and observations
(`docs/environment_selection.md`); `raw_env` does not take these options.

## Seeds and episodes

`reset(seed=s)` begins the item stream of seed s. `reset()` without a seed begins the next episode
of the stream. Episode k of a seed is the same in every batch and on every device.
`reset(options={"items": items})` plays these items once: an array [L, 3], or items with attributes.
An episode whose first item has no legal action is skipped; for items in `options`, `reset` raises
`ValueError` instead.

## What was packed

Every agent's `info` has two numbers: `utilization`, the share of the bin that is filled, and
`packed`, the number of boxes in it. `env.unwrapped.plan` is the record of the boxes placed so far:
ids, positions, sides as placed, orientations, weights. `plan.to_json(path)` and
`plan.to_csv(path)` write it for other programs.

A copy (`copy.copy`, `copy.deepcopy`) or a pickle of an environment continues exactly and shares
nothing with the original. A copy does not have the original's window.

## Parallel API

`parallel_env()` plays one *turn* in each step: `infos[agent]["active_agent"]` names the acting
agent, the other agent's action is ignored, and every mask is exact.

`parallel_env(simultaneous=True)` plays one *item* in each step. The placement agent has to choose
before the orientation is known, so its mask is all 0, and `illegal="repair"` is required. Prefer
the default.

## Limits

| what | limit |
|---|---|
| bin | 32,767 × 32,767 × 16,383 cells |
| seed | 0 … 2⁶³ - 1 |
| `max_items` | 2³¹ - 1 |

Actions, seeds and numbers of items have to be whole numbers: 5.0, `True` and `"5"` are refused. A
value beyond a limit is refused before anything has changed.

## Version history

- v0: first release (marl_pack 0.1.0)
"""

# This module is a view of one game of marl_pack.game.packing.Packing, which has the rules of the
# game. The docstring above is the source of docs/environment.md: `make pages` writes it.

from __future__ import annotations

import inspect
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypedDict, Unpack, overload

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from pettingzoo import AECEnv

from marl_pack.bins import COUNT, FILLED, HEIGHTMAP
from marl_pack.env_cells import RENDER_MODES, TAKEN, CellEnv, fill_planes
from marl_pack.env_turns import AGENTS as AGENTS
from marl_pack.env_turns import ORIENTATION, PLACEMENT, in_parallel, one_of, wrap
from marl_pack.game.packing import Packing
from marl_pack.game.spec import (
    GameOptions,
    GameSpec,
    SelectionOptions,
    SelectionSpec,
    added_options,
)
from marl_pack.geometry import ORIENTATIONS
from marl_pack.items import DEFAULT_SIDES, Items, Stream
from marl_pack.option_record import document, with_options

if TYPE_CHECKING:
    from marl_pack.env_mm import OptionsMm

WORLDS = ("cells", "mm")


class Arguments(TypedDict, total=False):
    """The keyword arguments of the environments on cells that are no options of the game."""

    bin_size: tuple[int, int, int]
    items: str | Path | ArrayLike | Items | Mapping[str, Any] | Stream
    sides: tuple[int, int]
    max_cycles: int | None
    render_mode: str | None
    pad_actions: bool
    mask_in: str
    illegal: str


class Options(Arguments, SelectionOptions, total=False):
    """The keyword arguments of :func:`env`; its signature has their defaults."""


OPTIONS = frozenset(Options.__optional_keys__)
"""Names of the keyword arguments of the environments on cells."""


@overload
def env(
    *, world: Literal["cells"] = ..., illegal_reward: float = ..., **options: Unpack[Options]
) -> AECEnv: ...
@overload
def env(
    *, world: Literal["mm"], illegal_reward: float = ..., **options: Unpack[OptionsMm]
) -> AECEnv: ...
def env(*, world: str = "cells", illegal_reward: float = -1.0, **options: Any) -> AECEnv:
    """Return the environment in PettingZoo's usual wrappers.

    Args:
        world: ``"cells"``, or ``"mm"`` for boxes in millimetres: :mod:`marl_pack.env_mm` describes
            it and its other options.
        illegal_reward: reward of the agent that ends the game by an illegal action (only with
            ``illegal="terminate"``).
        **options: the arguments of :class:`raw_env`: ``bin_size``, ``items``, ``rule``, …; and
            ``buffer``, ``preview``, ``bins`` and ``closings``
            (:mod:`marl_pack.env_selection`).
    """
    return _make(world, illegal_reward, options)


def _make(world: str, illegal_reward: float, options: Mapping[str, Any]) -> AECEnv:
    """Return the environment of a world in PettingZoo's usual wrappers."""
    one_of("world", world, WORLDS)
    added = {name: options[name] for name in added_options() if name in options}
    if world == "mm":
        from marl_pack import env_mm

        if added:
            raise ValueError(f"{', '.join(added)}: needs world = 'cells'")
        return wrap(env_mm.raw_env(**options), illegal_reward)
    unknown = {name: value for name, value in options.items() if name not in OPTIONS}
    if SelectionSpec().with_options(unknown | added, TAKEN).selects:
        from marl_pack import env_selection

        return wrap(env_selection.raw_env(**options), illegal_reward)
    paper = {name: value for name, value in options.items() if name not in added}
    return wrap(raw_env(**paper), illegal_reward)


@overload
def parallel_env(
    *,
    world: Literal["cells"] = ...,
    simultaneous: bool = ...,
    illegal_reward: float = ...,
    **options: Unpack[Options],
) -> Any: ...
@overload
def parallel_env(
    *,
    world: Literal["mm"],
    simultaneous: bool = ...,
    illegal_reward: float = ...,
    **options: Unpack[OptionsMm],
) -> Any: ...
def parallel_env(
    *,
    world: str = "cells",
    simultaneous: bool = False,
    illegal_reward: float = -1.0,
    **options: Any,
) -> Any:
    """Return the environment in PettingZoo's parallel API.

    By default one step is one turn: all agents may send actions, only the action of the acting
    agent (``infos[agent]["active_agent"]``) is played, and every mask is exact.

    With ``simultaneous=True`` one step is one item: both agents act on the same observation, so the
    placement agent chooses before the orientation is known. Its mask would be stale: about a third
    of the placements in it would be illegal. So its mask is all 0, and the nearest legal action is
    played instead of an illegal one. Use this only for code in which every agent has to act in
    every step. It needs ``illegal="repair"``.

    Args:
        world: the argument of :func:`env`.
        simultaneous: whether one step is one item (see above).
        illegal_reward: the argument of :func:`env`.
        **options: the arguments of :func:`env`.

    Raises:
        ValueError: if ``simultaneous`` is true without ``illegal="repair"``.
    """
    environment = _make(world, illegal_reward, options)
    return in_parallel(environment, simultaneous)


@document(GameSpec, " " * 8)
class raw_env(CellEnv):  # noqa: N801  # PettingZoo's name for it
    """The environment without wrappers: one visible item, one bin and two agents.

    The module's docstring describes agents, spaces, masks, reward and the end of an episode. Copies
    and pickles continue exactly from the same state, without the original's window.

    Args:
        bin_size: (W, D, H) in cells.
        items: ``"rs"``, ``"cut1"``, ``"cut2"``, a file, an array [L, 3] or [S, L, 3], items with
            attributes or a stream (:func:`marl_pack.items.make_stream`).
        sides: shortest and longest side of generated items.
        max_cycles: items after which an episode is truncated; None for no limit.
        render_mode: ``"rgb_array"`` (a picture), ``"human"`` (a window) or ``"ansi"`` (text).
        pad_actions: whether both agents have the same spaces: ``Discrete(max(6, W · D))``, masks
            padded with 0, and a fifth plane: 0 in the orientation agent's turn, 1 in the placement
            agent's turn.
        mask_in: ``"observation"``; or ``"info"``: then the observation has only the planes, and
            each agent's info has its ``action_mask``.
        illegal: ``"terminate"``: an illegal action ends the game (in ``env``; ``raw_env`` raises
            ``ValueError``); ``"repair"``: the nearest legal action is played, and the agent's info
            says so.
        **options: the other options of the game (``bin`` is ``bin_size`` here):
        {options}

    Attributes:
        utilization: share of the bin filled, in [0, 1].
        plan: the boxes placed so far (:class:`marl_pack.plan.Plan`).

    Raises:
        ValueError: if an argument is impossible; says what would be right.
    """

    metadata = {  # noqa: RUF012  # PettingZoo reads it from the class
        "name": "marl_pack_v0",
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
        **options: Unpack[GameOptions],
    ) -> None:
        if several := [name for name in added_options() if name in options]:
            raise TypeError(
                f"{', '.join(several)}: raw_env has one visible box and one bin; use "
                "env_aec.env or env_selection.raw_env"
            )
        self._spec = GameSpec(bin=bin_size).with_options(options, TAKEN)
        self._all_masked = self._spec.mask_orientations  # an orientation chosen has a legal cell
        game = Packing(1, items=items, spec=self._spec, sides=sides, auto_reset=False)
        choices = {ORIENTATION: len(ORIENTATIONS), PLACEMENT: game.floor.cells}
        super().__init__(
            game, choices, 4, max_cycles=max_cycles, render_mode=render_mode,
            pad_actions=pad_actions, mask_in=mask_in, illegal=illegal,
        )  # fmt: skip
        self._orientation_played = np.zeros(1, np.int64)
        self._cell_played = np.zeros(1, np.int64)

    @property
    def game(self) -> Packing:
        """The game behind this view, for policies; only ``reset`` and ``step`` may change it."""
        game: Packing = self._game
        return game

    # --- the game ---------------------------------------------------------------------------------

    def _new_game(self, items: Any) -> Packing:
        return Packing(1, items=items, spec=self._spec, auto_reset=False)

    def _choose(self, orientation: int) -> None:
        if self._orientation_mask[orientation] and (
            self._all_masked or self._masks[orientation].any()
        ):
            self._chosen = orientation
        else:  # only without mask_orientations: the episode ends and nothing is placed
            self._place(orientation, 0)

    def _place(self, orientation: int, choice: int) -> None:
        self._orientation_played[0], self._cell_played[0] = orientation, choice
        outcome = self._game.place(  # step has checked that it is legal
            torch.from_numpy(self._orientation_played),
            torch.from_numpy(self._cell_played),
            check=False,
        )
        self._read_game()
        self._placed(float(outcome.reward), bool(outcome.done))

    def _nearest(self, action: int, legal: NDArray[np.intp]) -> int:
        return self.game.floor.nearest(action, legal)

    # --- observations -----------------------------------------------------------------------------

    def _read_game(self) -> None:
        """Read this cycle's numbers from the game."""
        game = self._game
        self._packed = int(game.bins.arrays[COUNT][0])
        self.utilization = int(game.bins.arrays[FILLED][0]) / game.volume
        self._item = game.items.sides.numpy()[0]
        self._masks = game.moves.array[0]
        self._orientation_mask = game.orientation_mask.numpy()[0]

    @property
    def legal_actions(self) -> NDArray[np.bool_]:
        """The legal actions of the acting agent, bool [6] or [W · D]."""
        return self._orientation_mask if self._chosen is None else self._masks[self._chosen]

    def _planes(self, agent: str | None) -> NDArray[np.float32]:
        heightmap = self._game.bins.arrays[HEIGHTMAP][0]
        whose_turn = agent is None or self.pad_actions
        planes = np.empty((4 + whose_turn, *heightmap.shape), np.float32)
        chosen = 0 if agent == ORIENTATION else self._chosen or 0
        fill_planes(heightmap, self._item, ORIENTATIONS[chosen], self._unit, planes)
        if whose_turn:
            planes[4] = self._chosen is not None
        return planes

    # --- rendering --------------------------------------------------------------------------------

    def _title(self) -> str:
        return f"{self._packed} boxes, utilization {self.utilization:.1%}"

    def _text(self) -> str:
        from marl_pack.render.turn import turn_text

        game = self._game
        sides = self._item[list(ORIENTATIONS[self._chosen or 0])].tolist()
        return turn_text(self._title(), sides, game.bins.heightmap.numpy()[0], game.size[2])

    def _picture(self) -> NDArray[np.uint8]:
        from marl_pack.render.turn import turn_picture

        boxes = self._game.bins.boxes[0, : self._packed].numpy()
        masks = self._game.mask[0].numpy()
        return turn_picture(
            self._title(), self._game.size, boxes, self._item.tolist(), masks, self._chosen
        )


def _name_options(function: Any) -> None:
    """Add every option that a function passes on to an environment to its signature."""
    parameters = inspect.signature(raw_env).parameters
    left_out = [*TAKEN, *(name for name in parameters if name not in TAKEN)]
    more = with_options(SelectionSpec, inspect.Signature(), left_out).parameters
    named = [
        parameter.replace(kind=parameter.KEYWORD_ONLY)
        for parameter in (*parameters.values(), *more.values())
    ]
    signature = inspect.signature(function)
    own = [p for p in signature.parameters.values() if p.kind is not p.VAR_KEYWORD]
    function.__signature__ = signature.replace(parameters=[*named, *own])


raw_env.__signature__ = with_options(GameSpec, inspect.signature(raw_env), leave_out=tuple(TAKEN))
_name_options(env)
_name_options(parallel_env)
