"""Old names and what they are called now, for old checkpoints and for messages."""

from __future__ import annotations

from collections.abc import Mapping

PLANES = {
    "rest": "resting_height",
    "room": "feasible_cells",
    "fits": "feasible_probability",
    "worth": "afterstate_value",
    "solid": "grounded",
}
"""Input planes of the networks (:data:`marl_pack.agents.networks.planes.PLANES`)."""

POLICIES = {"most_room": "max_feasible"}
"""Names of heuristics (:data:`marl_pack.agents.heuristics.POLICIES`)."""

AGENT_KEYS = {"imitate": "teacher", "imitate_iterations": "teacher_iterations"}
"""Settings of an agent (:class:`marl_pack.config.Agent`)."""

OPTIONS = {"size": "bin", "rule_parameters": "margin or thresholds"}
"""Keyword arguments that games took (:class:`marl_pack.game.spec.GameSpec`)."""


def refuse_old(name: str, names: Mapping[str, str], kind: str) -> None:
    """Raise ValueError with the new name if ``name`` is an old one.

    Args:
        name: the name to check.
        names: old name → new name.
        kind: the kind of thing that it names, for the message.
    """
    if name in names:
        raise ValueError(f"{kind} {name!r} is now called {names[name]!r}")
