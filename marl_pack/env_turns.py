"""What the environments share: turns, action masks, and PettingZoo's wrappers.

:mod:`marl_pack.env_aec` is the environment on whole cells, :mod:`marl_pack.env_selection` the one
with a buffer, a preview or several bins, :mod:`marl_pack.env_mm` the one in millimetres. All derive
from :class:`TurnEnv`.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from pettingzoo import AECEnv
from pettingzoo.utils import wrappers
from pettingzoo.utils.conversions import (
    aec_to_parallel_wrapper,
    turn_based_aec_to_parallel_wrapper,
)

from marl_pack.checks import LARGEST_SEED, real_number, shown, truth_value, whole_number
from marl_pack.game.state import Copied

SELECTION, ORIENTATION, PLACEMENT = "selection_0", "orientation_0", "placement_0"
AGENTS = [ORIENTATION, PLACEMENT]
"""The agents of the paper's game, in the order of their turns."""


class TurnEnv(Copied, AECEnv):
    """A view of one packing game with agents that take turns.

    An environment sets the spaces and the game, and defines :attr:`legal_actions`, ``_choose``,
    ``_place`` and ``observe``.

    Args:
        agents: names of the agents, in the order of their turns.
        max_cycles: items after which an episode is truncated; None for no limit.
        mask_in: ``"observation"`` or ``"info"``, where the action masks are.
        illegal: ``"terminate"`` or ``"repair"``, what happens on an illegal action.

    Attributes:
        utilization: share of the bin filled, in [0, 1].
    """

    utilization: float
    action_spaces: dict[str, spaces.Space[Any]]
    observation_spaces: dict[str, spaces.Space[Any]]

    def __init__(
        self, agents: Sequence[str], max_cycles: int | None, mask_in: str, illegal: str
    ) -> None:
        super().__init__()
        one_of("mask_in", mask_in, ("observation", "info"))
        one_of("illegal", illegal, ("terminate", "repair"))
        if max_cycles is not None:
            max_cycles = whole_number(max_cycles, "max_cycles (None for no limit)", 1)
        self.max_cycles, self.mask_in, self.illegal = max_cycles, mask_in, illegal
        self.possible_agents = list(agents)
        self.agents: list[str] = []
        self._chosen: int | None = None
        self._packed = 0
        self._seed: int | None = None  # seed of the stream; None before the first episode
        self._episode = -1  # number of the stream's last episode that was begun
        self._choices: dict[str, int] = {}

    @property
    def chosen(self) -> int | None:
        """The orientation that was chosen for the item; None in the orientation agent's turn."""
        return self._chosen

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        """Return the agent's observation space, the same object at each call."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Space[Any]:
        """Return the agent's action space, the same object at each call."""
        return self.action_spaces[agent]

    # --- turns ------------------------------------------------------------------------------------

    def _next_episode(self, seed: int | None, options: Mapping[str, Any] | None) -> tuple[int, int]:
        """Check the arguments of ``reset``; return the stream's seed and its last episode.

        Raises:
            ValueError: for an impossible seed or options that are no mapping.
        """
        if not isinstance(options, Mapping | None):
            raise ValueError(f"options = {shown(options)}: needs a dict")
        unknown = set(options or {}) - {"items"}
        if unknown:
            # This is not an error, since PettingZoo's API test sends its own option.
            warnings.warn(f"ignoring reset options {sorted(unknown)}: only 'items'", stacklevel=2)
        episode = self._episode if seed is None else -1
        if seed is not None:
            seed = whole_number(seed, "seed", 0, LARGEST_SEED)
        elif self._seed is None:
            seed = int(np.random.SeedSequence().generate_state(1)[0])
        else:
            seed = self._seed
        return seed, episode

    def _begin(self) -> None:
        """Begin an episode: all agents play, and nothing has been placed."""
        agents = self.possible_agents
        self.agents = list(agents)
        self.agent_selection = agents[0]
        self.rewards = dict.fromkeys(agents, 0.0)
        self._cumulative_rewards = dict.fromkeys(agents, 0.0)
        self.terminations = dict.fromkeys(agents, False)
        self.truncations = dict.fromkeys(agents, False)
        self._cycle = 0
        self._chosen = None

    def step(self, action: int | None) -> None:
        """Play the selected agent's action; None once that agent has ended.

        Raises:
            ValueError: for an action that is not a whole number in its action space, and for an
                illegal action, unless ``illegal="repair"``.
        """
        _some_left(self.agents)
        agent = self.agent_selection
        if self.terminations[agent] or self.truncations[agent]:
            self._was_dead_step(action)
            return
        choice, repaired = self._legal(agent, action)
        self._cumulative_rewards[agent] = 0.0
        self._clear_rewards()
        self._play(choice)
        self.agent_selection = self._acting
        self.infos = {name: self._info(name) for name in self.agents}
        if repaired:
            self.infos[agent]["repaired"] = True
        if self.render_mode == "human":
            self.render()

    def _play(self, choice: int) -> None:
        """Play a legal action of the acting agent."""
        if self._chosen is not None:
            self._place(self._chosen, choice)
        else:
            self._choose(choice)

    def _choose(self, orientation: int) -> None:
        """Play a legal action of the orientation agent."""
        raise NotImplementedError

    def _place(self, orientation: int, choice: int) -> None:
        """Play a legal action of the placement agent, and call :meth:`_placed`."""
        raise NotImplementedError

    def _placed(self, reward: float, ended: bool) -> None:
        """End a cycle: give all agents the reward; end or truncate the episode."""
        self._cycle += 1
        self._chosen = None
        out_of_time = self.max_cycles is not None and self._cycle >= self.max_cycles
        self.rewards = dict.fromkeys(self.agents, reward)
        self.terminations = dict.fromkeys(self.agents, ended)
        self.truncations = dict.fromkeys(self.agents, out_of_time and not ended)
        self._accumulate_rewards()

    def last(self, observe: bool = True) -> Any:
        """Return observation, reward, termination, truncation and info of the acting agent.

        Raises:
            ValueError: once no agent is left.
        """
        _some_left(self.agents)
        return super().last(observe)

    # --- actions ----------------------------------------------------------------------------------

    def check_action(self, agent: str, action: Any) -> int:
        """Return an agent's action as an int.

        Raises:
            ValueError: unless it is a whole number in the agent's action space.
        """
        last = self._choices[agent] - 1
        if type(action) is int and 0 <= action <= last:  # the usual case
            return action
        if type(action) in (np.ndarray, torch.Tensor) and action.ndim == 0:
            action = action.item()
        return whole_number(action, f"{agent}: action", 0, last)

    def _legal(self, agent: str, action: Any) -> tuple[int, bool]:
        """Return the action to play, and whether it replaces an illegal action."""
        action = self.check_action(agent, action)
        if self._is_legal(action):
            return action, False
        legal = np.flatnonzero(self.action_mask(agent))
        if self.illegal != "repair":
            raise ValueError(
                f"{agent}: action {action} is not legal; {len(legal)} are, see its action_mask"
            )
        if self._chosen is None:
            return int(legal[np.abs(legal - action).argmin()]), True
        return self._nearest(action, legal), True

    def _nearest(self, action: int, legal: NDArray[np.intp]) -> int:
        """Return the legal action of the placement agent that is nearest to an illegal one."""
        return int(legal[np.abs(legal - action).argmin()])

    @property
    def legal_actions(self) -> NDArray[np.bool_]:
        """The legal actions of the acting agent, bool [n]."""
        raise NotImplementedError

    def can_play(self, action: int) -> bool:
        """Return whether an action in the acting agent's space is legal, and the agent goes on."""
        agent = self.agent_selection
        ended = self.terminations[agent] or self.truncations[agent]
        return not ended and self._is_legal(action)

    def _is_legal(self, action: int) -> bool:
        legal = self.legal_actions
        return action < legal.size and bool(legal[action])

    @property
    def _acting(self) -> str:
        """The agent whose turn it is: the placement agent once an orientation is chosen."""
        return AGENTS[self._chosen is not None]

    def action_mask(self, agent: str) -> NDArray[np.int8]:
        """Return the agent's mask of legal actions, all 0 if it is not the agent's turn."""
        mask = np.zeros(self._choices[agent], np.int8)
        if agent == self._acting:
            legal = self.legal_actions
            mask[: legal.size] = legal
        return mask

    def _info(self, agent: str) -> dict[str, Any]:
        info: dict[str, Any] = {
            "utilization": self.utilization,
            "packed": self._packed,
        }
        if self.mask_in == "info":
            info["action_mask"] = self.action_mask(agent)
        return info


