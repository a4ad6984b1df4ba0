"""The kinds of agents (:data:`AGENT_KINDS`), and what each observes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from torch import Tensor, nn

from marl_pack.agents.afterstates.lookahead import Lookahead
from marl_pack.agents.networks.heads import ScoreMap, pooled_head
from marl_pack.agents.networks.planes import PLANES
from marl_pack.agents.networks.shape import Network
from marl_pack.agents.networks.sight import Sight
from marl_pack.game.moves import Floor
from marl_pack.game.packing import Packing
from marl_pack.geometry import ORIENTATIONS

Choice = tuple[Tensor, ...]
"""The choices so far in a turn of the game: (), (orientation,) or (orientation, cell), int64
[G] each."""


@dataclass(frozen=True)
class AgentKind:
    """A description of how one kind of agent observes and acts.

    Args:
        name: the agent's name in settings, checkpoints and logged scalars.
        orientations: number A of orientations that it judges: 6, or 1 (the chosen orientation).
        acts_on_cells: true if its actions are cells (in A orientations: ``o · W · D + cell``),
            false if they are orientations.
        mask: returns its legal actions in a turn, bool [G, K].
        head: builds the network's head: features → logits [G, K].
        extend: adds its actions int64 [G] to the earlier choices of the turn.
    """

    name: str
    orientations: int
    acts_on_cells: bool
    mask: Callable[[Sight], Tensor]
    head: Callable[[Network], nn.Module]
    extend: Callable[[Choice, Tensor, Floor], Choice]


SIX = len(ORIENTATIONS)

AGENT_KINDS: dict[str, AgentKind] = {
    kind.name: kind
    for kind in (
        # The orientation agent π_o sees the bin and the item as it comes (paper, sec. III-D).
        AgentKind(
            "orientation", SIX, False,
            mask=lambda sight: sight.game.orientation_mask,
            head=lambda network: pooled_head(network, SIX, SIX, 0.01),
            extend=lambda before, action, floor: (*before, action),
        ),
        # The placement agent π_p sees the bin and the oriented item; its score map has the size of
        # the heightmap (paper, sec. III-D).
        AgentKind(
            "placement", 1, True,
            mask=lambda sight: sight.mask.flatten(1),
            head=lambda network: ScoreMap(network, 1),
            extend=lambda before, action, floor: (*before, action),
        ),
        # One agent in place of the two, for comparison: it chooses orientation and cell at once.
        AgentKind(
            "joint", SIX, True,
            mask=lambda sight: sight.mask.flatten(1),
            head=lambda network: ScoreMap(network, SIX),
            extend=lambda before, action, floor: floor.split(action),
        ),
    )
}  # fmt: skip
"""Every kind of agent by its name."""

ORIENTATION, PLACEMENT, JOINT = AGENT_KINDS
TWO_AGENTS = (ORIENTATION, PLACEMENT)
"""The two agents that take turns within a step, in order."""
SELECTION = "selection"
"""The agent that selects a box and a bin before them (:mod:`.selection`)."""
AGENT_NAMES = (SELECTION, *AGENT_KINDS)
"""The names of all agents."""


def observe(
    kind: str,
    game: Packing,
    planes: Sequence[str],
    lookahead: Lookahead,
    orientation: Tensor | None = None,
) -> dict[str, Tensor]:
    """Return what an agent observes of G games, in training, play and export alike.

    Args:
        kind: name in :data:`AGENT_KINDS`.
        game: the games.
        planes: extra planes, names in :data:`marl_pack.agents.networks.planes.PLANES`.
        lookahead: computes afterstates and their values.
        orientation: int64 [G], the chosen orientations, for the placement agent.

    Returns:
        ``heightmap`` int16 [G, W, D] (a copy), ``item`` int16 [G, 3] (sides w, d, h; along x, y, z
        once an orientation is chosen), ``height`` int16 [G, 1] (H), ``mask`` bool [G, K], the legal
        actions, and the tensors of the planes.
    """
    sight = Sight(game, lookahead, planes, orientation)
    observation = {
        "heightmap": lookahead.heightmap(game),
        "item": sight.item,
        "height": game.bin_height,
        "mask": AGENT_KINDS[kind].mask(sight),
    }
    for name in planes:
        observation |= PLANES[name].observe(sight)
    return observation
