"""Tables of old names and removed settings, and the search for the nearest valid name."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from typing import NamedTuple

PLANES = {
    "rest": "resting_height",
    "room": "feasible_cells",
    "fits": "feasible_probability",
    "worth": "afterstate_value",
    "solid": "grounded",
}
"""Old → new name of input planes (:data:`marl_pack.agents.networks.planes.PLANES`)."""

POLICIES = {"most_room": "max_feasible"}
"""Old → new name of heuristics (:data:`marl_pack.agents.keys.POLICIES`)."""

AGENT_KEYS = {"imitate": "teacher", "imitate_iterations": "teacher_iterations"}
"""Old → new name of settings of an agent (:class:`marl_pack.config.Agent`)."""

OPTIONS = {"size": "bin", "rule_parameters": "margin or thresholds"}
"""Old → new name of keyword arguments of games (:class:`marl_pack.game.spec.GameSpec`)."""


class Removed(NamedTuple):
    """A removed setting: the only value that is still accepted, and what this value means."""

    value: object
    now: str


REMOVED = {
    "network.dilation": Removed(1, "every convolution sees the cells next to each cell"),
    "network.share_trunk": Removed(True, "the critic always uses the features of its actor"),
    "ppo.symmetry": Removed(False, "the samples of an update are never mirrored"),
}
"""Settings without a good effect (docs/results.md), by their section and name."""


def removed(key: str) -> Removed | None:
    """Return the record of a removed setting, or None; ``key`` has dots between sections."""
    return REMOVED.get(".".join(key.split(".")[-2:]))


def nearest(name: str, valid: Iterable[str]) -> str | None:
    """Return the valid name that ``name`` most probably means, or None."""
    return next(iter(difflib.get_close_matches(name, list(valid), n=1)), None)


def did_you_mean(name: str | None) -> str:
    """Return the end of a sentence: a question about the name, or a full stop without a name."""
    return f"; did you mean {name!r}?" if name else "."


def guess(name: str, valid: Iterable[str]) -> str:
    """Return the end of a message that asks for the nearest valid name; empty if none is near."""
    near = nearest(name, valid)
    return did_you_mean(near) if near else ""


def refuse_old(name: str, names: Mapping[str, str], kind: str) -> None:
    """Raise ValueError with the new name if ``name`` is an old one.

    Args:
        name: the name to check.
        names: old name → new name.
        kind: what the name stands for, such as an option; for the message.
    """
    if name in names:
        raise ValueError(f"{kind} {name!r} is now called {names[name]!r}")