def _of_the_turn(name: str) -> property:
    """Return a property that reads an attribute of the unwrapped environment.

    Before the first ``reset`` it raises PettingZoo's AttributeError.
    """

    def read(self: OrderEnforcing) -> Any:
        if not self._has_reset:
            raise AttributeError(f"{name} cannot be accessed before reset")
        return getattr(self._raw, name)

    return property(read)


class OrderEnforcing(Copied, wrappers.OrderEnforcingWrapper):
    """PettingZoo's outermost wrapper: it refuses calls in a wrong order, and wrong actions.

    A legal action goes straight to the environment, since the wrappers in between would only check
    it again.
    """

    _has_reset: bool
    _has_updated: bool

    agents = _of_the_turn("agents")
    agent_selection = _of_the_turn("agent_selection")
    rewards = _of_the_turn("rewards")
    terminations = _of_the_turn("terminations")
    truncations = _of_the_turn("truncations")
    infos = _of_the_turn("infos")

    def __init__(self, env: AECEnv) -> None:
        super().__init__(env)
        self._raw: TurnEnv = env.unwrapped  # the wrappers' own look-ups take microseconds

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> None:
        """Begin an episode; if the arguments are refused, nothing changes."""
        before = self._has_reset, self._has_updated
        try:
            super().reset(seed=seed, options=options)
        except ValueError:
            self._has_reset, self._has_updated = before
            raise

    def step(self, action: int | None) -> None:
        """Play the selected agent's action; None once that agent has ended.

        Raises:
            ValueError: for an action that is not a whole number in its action space.
        """
        raw = self._raw
        if self._has_reset and raw.agents:
            agent = raw.agent_selection
            if action is not None or not (raw.terminations[agent] or raw.truncations[agent]):
                action = raw.check_action(agent, action)
                if raw.can_play(action):
                    self._has_updated = True
                    raw.step(action)
                    return
                self.env.observe(agent)  # the wrapper for illegal actions compares with the mask
        super().step(action)

    def observe(self, agent: str) -> Any:
        """Return the agent's observation."""
        return self._raw.observe(agent) if self._has_reset else super().observe(agent)

    def last(self, observe: bool = True) -> Any:
        """Return the same as PettingZoo's ``last``; raise ValueError once no agent is left."""
        return self._raw.last(observe) if self._has_reset else super().last(observe)

    def __str__(self) -> str:
        return str(self.env)


