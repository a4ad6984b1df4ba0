"""Load agents and policies by name, from a run's folder or from a checkpoint.

A *record* describes one agent. It is the part of a checkpoint that the agent needs to play: the
settings and the weights of its network, or ``{"name": …}`` for a heuristic
(:mod:`marl_pack.agents.learning.checkpoint`).
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from marl_pack.agents.afterstates.critic import AfterstateCritic
from marl_pack.agents.afterstates.lookahead import Lookahead, Memo
from marl_pack.agents.heuristics import (
    make_orientation_agent,
    make_placement_agent,
    make_policy,
)
from marl_pack.agents.keys import GREEDY_VALUE, ORIENTATION_AGENTS, POLICIES
from marl_pack.agents.learned import JointPolicy, LearnedAgent, LearnedSelection
from marl_pack.agents.learning import checkpoint as checkpoints
from marl_pack.agents.learning.form import check_alike
from marl_pack.agents.networks.actor_critic import Critic, make_actor, make_critic
from marl_pack.agents.networks.kinds import JOINT, ORIENTATION, PLACEMENT, SELECTION
from marl_pack.agents.policy import (
    InTurns,
    OrientationAgent,
    PlacementAgent,
    Policy,
)
from marl_pack.agents.search import Planner
from marl_pack.agents.search_settings import SearchSettings
from marl_pack.agents.selection.budget import BudgetSearch
from marl_pack.agents.selection.budget_settings import BudgetSettings
from marl_pack.agents.selection.choosing import lookahead_of, make_selection_agent
from marl_pack.agents.selection.one_box import OneBoxSearch
from marl_pack.agents.selection.policies import (
    GreedyValue,
    SelectAs,
    SelectFirst,
    SelectionAgent,
    first_option,
)
from marl_pack.agents.sources import is_own, own_policy, path_of
from marl_pack.game.spec import SelectionSpec
from marl_pack.geometry import Size
from marl_pack.items import GENERATED, Stream, independent, make_stream


class Loader:
    """Load agents that play together and share the results that are computed once per turn.

    Args:
        device: the device of the games.
        seed: the seed of agents that play at random; with None they use torch's global generator.
        symmetric: whether learned agents average over the symmetries of the bin.
        memo: stores the results that are computed once per turn; a new memo by default.
    """

    def __init__(
        self,
        device: torch.device | str = "cpu",
        seed: int | None = 0,
        symmetric: bool = False,
        memo: Memo | None = None,
    ) -> None:
        self.device, self.seed, self.symmetric = device, seed, symmetric
        self.memo = memo or Memo()
        self._lookaheads: list[tuple[Mapping[str, Tensor] | None, Lookahead]] = []

    # --- by name or path --------------------------------------------------------------------------

    def policy(self, source: str | Path) -> Policy:
        """Return the policy that ``source`` names.

        Args:
            source: one of :data:`marl_pack.agents.keys.POLICIES`, a published model's name
                (:mod:`marl_pack.published`), the path of a run's folder or a checkpoint, or
                ``FILE.py:NAME`` for a function that you wrote.

        Raises:
            ValueError, FileNotFoundError: if ``source`` is none of these.
        """
        if isinstance(source, str) and source in POLICIES:
            return make_policy(source, self.seed, self.device)
        if isinstance(source, str) and is_own(source):
            policy: Policy = own_policy(source)
            return policy
        checkpoint = checkpoints.read(path_of(source, POLICIES), self.device)
        with _with_source(source):
            return self.policy_of(checkpoint)

    def orientation_agent(self, source: str) -> OrientationAgent:
        """Return the orientation agent that ``source`` names.

        A joint agent also chooses cells, which are ignored.

        Raises:
            ValueError, FileNotFoundError: if there is no such agent.
        """
        if source not in ORIENTATION_AGENTS:
            checkpoint = checkpoints.read(path_of(source, ORIENTATION_AGENTS), self.device)
            if JOINT in checkpoint["agents"]:
                with _with_source(source):
                    policy = self.policy_of(checkpoint)
                return lambda game: policy(game)[0]
        with _with_source(source):
            return self.orientation_agent_of(record_of(source, ORIENTATION))

    def placement_agent(self, source: str) -> PlacementAgent:
        """Return the placement agent that ``source`` names.

        Raises:
            ValueError, FileNotFoundError: if there is no such agent.
        """
        with _with_source(source):
            return self.placement_agent_of(record_of(source, PLACEMENT))

    # --- from records and checkpoints -------------------------------------------------------------

    def policy_of(self, checkpoint: Mapping[str, Any]) -> Policy:
        """Return the policy of a checkpoint, including its frozen agents."""
        policy: Policy
        if JOINT in checkpoint["agents"]:
            policy = JointPolicy(self.learned(checkpoints.agent_record(checkpoint, JOINT), JOINT))
        else:
            policy = InTurns(
                self.orientation_agent_of(checkpoints.agent_record(checkpoint, ORIENTATION)),
                self.placement_agent_of(checkpoints.agent_record(checkpoint, PLACEMENT)),
            )
        if SELECTION not in checkpoint["agents"]:
            game = SelectionSpec.of(checkpoint["config"].get("game", {}))
            # Trained with one box and one bin, and a preview or several closings.
            return SelectFirst(first_option, policy) if game.selects else policy
        record = checkpoints.agent_record(checkpoint, SELECTION)
        return SelectFirst(self.selection_agent_of(record), policy)

    def selection_agent_of(self, record: Mapping[str, Any]) -> SelectionAgent:
        """Return the selection agent that a record describes."""
        name = record.get("name")
        if name == GREEDY_VALUE:
            return SelectAs(GreedyValue(self._lookahead(record)))
        if name is not None:
            return make_selection_agent(name, self.seed, self.device)
        return LearnedSelection(load_actor(record, SELECTION, self.device), self._lookahead(record))

    def orientation_agent_of(self, record: Mapping[str, Any]) -> OrientationAgent:
        """Return the orientation agent that a record describes."""
        if "name" in record:
            lookahead = self._lookahead(record)
            return make_orientation_agent(record["name"], self.seed, self.device, lookahead)
        return self.learned(record, ORIENTATION)

    def placement_agent_of(self, record: Mapping[str, Any]) -> PlacementAgent:
        """Return the placement agent that a record describes."""
        if "name" in record:
            lookahead = self._lookahead(record)
            return make_placement_agent(record["name"], self.seed, self.device, lookahead)
        return self.learned(record, PLACEMENT)

    def agent_of(self, record: Mapping[str, Any], name: str) -> Callable[..., Tensor]:
        """Return the agent that a record describes.

        Args:
            record: the record of the agent.
            name: ``selection``, ``orientation`` or ``placement``.
        """
        makers: dict[str, Callable[[Mapping[str, Any]], Callable[..., Tensor]]] = {
            SELECTION: self.selection_agent_of,
            ORIENTATION: self.orientation_agent_of,
            PLACEMENT: self.placement_agent_of,
        }
        return makers[name](record)

    def learned(self, record: Mapping[str, Any], kind: str) -> LearnedAgent:
        """Return the learned agent that a record describes.

        Raises:
            ValueError: if the record has no network, or its weights do not match the network.
        """
        actor = load_actor(record, kind, self.device)
        return LearnedAgent(kind, actor, self._lookahead(record), self.symmetric)

    def _lookahead(self, record: Mapping[str, Any]) -> Lookahead:
        """Return the lookahead of an agent; agents with the same critic of afterstates share it."""
        weights = record.get("afterstate_critic")
        for critic_weights, lookahead in self._lookaheads:
            if critic_weights is weights:
                return lookahead
        critic = load_afterstate_critic(record, self.device)
        lookahead = Lookahead(critic, self.memo, record.get("value_share", 1.0))
        self._lookaheads.append((weights, lookahead))
        return lookahead

    def planner(
        self,
        checkpoint: Mapping[str, Any],
        settings: SearchSettings | BudgetSettings,
        futures: Stream,
    ) -> Planner | OneBoxSearch:
        """Return a policy that searches with the agents of a checkpoint.

        Args:
            checkpoint: the checkpoint of a run.
            settings: how far to search.
            futures: the stream from which future items are drawn.

        Raises:
            ValueError: if an agent is not learned, or the settings have a depth and the critic was
                not trained to estimate filled shares of the bin, or they have a budget and there is
                no critic of afterstates.
        """
        if isinstance(settings, BudgetSettings):
            return OneBoxSearch(self._budget_search(checkpoint, settings, futures))
        first, second = (
            self.learned(checkpoints.agent_record(checkpoint, name), name)
            for name in (ORIENTATION, PLACEMENT)
        )
        critic = None
        if settings.depth is not None:
            alpha = trained_game(checkpoint)["alpha"]
            gamma = checkpoint["config"].get("ppo", {}).get("gamma")
            if (alpha, gamma) != (1, 1):
                raise ValueError(
                    f"plan: a depth needs agents trained with game.alpha = 1 and ppo.gamma = 1, "
                    f"not {alpha} and {gamma}: their critic must estimate shares of the bin"
                )
            critic = load_critic(checkpoint, ORIENTATION, self.device, first.actor)
        return Planner(first, second, critic, settings, futures, self.seed or 0)

    def _budget_search(
        self, checkpoint: Mapping[str, Any], settings: BudgetSettings, futures: Stream
    ) -> BudgetSearch:
        """Return a search that uses the critic of afterstates of a checkpoint."""
        if self.symmetric:
            raise ValueError("symmetric: a search with a budget does not ask the agents")
        lookahead = lookahead_of(self.policy_of(checkpoint))
        if lookahead is None:
            raise ValueError(
                "plan: a budget or draws need agents with a critic of afterstates, such as rs"
            )
        return BudgetSearch(lookahead, settings, futures, seed=self.seed or 0)


def imagined_stream(
    checkpoint: Mapping[str, Any], size: Size | None = None, played: Stream | None = None
) -> Stream:
    """Return the stream from which a search draws future items, like the items in training.

    Args:
        checkpoint: the checkpoint of the agents.
        size: W, D and H of the bin; the size in training by default.
        played: the stream of the games; it is used if the agents were trained on a file.

    Raises:
        ValueError: if there is no such stream.
    """
    game = trained_game(checkpoint)
    stream = played
    if game["items"] in GENERATED:
        try:
            stream = make_stream(game["items"], size or game["bin"], tuple(game["sides"]))
        except ValueError as error:
            raise ValueError(f"items of the agents' training: {error}") from None
    if stream is None:
        raise ValueError(
            f"plan: needs agents trained on one of {', '.join(GENERATED)}, not {game['items']}"
        )
    return independent(stream)


def load_actor(record: Mapping[str, Any], kind: str, device: torch.device | str) -> Any:
    """Return the network of a learned agent.

    Args:
        record: the agent's record.
        kind: name in :data:`marl_pack.agents.networks.kinds.AGENT_NAMES`.
        device: the device of the games.

    Raises:
        ValueError: if the record has no network, or its weights do not match the network.
    """
    if "network" not in record:
        name = record.get("name")
        raise ValueError(f"the {kind} agent is the heuristic {name}: it has no network")
    checkpoints.check_weights(record, kind)
    with torch.random.fork_rng(devices=[]):  # do not change the run's random numbers
        actor = make_actor(kind, record["network"], device)
    actor.load_state_dict(record["actor_state_dict"])
    return actor.eval()


def load_critic(
    checkpoint: Mapping[str, Any], kind: str, device: torch.device | str, actor: Any
) -> Critic:
    """Return the critic of one agent of a run.

    Args:
        checkpoint: the checkpoint of the run.
        kind, device: as for :func:`load_actor`.
        actor: the agent's actor, whose trunk the critic shares.

    Raises:
        ValueError: if the agent has no critic, or its weights do not match its network.
    """
    agent = checkpoints.agent_of(checkpoint, kind)
    if "critic_state_dict" not in agent:
        raise ValueError(f"the {kind} agent has no critic: critic_state_dict is missing")
    checkpoints.check_weights(agent, kind)
    with torch.random.fork_rng(devices=[]):
        critic = make_critic(kind, agent["network"], device, actor)
    critic.load_state_dict(agent["critic_state_dict"])
    loaded: Critic = critic.eval()
    return loaded


def load_afterstate_critic(
    record: Mapping[str, Any], device: torch.device | str
) -> AfterstateCritic | None:
    """Return the critic of afterstates in a record or a checkpoint, or None if it has none.

    Raises:
        ValueError: if the weights do not match the network.
    """
    weights = record.get("afterstate_critic")
    if weights is None:
        return None
    with torch.random.fork_rng(devices=[]):
        critic = AfterstateCritic().to(device)
    try:
        check_alike(weights, critic.state_dict(), "afterstate_critic")
    except ValueError as error:
        raise ValueError(f"the critic of afterstates does not match: {error}") from None
    critic.load_state_dict(weights)
    return critic.eval()


def record_of(source: str, name: str) -> dict[str, Any]:
    """Return the record of a heuristic, or of an agent in a checkpoint.

    Args:
        source: a heuristic's or a published model's name, or the path of a run's folder or a
            checkpoint.
        name: ``selection``, ``orientation`` or ``placement``. A model without a selection agent
            takes the option whose best placement gains most by its critic of afterstates.

    Raises:
        ValueError, FileNotFoundError: if ``source`` is none of these.
    """
    if source in checkpoints.HEURISTICS[name]:
        return {"name": source}
    checkpoint = checkpoints.read(path_of(source, checkpoints.HEURISTICS[name]))
    with _with_source(source):
        if name == SELECTION and name not in checkpoint["agents"]:
            return checkpoints.critic_record(checkpoint, name) | {"name": GREEDY_VALUE}
        return checkpoints.agent_record(checkpoint, name)


def trained_game(checkpoint: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of the game that a checkpoint's agents were trained on.

    They are the options of :class:`marl_pack.game.spec.SelectionSpec`, ``items`` and ``sides``.

    Raises:
        ValueError: if a value is impossible, or a setting is missing that every version of
            marl_pack writes.
    """
    game = checkpoint["config"].get("game", {})
    for key in ("bin", "rule", "items", "sides"):
        if key not in game:
            raise ValueError(f"config.game.{key} is missing")
    return SelectionSpec.of(game).to_dict() | {key: game[key] for key in ("items", "sides")}


def trained_on(checkpoint: Mapping[str, Any]) -> str:
    """Describe the game that a checkpoint's agents were trained on, and for how many items.

    Raises:
        ValueError: if its settings do not describe a game.
    """
    game, seed = trained_game(checkpoint), checkpoint["config"].get("seed", "unknown")
    is_file = "." in game["items"]  # names of generated streams have no dot
    sides = "" if is_file else f" {game['sides'][0]}-{game['sides'][1]}"
    spec, items = SelectionSpec.of(game), checkpoint["items"]
    return f"{game['items']}{sides}, {spec}, {items:,} items, seed {seed}"


@contextlib.contextmanager
def _with_source(source: str | Path) -> Iterator[None]:
    """Put the name of a source before the message of an error, unless the message has it."""
    try:
        yield
    except ValueError as error:
        named = str(error).startswith(f"{source}") or repr(str(source)) in str(error)
        raise ValueError(str(error) if named else f"{source}: {error}") from None
