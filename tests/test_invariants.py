"""The mode MARL_PACK_CHECK=1: games are compared with plain code around every placement."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from conftest import in_play
from small_runs import PLAIN_NETWORK

from marl_pack import bins as bin_state
from marl_pack import env_aec
from marl_pack.agents.afterstates.lookahead import Lookahead
from marl_pack.agents.heuristics import make_policy
from marl_pack.agents.learned import LearnedAgent
from marl_pack.agents.networks.actor_critic import make_actor
from marl_pack.agents.search import Planner
from marl_pack.agents.search_settings import SearchSettings
from marl_pack.backend import Backend
from marl_pack.game import compiled, invariants
from marl_pack.game.packing import Packing
from marl_pack.items import make_stream
from marl_pack.stability import RULES

UPRIGHT = {
    "items": [[2, 3, 1], [1, 2, 2], [3, 1, 1], [2, 2, 2], [1, 1, 3], [2, 1, 1]],
    "weights": [1.5, 2, 3, 0.75, 2.25, 1],
    "orientations": [[0, 1], [0, 2, 4], [0, 1, 2, 3, 4, 5], [0], [5, 4], [1, 3]],
}
GAMES: dict[str, tuple[dict[str, Any], ...]] = {
    "hull_1": ({"margin": 0.5}, {"com_offset": (0.25, -0.125, 0)}),
    "hull_alpha": (
        {"margin": 0.25}, {"items": UPRIGHT}, {"mask_orientations": False, "max_items": 3},
    ),
    "lbcp": ({"margin": 0.5}, {"com_offset": (-0.25, 0.125, 0.25), "items": UPRIGHT}),
    "area_ratio": ({"thresholds": "code"}, {"orientations": (0, 3, 5)}),
    "equilibrium": ({"items": UPRIGHT}, {"margin": 0.25, "com_offset": (0.25, 0, 0)}),
    "none": ({"items": "cut1"},),
}  # fmt: skip


@pytest.fixture
def checked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MARL_PACK_CHECK", "1")


@pytest.mark.usefixtures("checked")
@pytest.mark.parametrize("rule", RULES)
def test_games_of_every_rule_equal_what_their_boxes_make(rule: str) -> None:
    for settings in ({}, *GAMES[rule]):
        for backend in Backend:  # the second one finds the masks of the first
            options = {"sides": (1, 3), "rule": rule, "backend": backend} | settings
            game = in_play(2, 5, bin=(4, 4, 5), **options)
            assert game.checked
            assert game.episode.sum() > 1 or game.bins.count.sum() > 4
            branch = game.branch(torch.tensor([1, 0, 1]))
            branch.place(*make_policy("random", 2)(branch))


@pytest.mark.usefixtures("checked")
def test_a_rule_of_the_user_is_checked_for_what_fits() -> None:
    def flat(bins: Any, item: Any) -> torch.Tensor:
        return RULES["none"](bins, item) & (bins.heightmap == 0)[:, None]

    in_play(2, 4, bin=(4, 4, 5), sides=(1, 3), rule=flat)

    def anywhere(bins: Any, item: Any) -> torch.Tensor:
        return torch.ones_like(flat(bins, item))

    with pytest.raises(AssertionError, match=r"mask at .* is True, but must be False"):
        in_play(2, 1, bin=(4, 4, 5), sides=(1, 3), rule=anywhere)


@pytest.mark.usefixtures("checked")
def test_the_environment_is_checked_too() -> None:
    env = env_aec.env(bin_size=(4, 4, 5), sides=(1, 3))
    env.reset(seed=1)
    env.step(0)
    env.unwrapped._game.bins.empty_map[0, 3, 3] = 2
    with pytest.raises(AssertionError, match=r"game 0: empty_map at \(x, y\) = \(3, 3\) is 2"):
        env.step(0)


@pytest.mark.usefixtures("checked")
def test_the_games_that_a_search_imagines_are_checked_too(monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(0)
    lookahead = Lookahead()
    agents = (
        LearnedAgent(kind, make_actor(kind, PLAIN_NETWORK, "cpu").eval(), lookahead)
        for kind in ("orientation", "placement")
    )
    futures = make_stream("rs", (4, 4, 5), (1, 3))
    planner = Planner(*agents, None, SearchSettings(rollouts=1, top=2), futures)
    game, compared = Packing(2, (4, 4, 5), sides=(1, 3)), []
    check = invariants.check
    monkeypatch.setattr(invariants, "check", lambda games: [compared.append(games), check(games)])
    game.place(*planner(game))
    assert len(set(map(id, compared))) > 2


def raise_box(game: Packing) -> None:
    game.bins.boxes[1, 0, 2] += 1


def widen_box(game: Packing) -> None:
    game.bins.boxes[1, 0, 3] += 9


def repeat_box(game: Packing) -> None:
    game.bins.boxes[1, 1] = game.bins.boxes[1, 0]


def flip(tensor: torch.Tensor) -> None:
    tensor ^= True


DAMAGES: dict[str, Callable[[Packing], None]] = {
    r"heightmap at \(x, y\) = \(2, 3\) is": lambda game: game.bins.heightmap[1, 2, 3].add_(1),
    r"empty_map at \(x, y\) = \(3, 0\) is": lambda game: game.bins.empty_map[1, 3, 0].add_(1),
    "filled is": lambda game: game.bins.filled[1].sub_(1),
    "count is -1, but must be from 0 to": lambda game: game.bins.count[1].fill_(-1),
    "heightmap at": lambda game: game.bins.count[1].sub_(1),
    "box 0, .* must rest at z = 0": raise_box,
    "box 0, .* must lie in the bin": widen_box,
    "box 1, .* must not overlap box 0": repeat_box,
    r"mask at \(orientation, x, y\) = \(4, 3, 2\) is True, but must be False": (
        lambda game: game.mask[1, 4, 3, 2].fill_(True)
    ),
    r"mask at .* is False, but must be True": lambda game: game.mask[1].fill_(False),
    "alive is False, but must be True": lambda game: flip(game.alive[1]),
    r"orientation_mask at \(orientation\) = \(2,\) is": (
        lambda game: flip(game.orientation_mask[1, 2])
    ),
}


@pytest.mark.usefixtures("checked")
@pytest.mark.parametrize("backend", Backend)
@pytest.mark.parametrize("report", DAMAGES)
def test_a_damaged_state_is_reported(report: str, backend: Backend) -> None:
    game = in_play(3, 2, bin=(4, 4, 5), sides=(1, 2), backend=backend)
    chosen = make_policy("dblf")(game)
    DAMAGES[report](game)
    with pytest.raises(AssertionError, match=f"^game 1: {report}") as error:
        game.place(*chosen, check=False)
    assert "\n" not in str(error.value)


@pytest.mark.usefixtures("checked")
@pytest.mark.parametrize("backend", Backend)
def test_a_placement_that_goes_wrong_is_reported(
    backend: Backend, monkeypatch: pytest.MonkeyPatch
) -> None:
    place, place_items = bin_state.place, compiled.place_items

    def elsewhere(bins: Any, sides: Any, corners: Any, *rest: Any) -> Any:
        return place(bins, sides, torch.zeros_like(corners), *rest)

    def elsewhere_compiled(*arguments: Any) -> None:
        before, (cell, *rest) = arguments[:13], arguments[13:]
        place_items(*before, np.zeros_like(cell), *rest)

    game = Packing(2, (4, 4, 5), sides=(1, 2), backend=backend)
    cell = torch.tensor([0, game.floor.cell(1, 2)])
    monkeypatch.setattr(bin_state, "place", elsewhere)
    monkeypatch.setattr(compiled, "place_items", elsewhere_compiled)
    with pytest.raises(AssertionError, match=r"game 1: table of boxes at .* = \(0, 0\) is 0.0"):
        game.place(torch.tensor([0, 0]), cell)


@pytest.mark.usefixtures("checked")
@pytest.mark.parametrize(("orientation", "cell"), [(0, 15), (0, 16), (6, 0), (-1, 0)])
def test_a_choice_that_is_not_legal_is_reported_where_it_is_not_refused(
    orientation: int, cell: int
) -> None:
    game = Packing(2, (4, 4, 5), sides=(2, 2))
    chosen = torch.tensor([0, orientation]), torch.tensor([0, cell])
    with pytest.raises(AssertionError, match=f"game 1: orientation {orientation}, cell {cell}"):
        game.place(*chosen, check=False)


def test_the_mode_is_off_unless_it_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    for value, checked in ((None, False), ("0", False), ("", False), ("1", True)):
        if value is None:
            monkeypatch.delenv("MARL_PACK_CHECK", raising=False)
        else:
            monkeypatch.setenv("MARL_PACK_CHECK", value)
        game = Packing(1)
        assert game.checked == game.branch(torch.tensor([0])).checked == checked
    monkeypatch.setenv("MARL_PACK_CHECK", "yes")
    with pytest.raises(ValueError, match="MARL_PACK_CHECK = 'yes': needs 1 or 0"):
        Packing(1)