class AtOnce(Copied, aec_to_parallel_wrapper):
    """PettingZoo's parallel view with one item in each step; a refused step changes nothing."""

    def step(self, actions: dict[str, Any]) -> Any:
        """Play one action of each agent."""
        _check_actions(self.unwrapped, self.unwrapped.agents, actions)
        return super().step(actions)


class Turns(Copied, turn_based_aec_to_parallel_wrapper):
    """PettingZoo's parallel view with one turn in each step; every info says whose turn it is."""

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Begin an episode; name the acting agent in every info."""
        return self._name_active(*super().reset(seed=seed, options=options))

    def step(self, actions: dict[str, Any]) -> Any:
        """Play the acting agent's action; name the next one in every info."""
        raw = self.unwrapped
        _check_actions(raw, [raw.agent_selection] if raw.agents else [], actions)
        return self._name_active(*super().step(actions))

    def _name_active(self, *returned: Any) -> Any:
        for info in returned[-1].values():
            info["active_agent"] = self.aec_env.agent_selection
        return returned


def _some_left(agents: Sequence[str]) -> None:
    """Raise ValueError if no agent is left to act."""
    if not agents:
        raise ValueError("no agent is left to act: begin an episode with reset()")


def _check_actions(env: TurnEnv, agents: Sequence[str], actions: Any) -> None:
    """Raise ValueError unless the actions of ``agents`` are in a mapping, and in their spaces."""
    if not hasattr(env, "agent_selection"):
        raise ValueError("no episode has begun: begin one with reset()")
    for agent in agents:
        if not isinstance(actions, Mapping) or agent not in actions:
            raise ValueError(f"actions: needs a dict with the action of {agent}")
        env.check_action(agent, actions[agent])


def one_of(name: str, value: str, valid: Sequence[str]) -> None:
    """Raise ValueError unless a value is one of the valid ones."""
    if value not in valid:
        raise ValueError(f"{name} = {value!r}: one of {', '.join(map(repr, valid))}")


def wrap(environment: TurnEnv, illegal_reward: float) -> AECEnv:
    """Return an environment in PettingZoo's usual wrappers.

    Args:
        environment: the environment without wrappers.
        illegal_reward: reward of the agent that ends the game by an illegal action.
    """
    illegal_reward = real_number(illegal_reward, "illegal_reward")
    wrapped: AECEnv = environment
    if environment.illegal == "terminate":
        wrapped = wrappers.TerminateIllegalWrapper(wrapped, illegal_reward=illegal_reward)
    return OrderEnforcing(wrappers.AssertOutOfBoundsWrapper(wrapped))


def in_parallel(environment: AECEnv, simultaneous: bool) -> Any:
    """Return a wrapped environment in PettingZoo's parallel API.

    Args:
        environment: the result of :func:`wrap`.
        simultaneous: whether one step is one item, not one turn.

    Raises:
        ValueError: if ``simultaneous`` is true without ``illegal="repair"``.
    """
    repairs = environment.unwrapped.illegal == "repair"
    if truth_value(simultaneous, "simultaneous") and not repairs:
        raise ValueError("simultaneous = True needs illegal = 'repair': no mask can be exact there")
    return (AtOnce if simultaneous else Turns)(environment)
