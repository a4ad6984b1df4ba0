"""Make the policies and the game that a command's options name.

If an option of the game is not used, its value comes from the first checkpoint among the policies.
Without a checkpoint the game is RS in a bin of 10 × 10 × 10 under ``hull_alpha``.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import torch
from rich.console import Console

from marl_pack.agents.keys import ORIENTATION_AGENTS, POLICIES
from marl_pack.agents.policy import InTurns, Policy
from marl_pack.agents.selection.beam_settings import BeamSettings
from marl_pack.agents.selection.budget_settings import BudgetSettings
from marl_pack.agents.selection.choosing import selection_policy_of
from marl_pack.agents.selection.policies import SelectionPolicy
from marl_pack.agents.sources import is_own
from marl_pack.bins import check_device
from marl_pack.checks import LARGEST_SEED, whole_number
from marl_pack.evaluation.rollout import Rollout, batches
from marl_pack.game.packing import Packing
from marl_pack.game.selection import SelectionPacking
from marl_pack.game.spec import SelectionSpec
from marl_pack.geometry import Size
from marl_pack.items import (
    DEFAULT_SIDES,
    GENERATED,
    Stream,
    choose_stream,
)
from marl_pack.option_record import given_options
from marl_pack.options import MOST_AT_ONCE
from marl_pack.terminal import announce_compiling


@dataclass(frozen=True)
class Setup:
    """The policies and the game that a command's options name."""

    policies: dict[str, Any]  # by the name of the policy's row in the table
    stream: Stream
    items: str  # a generated stream's name, or a file
    sides: tuple[int, int]  # shortest and longest side of generated items, in cells
    spec: SelectionSpec
    arguments: argparse.Namespace  # the parsed options

    def game(self, n: int, first_episode: int) -> Any:
        """Return ``n`` games without ``auto_reset``; the first plays episode ``first_episode``.

        They are a :class:`Packing`, or a :class:`SelectionPacking` if the options ask for one.
        """
        if self.spec.selects:
            return SelectionPacking(
                n, self.stream, spec=self.spec, device=self.arguments.device,
                seed=self.arguments.seed, first_episode=first_episode,
            )  # fmt: skip
        return Packing(
            n, items=self.stream, spec=self.spec, device=self.arguments.device,
            seed=self.arguments.seed, first_episode=first_episode, auto_reset=False,
        )  # fmt: skip

    def batches(
        self, policy: Policy, episodes: int, progress: Callable[[int], object]
    ) -> Iterator[Rollout]:
        """Play episodes in batches (:func:`marl_pack.evaluation.rollout.batches`)."""
        return batches(policy, self.game, episodes, progress, self.arguments.explain)

    @property
    def settings(self) -> dict[str, Any]:
        """All options with the values of the game filled in, for a report."""
        paths = "json", "save_stacks"
        options = {key: value for key, value in vars(self.arguments).items() if key not in paths}
        return options | self.spec.to_dict() | {"items": self.items, "sides": self.sides}

    def __str__(self) -> str:
        text = self.items
        if self.items in GENERATED and self.sides != DEFAULT_SIDES:
            text += f" {self.sides[0]}-{self.sides[1]}"
        text += f", {self.spec}"
        if self.arguments.symmetric:
            text += "; learned agents asked in all symmetries"
        return text


def set_threads(threads: int) -> None:
    """Set the number of threads on the CPU.

    Raises:
        ValueError: unless it is a whole number from 1 to MOST_AT_ONCE.
    """
    torch.set_num_threads(whole_number(threads, "--threads", 1, MOST_AT_ONCE))


def choose(arguments: argparse.Namespace, console: Console) -> Setup:
    """Return the policies and the game that the options name.

    Args:
        arguments: the parsed options.
        console: the console that shows the game that each checkpoint was trained on.

    Raises:
        ValueError, FileNotFoundError: if an option is impossible; says what would be right.
    """
    announce_compiling(console)
    check_device(arguments.device)
    whole_number(arguments.seed, "--seed", 0, LARGEST_SEED)
    policies, trained = choose_policies(arguments, console)
    stream, items, sides, spec = choose_game(arguments, trained)
    draws = arguments.plan is not None and BudgetSettings.are_in(arguments.plan)
    if draws or (arguments.plan is not None and not spec.selects):
        policies = with_search(policies, arguments, stream, spec.bin)
    if spec.selects:
        selecting = with_selection(policies, arguments)
        return Setup(selecting, stream, items, sides, spec, arguments)
    return Setup(policies, stream, items, sides, spec, arguments)


def choose_game(
    arguments: argparse.Namespace, trained: dict[str, Any]
) -> tuple[Stream, str, tuple[int, int], SelectionSpec]:
    """Return the item stream, its name, the sides of generated items, and the game.

    Args:
        arguments: the parsed options; an option that is not used is None.
        trained: the game that the first checkpoint was trained on; empty without a checkpoint.
    """
    chosen = given_options(arguments, SelectionSpec)
    if "rule" in chosen:  # margin and thresholds belong to the rule
        trained = trained | {"margin": None, "thresholds": None}
    items = str(trained.get("items", "rs") if arguments.items is None else arguments.items)
    low, high = arguments.sides or trained.get("sides", DEFAULT_SIDES)
    # The bin is the one of --bin; else, for items of --items, the one in their file; else the one
    # of the training.
    size, trained_size = chosen.get("bin"), trained.get("bin")
    if size is None and arguments.items is None:
        size = trained_size
    size, trained_size = (tuple(sides) if sides else None for sides in (size, trained_size))
    stream, bin_size = choose_stream(items, size, (low, high), trained_size)
    spec = SelectionSpec.of(trained | chosen | {"bin": bin_size})
    return stream, items, (low, high), spec


