"""The packing game in millimetres as a two-agent PettingZoo environment.

``env(world="mm", items="goods.csv", bin_mm=(1200, 800, 1500))`` returns it. It is the game of
:mod:`marl_pack.env_aec` on true sizes. The two agents, their turns, the shared reward and the end
of an episode are the same. The placement agent chooses among *listed moves*
(:mod:`marl_pack.exact.moves`), not among cells.

| | |
|---|---|
| Agents | `["orientation_0", "placement_0"]`, in this order each cycle |
| Action spaces | `Discrete(6)` and `Discrete(K)`, K = `max_moves` |
| Observation spaces | `Dict` of `observation` and `action_mask` |
| … `observation` | `Box(0, 1, (K, F), float32)`, a row for each move |
| … `action_mask` | `Box(0, 1, (n,), int8)`, n = 6 and K |
| State space | `Box(0, 1, (K, F), float32)` |
| Render modes | `rgb_array`, `ansi` |

## Moves

The visible box has a list of moves: orientation and low corner x, y, z. They are the candidates at
box edges that fit and stand under the rule, in the order of z, x, y, orientation. The orientation
agent sees the first K of them; it chooses one of the orientations that have a move. The placement
agent sees the first K moves in this orientation, and chooses one by its number. Orientations that
make the same box are listed once.

If there are more than K moves, the others cannot be chosen. `info["moves_left_out"]` is their
number for the agent whose turn it is.

Each row has the numbers :data:`COLUMNS`, all from 0 to 1: a 1 for a move (rows beyond the last move
are 0), the low corner and the sides as shares of the bin, then the features of
:mod:`marl_pack.exact.features`.
"""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from marl_pack.checks import whole_number
from marl_pack.env_turns import AGENTS, ORIENTATION, PLACEMENT, TurnEnv, one_of
from marl_pack.exact.bins import placements
from marl_pack.exact.features import FEATURES
from marl_pack.exact.goods import AXES, Goods
from marl_pack.exact.packing import MOST_SKIPPED, ExactPacking
from marl_pack.exact.spec import ExactSpec
from marl_pack.exact.streams import GoodsStream, make_goods_stream
from marl_pack.geometry import ORIENTATIONS
from marl_pack.option_record import document, with_options
from marl_pack.plan import Plan

COLUMNS = ("present", "x", "y", "z", "w", "d", "h", *FEATURES)
"""What the numbers of a row of an observation are."""
RENDER_MODES = ["rgb_array", "ansi"]
MOST_MOVES = 1 << 16
"""Largest number of moves that an observation may list."""


class OptionsMm(TypedDict, total=False):
    """The keyword arguments of :class:`raw_env`; its signature has their defaults."""

    items: str | Path | ArrayLike | Goods | Mapping[str, Any] | GoodsStream
    present: ArrayLike | Plan
    order: str
    length: int | None
    max_moves: int
    max_cycles: int | None
    render_mode: str | None
    mask_in: str
    illegal: str
    bin_mm: Sequence[float]
    unit_mm: float
    rule: str
    margin_mm: float
    margin_share: float
    margin_on_floor: bool
    level_tolerance_mm: float
    clearance_mm: float
    max_overhang: float
    thresholds: Any
    orientations: Sequence[int]
    max_weight_kg: float | None
    alpha: float
    beta: float
    max_boxes: int