def choose_policies(
    arguments: argparse.Namespace, console: Console
) -> tuple[dict[str, Policy], dict[str, Any]]:
    """Return the policies that the options name, and the game of the first checkpoint.

    The keys of the policies are the names of their rows in the table. The game is the one that the
    first checkpoint was trained on, with the keys of :class:`marl_pack.config.Game`. It is empty
    without a checkpoint.

    Raises:
        ValueError, FileNotFoundError: if a name is unknown, or the options do not fit together.
    """
    pair = arguments.orientation, arguments.placement
    if (pair[0] is None) != (pair[1] is None):
        raise ValueError("--orientation and --placement go together: name both agents")
    names = arguments.policy or ([] if pair[0] else ["dblf"])
    sources = [name for name in dict.fromkeys((*names, *pair)) if name is not None]
    # ORIENTATION_AGENTS has the names of all heuristics; is_own: a function of the user's.
    checkpoints_named = [s for s in sources if s not in ORIENTATION_AGENTS and not is_own(s)]
    if arguments.symmetric and not checkpoints_named:
        raise ValueError("--symmetric: needs a run's folder or checkpoint")
    # Learned agents need rsl_rl, which is slow to import.
    from marl_pack.agents.learning import checkpoint as checkpoints
    from marl_pack.agents.loading import Loader, trained_game, trained_on

    settings = arguments.device, arguments.seed, arguments.symmetric
    policies = {name: Loader(*settings).policy(name) for name in names}
    if pair[0] is not None:
        loader = Loader(*settings)
        policies[f"{pair[0]} + {pair[1]}"] = InTurns(
            loader.orientation_agent(pair[0]), loader.placement_agent(pair[1])
        )
    trained: dict[str, Any] = {}
    for source in checkpoints_named:
        checkpoint = checkpoints.read(source)
        try:
            trained = trained or trained_game(checkpoint)
            description = trained_on(checkpoint)
        except ValueError as error:
            raise ValueError(f"{source}: {error}") from None
        console.print(f"{source}: trained on {description}", soft_wrap=True)
    return policies, trained


def with_selection(
    policies: dict[str, Policy], arguments: argparse.Namespace
) -> dict[str, SelectionPolicy]:
    """Return policies for games in which a box and a bin are selected first.

    A heuristic takes the best placement in any option. Learned agents take the placement that gains
    most by their critic of afterstates; with ``--plan`` they search among the known boxes. A
    function of the user's is called with the game as it is.

    Raises:
        ValueError: if a policy cannot play such games; says why.
    """
    if arguments.orientation is not None or arguments.symmetric:
        raise ValueError(
            "--orientation, --placement, --symmetric: go with games of one visible box and one bin"
        )
    settings = None
    if arguments.plan is not None and not BudgetSettings.are_in(arguments.plan):
        settings = BeamSettings.parse(arguments.plan)
    chosen: dict[str, SelectionPolicy] = {}
    for name, policy in policies.items():
        searches = settings if name not in POLICIES and not is_own(name) else None
        try:
            selecting = selection_policy_of(policy, searches)
        except ValueError as error:
            raise ValueError(f"--policy {name}: {error}") from None
        chosen[name if searches is None else f"{name}, {searches}"] = selecting
    if settings is not None and list(chosen) == list(policies):
        raise ValueError("--plan: needs --policy with a run's folder or checkpoint")
    return chosen


def with_search(
    policies: dict[str, Policy], arguments: argparse.Namespace, stream: Stream, size: Size
) -> dict[str, Policy]:
    """Return the policies, with the search of ``--plan`` added to the learned ones.

    The search imagines items of the stream that the agents were trained on. If that was a file, it
    imagines items of ``stream``.

    Raises:
        ValueError: if the settings cannot be read, or there is no checkpoint to search with.
    """
    from marl_pack.agents.learning import checkpoint as checkpoints
    from marl_pack.agents.loading import Loader, imagined_stream
    from marl_pack.agents.search_settings import SearchSettings

    form = BudgetSettings if BudgetSettings.are_in(arguments.plan) else SearchSettings
    settings = form.parse(arguments.plan)
    fixed = [name for name in policies if name in POLICIES or is_own(name)]
    if len(fixed) == len(policies) or arguments.orientation is not None:
        raise ValueError("--plan: needs --policy with a run's folder or checkpoint")
    policies_with_search: dict[str, Policy] = {}
    for name, policy in policies.items():
        if name in fixed:
            policies_with_search[name] = policy
            continue
        checkpoint = checkpoints.read(name, arguments.device)
        try:
            futures = imagined_stream(checkpoint, size, stream).to(arguments.device)
        except ValueError as error:
            raise ValueError(f"--plan: {error}") from None
        loader = Loader(arguments.device, arguments.seed, arguments.symmetric)
        try:
            planner = loader.planner(checkpoint, settings, futures)
        except ValueError as error:
            raise ValueError(f"--policy {name}: {error}") from None
        policies_with_search[f"{name}, {settings}"] = planner
    return policies_with_search