@document(ExactSpec, " " * 8)
class raw_env(TurnEnv):  # noqa: N801  # PettingZoo's name for it
    """The environment in millimetres without wrappers: one bin and two agents.

    The module's docstring describes spaces and moves.

    Args:
        items: a CSV or JSON file, rows of sides in millimetres, a mapping with attributes, goods or
            a stream (:func:`marl_pack.exact.streams.make_goods_stream`).
        present: boxes that are in the bin at first: rows x, y, z, w, d, h in millimetres, or a
            plan.
        order: ``"file"`` or ``"draw"``, the order in which boxes come.
        length: number of boxes in an episode; needed with ``"draw"``.
        max_moves: K, number of moves that an observation lists.
        max_cycles: boxes after which an episode is truncated; None for no limit.
        render_mode: ``"rgb_array"`` (a picture) or ``"ansi"`` (text).
        mask_in: ``"observation"``; or ``"info"``: then the observation is only the list of moves,
            and each agent's info has its ``action_mask``.
        illegal: ``"terminate"``: an illegal action ends the game (in ``env``; ``raw_env`` raises
            ``ValueError``); ``"repair"``: the legal action with the nearest number is played, and
            the agent's info says so.
        **options: the options of the game:
        {options}

    Attributes:
        utilization: share of the bin filled, in [0, 1].
        plan: the boxes placed so far (:class:`marl_pack.plan.Plan`).

    Raises:
        ValueError, TypeError: if an argument is impossible; says what would be right.
    """

    metadata = {  # noqa: RUF012  # PettingZoo reads it from the class
        "name": "marl_pack_mm_v0",
        "render_modes": RENDER_MODES,
        "render_fps": 2,
        "is_parallelizable": True,
    }

    def __init__(
        self,
        items: Any,
        *,
        present: Any = (),
        order: str = "file",
        length: int | None = None,
        max_moves: int = 256,
        max_cycles: int | None = None,
        render_mode: str | None = None,
        mask_in: str = "observation",
        illegal: str = "terminate",
        **options: Any,
    ) -> None:
        super().__init__(AGENTS, max_cycles, mask_in, illegal)
        if render_mode is not None:
            one_of("render_mode", render_mode, RENDER_MODES)
        self.render_mode = render_mode
        self.max_moves = whole_number(max_moves, "max_moves", 1, MOST_MOVES)
        self._spec = ExactSpec().with_options(options)
        self._stream = make_goods_stream(items, self._spec, order=order, length=length)
        self._present = present
        self._game = self._new_game(self._stream)
        self._choices = {ORIENTATION: len(ORIENTATIONS), PLACEMENT: self.max_moves}
        table = spaces.Box(0.0, 1.0, (self.max_moves, len(COLUMNS)), np.float32)
        self.action_spaces = {agent: spaces.Discrete(n) for agent, n in self._choices.items()}
        self.observation_spaces = {
            agent: table
            if mask_in == "info"
            else spaces.Dict(  # pairs, since Gymnasium sorts the keys of a plain dict
                [("observation", table), ("action_mask", spaces.Box(0, 1, (n,), np.int8))]
            )
            for agent, n in self._choices.items()
        }
        self.state_space = table
        self._read_game()

    @property
    def game(self) -> ExactPacking:
        """The game behind this view, for policies; only ``reset`` and ``step`` may change it."""
        return self._game

    @property
    def plan(self) -> Plan:
        """The boxes placed so far in this episode, in their order."""
        return self._game.plan(0)

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> None:
        """Empty the bin and begin an episode.

        Args:
            seed: seed from which the stream begins again. Without a seed the stream continues with
                its next episode (from a random seed if there never was one).
            options: ``{"items": …}`` plays these items once instead of the stream's.

        Raises:
            ValueError: for an impossible seed or impossible items, or if no episode has a legal
                first box; then nothing has changed.
        """
        seed, episode = self._next_episode(seed, options)
        if options and options.get("items") is not None:
            try:
                stream = make_goods_stream(options["items"], self._spec)
            except ValueError as error:
                raise ValueError(f'options["items"]: {error}') from None
            game = self._new_game(stream)
            if not game.alive.any():
                raise ValueError('options["items"]: the first box may be placed nowhere in the bin')
        else:
            stream = self._stream.seeded(seed)
            game = self._new_game(stream)
            for _ in range(MOST_SKIPPED):  # an episode may have no legal first box: skip it
                episode += 1
                game.reset(episode)
                if game.alive.any():
                    break
            else:
                raise ValueError(f"{MOST_SKIPPED} episodes in a row have no legal first box")
        self._seed, self._episode, self._game = seed, episode, game
        self._begin()
        self._read_game()
        self.infos = {agent: self._info(agent) for agent in AGENTS}

    def _new_game(self, stream: GoodsStream) -> ExactPacking:
        return ExactPacking(
            1, stream, spec=self._spec, present=self._present, auto_reset=False
        )  # fmt: skip

    def _choose(self, orientation: int) -> None:
        self._chosen = orientation

    def _place(self, orientation: int, choice: int) -> None:
        moves = self._listed[self._orientations == orientation]
        outcome = self._game.place(moves[[choice]], check=False)  # step has checked it
        self._read_game()
        self._placed(float(outcome.reward[0]), bool(outcome.done[0]))

    def _read_game(self) -> None:
        """Read this cycle's numbers from the game."""
        game = self._game
        self._packed = int(game.bins.state.count[0])
        self.utilization = float(game.bins.utilization[0])
        self._listed = game.moves.of(0)
        self._orientations = self._listed & 7

    def _visible_moves(self, oriented: bool) -> NDArray[np.int64]:
        """Return the moves of the visible box, or those in the chosen orientation, int64 [M]."""
        if oriented and self._chosen is not None:
            return self._listed[self._orientations == self._chosen]
        return self._listed

    @property
    def legal_actions(self) -> NDArray[np.bool_]:
        """The legal actions of the acting agent, bool [6] or [K]."""
        if self._chosen is None:
            return np.isin(np.arange(len(ORIENTATIONS)), self._orientations)
        return np.arange(self.max_moves) < len(self._visible_moves(True))

    def _info(self, agent: str) -> dict[str, Any]:
        moves = self._visible_moves(agent == PLACEMENT) if agent == self._acting else ()
        info: dict[str, Any] = {
            "utilization": self.utilization,
            "packed": self._packed,
            "moves_left_out": max(0, len(moves) - self.max_moves),
        }
        if self.mask_in == "info":
            info["action_mask"] = self.action_mask(agent)
        return info

    def _table(self, oriented: bool) -> NDArray[np.float32]:
        """Return the rows of moves, float32 [K, F]."""
        table = np.zeros((self.max_moves, len(COLUMNS)), np.float32)
        moves = self._visible_moves(oriented)[: self.max_moves]
        count = len(moves)
        if count:
            bins, item = self._game.bins, self._game.items.sides[0]
            where = placements(moves)
            size = bins.size.astype(np.float64)
            table[:count, 0] = 1.0
            table[:count, 1:4] = where[:, 1:] / size
            table[:count, 4:7] = item[AXES[where[:, 0]]] / size
            table[:count, 7:] = bins.features(0, item, moves).clip(0.0, 1.0)
        return table

    def observe(self, agent: str) -> Any:
        """Return the agent's observation; this works in both agents' turns and after the end."""
        table = self._table(agent == PLACEMENT)
        if self.mask_in == "info":
            return table
        return {"observation": table, "action_mask": self.action_mask(agent)}

    def state(self) -> NDArray[np.float32]:
        """Return the rows of the moves that the acting agent sees, float32 [K, F]."""
        return self._table(oriented=True)

    def render(self) -> NDArray[np.uint8] | str | None:
        """Show the bin and the visible box.

        Returns:
            uint8 [rows, columns, 3] for ``"rgb_array"``, text for ``"ansi"``.
        """
        if self.render_mode is None:
            warnings.warn(
                f"render() without a render_mode: make the environment with one of {RENDER_MODES}",
                stacklevel=2,
            )
            return None
        title = f"{self._packed} boxes, utilization {self.utilization:.1%}"
        sides = self._game.items.sides[0] if self._game.visible[0] >= 0 else np.zeros(3, np.int64)
        if self._chosen is not None:
            sides = sides[AXES[self._chosen]]
        if self.render_mode == "ansi":
            lengths = " x ".join(f"{side * self._spec.unit_mm:g}" for side in sides.tolist())
            return f"{title}\nbox {lengths} mm\n"
        from marl_pack.render.picture import draw  # matplotlib is slow to import

        following = tuple(sides.tolist()) if sides.any() else None
        size = tuple(self._game.bins.size.tolist())
        return draw(size, self._game.bins.boxes(0), following, title=title)

    def close(self) -> None:
        """Do nothing: there is no window."""


raw_env.__signature__ = with_options(ExactSpec, inspect.signature(raw_env))
