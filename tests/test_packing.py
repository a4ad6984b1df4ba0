import numpy as np
import pytest
import torch
from conftest import boxes_of, in_play

from marl_pack.agents.afterstates.lookahead import Lookahead
from marl_pack.agents.heuristics import HEURISTICS, make_policy
from marl_pack.agents.keys import POLICIES
from marl_pack.agents.policy import draw
from marl_pack.backend import Backend
from marl_pack.game.moves import Floor, Moves
from marl_pack.game.packing import Packing
from marl_pack.game.spec import GameSpec
from marl_pack.geometry import ORIENTATIONS
from marl_pack.items import check_items
from marl_pack.stability import RULES, make_rule

NUMBER = "needs a whole number"


def test_a_game_worked_by_hand() -> None:
    # Bin 4 x 4 x 4 (64 cells). A 4 x 4 x 2 slab on the floor, then a 2 x 2 x 2 cube in a corner,
    # then a 4 x 2 x 1 plank across its top: half over the cube, waste 2 x 2 x 2 below the rest.
    game = Packing(
        1, (4, 4, 4), [[4, 4, 2], [2, 2, 2], [4, 2, 1]], auto_reset=False, alpha=2.0, beta=0.5
    )
    assert game.mask[0, 0].nonzero().tolist() == [[0, 0]]
    first = game.place(torch.tensor([0]), torch.tensor([0]))
    assert float(first.reward) == pytest.approx(2 * 32 / 64)
    assert not bool(first.done)
    assert game.items.sides.tolist() == [[2, 2, 2]]
    # In each orientation the cube has nine places.
    assert game.mask[0].flatten(1).sum(1).tolist() == [9] * 6
    second = game.place(torch.tensor([5]), torch.tensor([0]))
    assert float(second.reward) == pytest.approx(2 * 8 / 64)
    # Over the cube it would reach z = 5, so it must lie flat beside it: 2 x 4 x 1 at x = 2.
    oriented = game.orient(torch.tensor([1]))
    assert oriented.sides.tolist() == [[2, 4, 1]]
    assert oriented.mask[0].nonzero().tolist() == [[2, 0]]
    third = game.place(torch.tensor([1]), torch.tensor([2 * 4]))
    assert bool(third.done)
    assert float(third.utilization) == pytest.approx((32 + 8 + 8) / 64)
    assert int(third.placed) == 3
    assert not game.alive.any()
    assert not game.mask.any()


def test_wasted_space_lowers_the_reward() -> None:
    game = Packing(1, (4, 2, 4), [[2, 2, 2], [3, 2, 1], [1, 1, 1]], auto_reset=False)
    game.place(torch.tensor([0]), torch.tensor([0]))
    outcome = game.place(torch.tensor([0]), torch.tensor([0]))  # 1 x 2 x 2 cells are enclosed
    assert float(outcome.reward) == pytest.approx((6 - 4) / 32)
    # Over the enclosed space hull_alpha lets nothing stand.
    assert game.mask[0, 0].nonzero().tolist() == [[0, 0], [0, 1], [1, 0], [1, 1], [3, 0], [3, 1]]


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("size", [(10, 10, 10), (8, 5, 13)])
def test_every_play_the_mask_allows_ends_with_an_item_without_a_legal_cell(
    rule: str, size: tuple[int, int, int]
) -> None:
    game = Packing(24, size, "rs", rule=rule, auto_reset=False, seed=1)
    policy = make_policy("random", 2)
    while game.alive.any():
        was = game.alive.clone()
        before = game.bins.clone()
        outcome = game.place(*policy(game))
        assert torch.equal(outcome.done, was & ~game.alive)
        # What has ended stays as it is.
        for now, then in zip(game.bins[~was].tensors(), before[~was].tensors(), strict=True):
            assert torch.equal(now, then)
        assert torch.equal(game.alive, game.orientation_mask.any(1))
        assert torch.equal(game.orientation_mask, game.mask.flatten(2).any(2))
    items = game.stream.item(game.state.stream, game.t)
    assert not make_rule(rule)(game.bins, game.orient_item(items)).any()
    for b in range(24):
        boxes = boxes_of(game.bins, b)
        assert (boxes[:, :3] + boxes[:, 3:] <= np.array(size)).all()


def test_a_bins_game_does_not_depend_on_the_others() -> None:
    policy = make_policy("dblf")
    together = Packing(12, seed=4, auto_reset=False)
    while together.alive.any():
        together.place(*policy(together))
    for b in (0, 5, 11):
        alone = Packing(1, seed=4, first_episode=b, auto_reset=False)
        while alone.alive.any():
            alone.place(*policy(alone))
        assert (boxes_of(alone.bins, 0) == boxes_of(together.bins, b)).all()


@pytest.mark.parametrize("items", ["rs", "cut1", "cut2"])
def test_the_same_seed_gives_the_same_game(items: str) -> None:
    def played(seed: int) -> list[list[float]]:
        game, policy = Packing(16, items=items, seed=seed), make_policy("random", 9)
        return [game.place(*policy(game)).reward.tolist() for _ in range(40)]

    assert played(3) == played(3)
    assert played(3) != played(4)


@pytest.mark.parametrize("backend", Backend)
def test_auto_reset_goes_on_with_the_next_episode_of_each_bin(backend: Backend) -> None:
    game, policy = Packing(8, seed=5, backend=backend), make_policy("random", 1)
    finished = 0
    for _ in range(60):
        outcome = game.place(*policy(game))
        finished += int(outcome.done.sum())
        assert game.alive.all()
        fresh = outcome.done
        assert (game.t[fresh] == 0).all()
        assert (game.bins.filled[fresh] == 0).all()
        assert (outcome.utilization[fresh] > 0.1).all()
        assert (game.bins.count == game.t).all()
    assert finished == int((game.episode // 8).sum())
    assert (game.episode % 8 == torch.arange(8)).all()
    # Episode 8 of bin 0 is episode 8 of the stream.
    other = Packing(1, seed=5, first_episode=int(game.episode[0]))
    begun = game.stream.start(5, game.episode[:1])
    first = game.stream.item(begun, torch.tensor([0]))
    assert torch.equal(other.items.sides, first.sides)


@pytest.mark.parametrize("items", ["rs", "cut1", [[[2, 3, 4], [2, 2, 2]], [[4, 4, 4], [3, 1, 2]]]])
@pytest.mark.parametrize("rule", RULES)
def test_both_backends_play_the_same_game(rule: str, items: str | list[list[list[int]]]) -> None:
    def played(backend: Backend) -> tuple[Packing, list[list[float]]]:
        game = Packing(12, (8, 6, 9), items, sides=(2, 4), rule=rule, seed=3, backend=backend)
        policy = make_policy("random", 4)
        return game, [game.place(*policy(game)).reward.tolist() for _ in range(25)]

    loops, rewards = played(Backend.COMPILED)
    tensors, same = played(Backend.TENSOR)
    assert rewards == same
    assert torch.equal(loops.mask, tensors.mask)
    for name, tensor in loops.state.tensors().items():
        if name not in ("bins.boxes", "bins.loads", "bins.labels"):  # rows past count are void
            assert torch.equal(tensor, tensors.state.tensors()[name]), name


def test_orienting_changes_nothing() -> None:
    game = Packing(6, seed=6)
    before = game.bins.clone(), game.mask.clone(), game.items.sides.clone()
    for o in range(6):
        oriented = game.orient(torch.full((6,), o))
        assert torch.equal(oriented.sides, game.items.sides[:, list(ORIENTATIONS[o])])
        assert torch.equal(oriented.mask, game.mask[:, o])
    for now, then in zip(game.bins.tensors(), before[0].tensors(), strict=True):
        assert torch.equal(now, then)
    assert torch.equal(game.mask, before[1])
    assert torch.equal(game.items.sides, before[2])


@pytest.mark.parametrize("auto_reset", [True, False])
def test_an_illegal_placement_is_refused_and_changes_nothing(auto_reset: bool) -> None:
    game = Packing(3, (5, 5, 5), seed=0, auto_reset=auto_reset)
    before = game.bins.clone()
    cell = torch.tensor([0, 24, 0])  # (4, 4): no item of sides ≥ 2 fits there
    with pytest.raises(ValueError, match=r"game 1: item .* at \(4, 4\)"):
        game.place(torch.zeros(3, dtype=torch.int64), cell)
    assert torch.equal(game.bins.heightmap, before.heightmap)
    assert (game.t == 0).all()


@pytest.mark.parametrize("backend", Backend)
@pytest.mark.parametrize(("orientation", "cell"), [(0, -1), (0, 25), (-1, 0), (6, 0)])
def test_an_action_out_of_range_is_refused(orientation: int, cell: int, backend: Backend) -> None:
    game = Packing(1, (5, 5, 5), seed=0, backend=backend)
    with pytest.raises(ValueError, match="may not be placed"):
        game.place(torch.tensor([orientation]), torch.tensor([cell]))
    with pytest.raises(ValueError, match="one whole number for each of 1 games"):
        game.place(torch.zeros(2, dtype=torch.int64), torch.zeros(1, dtype=torch.int64))
    assert int(game.bins.count) == 0


def test_an_episode_that_cannot_begin_is_skipped_or_over() -> None:
    rows = [[[2, 2, 9]], [[3, 3, 3]], [[2, 9, 2]], [[4, 4, 4]]]
    arguments = {"bin": (9, 5, 5), "items": rows, "orientations": (0,)}
    game = Packing(1, **arguments)
    first_sides = []
    for _ in range(4):
        first_sides.append(int(game.items.sides[0, 0]))
        game.place(torch.tensor([0]), torch.tensor([0]))
    assert first_sides == [3, 4, 3, 4]
    still = Packing(4, auto_reset=False, **arguments)
    assert still.alive.tolist() == [False, True, False, True]
    # A margin that some items can never meet does not stop a long run.
    game, policy = Packing(64, margin=1.0), make_policy("random")
    for _ in range(60):
        game.place(*policy(game))
        assert game.alive.all()


def test_orientations_that_are_not_allowed_have_no_cell() -> None:
    game = Packing(16, seed=7, orientations=(0, 1), auto_reset=False)
    policy = make_policy("dblf")
    while game.alive.any():
        assert not game.orientation_mask[:, 2:].any()
        game.place(*policy(game))


@pytest.mark.parametrize("backend", Backend)
def test_weights_and_centres_of_mass_of_placed_boxes_are_stored(backend: Backend) -> None:
    items = check_items([[2, 4, 6], [3, 3, 3]], (10, 10, 10), weights=[7.0, 1.5])
    offset = (0.25, 0.0, -0.25)
    game = Packing(1, items=items, com_offset=offset, auto_reset=False, backend=backend)
    assert float(game.items.weights) == 7.0
    # Orientation 4 is (d, h, w) along x, y, z: middle (2, 3), shifted by (0, -0.25 · 6).
    game.place(torch.tensor([4]), torch.tensor([10 * 1 + 2]))
    assert game.bins.boxes[0, 0].tolist() == [1, 2, 0, 4, 6, 2]
    assert game.bins.loads[0, 0].tolist() == [7.0, 1 + 2.0, 2 + 1.5]
    game.place(torch.tensor([0]), torch.tensor([10 * 7 + 0]))
    assert game.bins.loads[0, 1].tolist() == [1.5, 7 + 2.25, 1.5]


def test_the_equilibrium_rule_uses_the_files_weights() -> None:
    # As in the counterweight case of the rules: a plank held down at one end.
    rows = [[3, 1, 1], [5, 1, 1], [2, 1, 5], [1, 1, 1]]
    spots = [0, 0, 0]
    allowed = []
    for weight in (5.0, 30.0):
        items = check_items(rows, (5, 1, 9), weights=[3, 5, 10, weight])
        game = Packing(1, (5, 1, 9), items, rule="equilibrium", auto_reset=False)
        for cell in spots:
            game.place(torch.tensor([0]), torch.tensor([cell]))
        allowed.append(bool(game.mask[0, 0, 4, 0]))
    assert allowed == [True, False]


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        ({"n": 0}, "at least one game"),
        ({"rule": "hull_2"}, "unknown stability rule"),
        ({"margin": -1}, "margin = -1: needs a number of cells ≥ 0"),
        ({"margin": True}, "margin = True"),
        ({"rule": "area_ratio", "margin": 1}, "no parameter 'margin'"),
        ({"thresholds": "code"}, "no parameter 'thresholds'"),
        ({"thresholds": "codes"}, "thresholds = 'codes': needs one of paper, code"),
        ({"rule": make_rule("hull_1"), "margin": 1}, "margin: needs the name of a rule"),
        ({"mask_orientations": None}, "mask_orientations = None: needs true or false"),
        ({"max_items": 0}, "max_items = 0: needs a whole number ≥ 1"),
        ({"orientations": [0.9]}, "orientations"),
        ({"orientations": "01"}, "orientations"),
        ({"orientations": (6,)}, "orientations"),
        ({"orientations": ()}, "orientations"),
        ({"items": "sr"}, "unknown items"),
        ({"items": [[2, 2, 11]]}, "row 0"),
        ({"bin": (10, 10)}, "bin size"),
        ({"com_offset": (0.6, 0, 0)}, "com_offset"),
        ({"alpha": float("nan")}, "alpha"),
        ({"bin": (40000, 10, 10)}, "at most 32767"),
        ({"margin": 3.0}, "no episode can begin"),
        ({"bin": (4, 9, 9), "items": [[9, 2, 2]], "orientations": (0,)}, "no episode can begin"),
        *[({name: value}, rf"^{name}.*{NUMBER}")
          for name in ("n", "seed", "first_episode") for value in (1.5, 2.0, True, "3", -1)],
        ({"seed": 2**63}, f"seed: {NUMBER} from 0 to 9223372036854775807"),
        *[({"max_items": value}, f"max_items = .*{NUMBER}")
          for value in (2.0, True, "3", np.float64(2), 10**400)],
        *[({"bin": value}, "bin size .*: needs three whole numbers of cells")
          for value in ((5, 5.5, 5), (True, 5, 5), ("5", 5, 5), (10**400, 5, 5), "555",
                        np.ma.array([5, 5, 5], mask=[0, 0, 1]))],
        *[({"sides": value}, "sides .*: need two whole numbers")
          for value in ((2.5, 5), (True, 5), ("2", "5"), (2, float("nan")), "25", 5, (5, 2))],
        *[({"orientations": value}, "orientations = .*: need one or more of 0 … 5")
          for value in (b"\x00", {0: 1}, np.ma.array([0, 1], mask=[0, 1]), None, 0)],
        *[({"com_offset": value}, "com_offset")
          for value in ("000", None, ("0.1", 0, 0), (True, 0, 0), (0.1, 0))],
        *[({name: 10**400}, f"{name} = .*: needs a finite number") for name in ("alpha", "margin")],
        ({"thresholds": ["code"]}, "thresholds = .*: needs one of paper, code"),
        ({"items": [np.ma.array([[2, 2, 2], [9, 9, 9]], mask=[[0] * 3, [1] * 3])]},
         "items: has masked values"),
        ({"auto_reset": "no"}, "auto_reset = 'no': needs true or false"),
        ({"spec": {}}, "spec = {}: needs a GameSpec"),
        ({"backend": "tensor"}, "backend = 'tensor': needs one of Backend.COMPILED, "),
    ],
)  # fmt: skip
def test_impossible_games_are_refused(arguments: dict[str, object], why: str) -> None:
    with pytest.raises(ValueError, match=why) as error:
        Packing(**({"n": 2} | arguments))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("backend", Backend)
@pytest.mark.parametrize(
    "choice",
    [
        [0, 0, 0], 0, None, np.zeros(3, np.int64), torch.zeros(3), torch.zeros(3, dtype=torch.bool),
        torch.zeros(3, dtype=torch.int32), torch.zeros(3, dtype=torch.uint8),
        torch.zeros(2, dtype=torch.int64), torch.zeros(3, 1, dtype=torch.int64),
        torch.tensor(0), torch.zeros(3, dtype=torch.int64, device="meta"),
    ],
)  # fmt: skip
def test_choices_are_whole_numbers_one_for_each_game(choice: object, backend: Backend) -> None:
    game, zeros = Packing(3, seed=6, backend=backend), torch.zeros(3, dtype=torch.int64)
    before = game.state_dict()
    for play in (
        lambda: game.orient(choice),
        lambda: game.orient(choice, check=False),
        lambda: game.place(choice, zeros),
        lambda: game.place(zeros, choice),
        lambda: game.place(zeros, choice, check=False),
    ):
        with pytest.raises(
            ValueError, match=r": needs one whole number for each of 3 games, int64"
        ):
            play()
    assert all(torch.equal(value, before[name]) for name, value in game.state_dict().items())


@pytest.mark.parametrize("backend", Backend)
@pytest.mark.parametrize("wrong", [-1, -6, -7, 6, 11, 12, 2**62, -(2**63)])
def test_an_orientation_out_of_range_is_no_other_one(wrong: int, backend: Backend) -> None:
    game = Packing(3, seed=6, backend=backend)
    orientation, cell = torch.tensor([0, wrong, 0]), game.mask[:, 0].flatten(1).int().argmax(1)
    reason = f"game 1: orientation: needs a whole number from 0 to 5, not {wrong}"
    with pytest.raises(ValueError, match=reason):
        game.orient(orientation)
    with pytest.raises(ValueError, match=rf"game 1: .* in orientation {wrong} may not be placed"):
        game.place(orientation, cell)
    with pytest.raises(ValueError, match=reason):
        game.place(orientation, cell, check=False)
    assert not game.bins.count.any()


@pytest.mark.parametrize(
    "games", [[0], torch.tensor([True, False]), torch.tensor([0.0]), torch.tensor([2]),
              torch.tensor([-1]), torch.tensor([[0]])],
)  # fmt: skip
def test_games_to_branch_are_numbers_of_games(games: object) -> None:
    game = Packing(2)
    with pytest.raises(ValueError, match=r"^games: needs "):
        game.branch(games)
    with pytest.raises(ValueError, match=r"^episodes: a stream needs one for each of 1 games"):
        game.branch(torch.tensor([0]), game.stream)


def test_a_large_and_a_flat_bin_are_played() -> None:
    for size, sides in (((120, 120, 120), (6, 60)), ((30, 7, 2), (1, 2)), ((1, 1, 50), (1, 1))):
        game = Packing(4, size, sides=sides, auto_reset=False)
        policy = make_policy("random")
        while game.alive.any():
            outcome = game.place(*policy(game))
        assert (outcome.utilization > 0).all()


def test_draw_is_uniform_over_the_true_entries() -> None:
    mask = torch.tensor([[False, True, False, True, True], [False] * 5]).repeat(6000, 1)
    chosen = draw(mask, torch.Generator().manual_seed(0))
    counts = torch.bincount(chosen[::2], minlength=5)
    assert counts[[0, 2]].tolist() == [0, 0]
    assert (counts[[1, 3, 4]] - 2000).abs().max() < 200  # 5 standard deviations are 183
    assert (chosen[1::2] == 0).all()


@pytest.mark.parametrize("name", POLICIES)
def test_heuristics_choose_what_the_mask_allows(name: str) -> None:
    game, policy = Packing(32, (9, 7, 8), seed=8, auto_reset=False), make_policy(name, 3)
    while game.alive.any():
        orientation, cell = policy(game)
        legal = game.mask.flatten(2)[torch.arange(32), orientation, cell]
        assert torch.equal(legal, game.alive)
        game.place(orientation, cell)


def test_heuristics_take_the_placement_of_their_rule() -> None:
    def choice(name: str, boxes: list[tuple[int, int, int, int]], item: list[int]) -> list[int]:
        """Set boxes (cell x, w, d, h) along x, then ask where the item goes: x, y, z and sides."""
        game = Packing(
            1, (6, 2, 6), [*([w, d, h] for _, w, d, h in boxes), item, [1, 1, 1]],
            orientations=(0,), auto_reset=False,
        )  # fmt: skip
        for x, *_ in boxes:
            game.place(torch.tensor([0]), torch.tensor([x * 2]))
        game.place(*make_policy(name)(game))
        return game.bins.boxes[0, len(boxes), :3].tolist()

    # Floor is left at x = 4, 5: DBLF goes deepest; so do the others, nothing is enclosed there.
    step = [(0, 2, 2, 1), (2, 2, 2, 2)]
    assert choice("dblf", step, [2, 2, 1]) == [4, 0, 0]
    # A 3-wide box fits no level floor. DBLF takes the lowest place that stands, x = 0 at z = 2? No:
    # at x = 0 its middle 1.5 is over the lower block, contact only at x = 2: it would tip. x = 1
    # puts it over 2 … 4 with one column enclosed, x = 2 would enclose two more.
    assert choice("dblf", step, [3, 2, 1]) == [1, 0, 2]
    # One column of depth 1 enclosed at x = 1 (waste 2), at x = 2 the floor below x = 4 (waste 4).
    assert choice("best_fit", step, [3, 2, 1]) == [1, 0, 2]
    # Best fit goes up where deepest would enclose space.
    pit = [(0, 1, 2, 2), (3, 3, 2, 3)]
    assert choice("dblf", pit, [3, 2, 1])[2] == 3
    assert choice("best_fit", pit, [3, 2, 1]) == [3, 0, 3]


HEURISTIC_KEYS = {
    "dblf": lambda c: (c["z"], c["x"], c["y"]),
    "height_min": lambda c: (c["waste"], c["x"] + c["y"]),
    "best_fit": lambda c: (c["waste"], c["top"], c["x"] + c["y"]),
    "max_feasible": lambda c: (-c["cells"], c["top"], c["x"] + c["y"]),
    "as_cut": lambda c: (c["z"], c["x"], c["y"]),  # these items are not pieces of a cut
}


@pytest.mark.parametrize("backend", Backend)
@pytest.mark.parametrize("items", ["cut1", "cut2"])
def test_the_pieces_of_a_cut_placed_where_they_were_cut_fill_the_bin(
    items: str, backend: Backend
) -> None:
    game = Packing(8, (8, 6, 9), items, sides=(2, 4), auto_reset=False, seed=2, backend=backend)
    while bool(game.alive.any()):
        game.place(*make_policy("as_cut")(game))
    assert (game.bins.filled == game.volume).all()


@pytest.mark.parametrize("steps", [3, 7, 11])
def test_a_heuristic_breaks_ties_by_its_further_keys_then_by_orientation_and_cell(
    steps: int,
) -> None:
    game = in_play(16, steps, bin=(4, 5, 6), sides=(1, 3), auto_reset=False)
    cells = Lookahead().feasible_cells(game)
    chosen = {name: torch.stack(HEURISTICS[name](game), 1).tolist() for name in HEURISTICS}
    assert chosen.keys() == HEURISTIC_KEYS.keys()
    for g in game.alive.nonzero().flatten().tolist():
        candidates = []
        for o, x, y in game.mask[g].nonzero().tolist():
            w, d, h = (int(game.items.sides[g, axis]) for axis in ORIENTATIONS[o])
            window = game.bins.heightmap[g, x : x + w, y : y + d].long()
            z = int(window.max())
            candidates.append({
                "x": x, "y": y, "z": z, "top": z + h, "waste": int((z - window).sum()),
                "cells": float(cells[g, o, x, y]), "choice": [o, x * 5 + y],
            })  # fmt: skip
        for name, keys in HEURISTIC_KEYS.items():
            best = min(candidates, key=lambda c, keys=keys: (*keys(c), c["choice"]))
            assert chosen[name][g] == best["choice"], name


def test_the_papers_tables_heuristics_are_reproduced_on_the_published_sequences(
    data_folder,
) -> None:
    from marl_pack.items import load

    for file, low, high in (("rs.npz", 0.685, 0.695), ("cut_1.npz", 0.750, 0.762)):
        sequences, size = load(data_folder / file)
        game = Packing(2100, size, sequences, auto_reset=False)
        while game.alive.any():
            outcome = game.place(*make_policy("dblf")(game))
        assert low < float(outcome.utilization.mean()) < high


@pytest.mark.parametrize("backend", Backend)
def test_an_unmasked_orientation_without_a_cell_ends_the_episode_with_nothing_placed(
    backend: Backend,
) -> None:
    """A 1 × 1 × 3 bin beside items 1 × 1 × 2 and 1 × 1 × 1: lying, the first fits nowhere."""
    for auto_reset in (False, True):
        game = Packing(2, (1, 1, 3), [[1, 1, 2], [1, 1, 1]], mask_orientations=False,
                       auto_reset=auto_reset, backend=backend)  # fmt: skip
        assert game.orientation_mask.all()
        upright, lying = 0, int((~game.mask[0].flatten(1).any(1)).nonzero()[0])
        outcome = game.place(torch.tensor([upright, lying]), torch.tensor([0, 0]))
        assert outcome.done.tolist() == [False, True]
        assert outcome.reward.tolist() == pytest.approx([2 / 3, 0])
        assert outcome.placed.tolist() == [1, 0]
        if auto_reset:
            assert game.alive.all()
            assert game.t.tolist() == [1, 0]
            continue
        assert game.alive.tolist() == [True, False]
        assert not game.mask[1].any()
        outcome = game.place(torch.tensor([upright, lying]), torch.tensor([0, 0]))
        assert outcome.done.tolist() == [True, False]
        assert game.bins.filled.tolist() == [3, 0]


@pytest.mark.parametrize("backend", Backend)
def test_an_episode_goes_on_as_usual_after_one_lost_without_a_cell(backend: Backend) -> None:
    game = Packing(2, (1, 1, 3), [[1, 1, 2], [1, 1, 1]], mask_orientations=False, backend=backend)
    upright, lying = 0, int((~game.mask[0].flatten(1).any(1)).nonzero()[0])
    game.place(torch.tensor([lying, lying]), torch.tensor([0, 0]))
    assert not game.state.lost.any()
    assert game.mask[:, upright].all()
    outcome = game.place(torch.tensor([upright, upright]), torch.tensor([0, 0]))
    assert outcome.placed.tolist() == [1, 1]


@pytest.mark.parametrize("backend", Backend)
def test_a_game_lost_without_a_cell_keeps_its_item_and_shows_no_action(backend: Backend) -> None:
    game, loaded = (
        Packing(2, (1, 1, 3), [[1, 1, 2], [1, 1, 1]], mask_orientations=False, auto_reset=False,
                backend=backend)
        for _ in range(2)
    )  # fmt: skip
    lying = int((~game.mask[0].flatten(1).any(1)).nonzero()[0])
    game.place(torch.tensor([0, lying]), torch.tensor([0, 0]))
    assert game.t.tolist() == [1, 0]
    assert game.items.sides.tolist() == [[1, 1, 1], [1, 1, 2]]
    assert game.orientation_mask.any(1).tolist() == [True, False]
    loaded.load_state_dict(game.state_dict())
    assert loaded.alive.tolist() == [True, False]


@pytest.mark.parametrize("wrong", [(-1, 0), (6, 0), (2, -1), (2, 1), (1, 0)])
@pytest.mark.parametrize("backend", Backend)
def test_without_a_mask_of_orientations_an_impossible_action_is_refused_too(
    wrong: tuple[int, int], backend: Backend
) -> None:
    """Orientations 0 and 2 to 5 may be chosen, of which 0 alone has a cell."""
    game = Packing(
        1, (1, 1, 3), [[1, 1, 2], [1, 1, 1]], mask_orientations=False, auto_reset=False,
        orientations=(0, 2, 3, 4, 5), backend=backend,
    )  # fmt: skip
    with pytest.raises(ValueError, match="choose where the mask is true"):
        game.place(torch.tensor([wrong[0]]), torch.tensor([wrong[1]]))
    assert game.place(torch.tensor([5]), torch.tensor([0])).done.all()


def test_the_least_of_real_keys_is_legal_and_the_nearest_cell_counts_x_and_y() -> None:
    mask = torch.zeros(1, 6, 3, 4, dtype=torch.bool)
    mask[0, 2, 1, 3] = mask[0, 4, 2, 0] = True
    key = torch.zeros(1, 6, 3, 4)
    key[0, 2, 1, 3], key[0, 4, 2, 0] = 8.0, 7.0
    orientation, cell = Moves(mask).least(key)
    assert (orientation.tolist(), cell.tolist()) == ([4], [8])
    floor = Floor(3, 4)
    corners = np.array([floor.cell(0, 3), floor.cell(1, 0), floor.cell(2, 2)])
    assert floor.nearest(floor.cell(0, 1), corners) == floor.cell(1, 0)
    assert floor.nearest(floor.cell(1, 2), corners) == floor.cell(2, 2)


def test_a_branch_that_is_reset_leaves_the_games_it_came_from() -> None:
    game = Packing(4, auto_reset=False)
    first = torch.zeros(4, dtype=torch.int64)
    game.place(first, game.mask[:, 0].flatten(1).int().argmax(1))
    for chosen in ([0, 2], [3, 1, 1, 0]):
        branch = game.branch(torch.tensor(chosen))
        branch.reset(seed=5)
        assert branch.bins.count.tolist() == [0] * len(chosen)
        assert branch.episode.tolist() == list(range(len(chosen)))
        assert game.bins.count.tolist() == [1] * 4


def test_options_may_be_numpy_numbers() -> None:
    game = Packing(1, orientations=np.array([4, 0]), max_items=np.int64(3))
    assert (game.spec.orientations, game.spec.max_items) == ((0, 4), 3)
    assert type(game.spec.max_items) is int
    with pytest.raises(ValueError, match="need one or more of 0"):
        Packing(1, orientations=np.array([True, False]))


def test_an_unknown_option_is_named_with_the_nearest_one() -> None:
    with pytest.raises(TypeError, match=r"unexpected option 'zzz'\. Options: bin, "):
        Packing(1, zzz=1)
    with pytest.raises(TypeError, match="unexpected option 'margn'; did you mean 'margin'"):
        Packing(1, margn=1)
    with pytest.raises(ValueError, match="option 'size' is now called 'bin'"):
        Packing(1, size=(5, 5, 5))


def test_a_spec_and_keyword_options_make_the_same_game() -> None:
    spec = GameSpec(bin=(6, 7, 8), rule="lbcp", margin=0.5, orientations=[1, 0])
    assert spec.orientations == (0, 1)
    assert str(spec) == "bin 6 x 7 x 8, rule lbcp, margin 0.5, orientations 0 1"
    game = Packing(2, (6, 7, 8), rule="lbcp", margin=0.5, orientations=(0, 1))
    assert game.spec == spec == Packing(2, spec=spec).spec
    assert GameSpec.of(spec.to_dict() | {"items": "rs"}) == spec
    assert Packing(2, spec=spec, margin=0.0).spec.margin == 0


def test_options_take_numpy_numbers_and_become_plain() -> None:
    spec = GameSpec(
        orientations=np.array([2, 0]), max_items=np.int64(3), mask_orientations=np.bool_(True)
    )
    assert (spec.orientations, spec.max_items, spec.mask_orientations) == ((0, 2), 3, True)
    assert all(type(o) is int for o in (*spec.orientations, spec.max_items))
    with pytest.raises(ValueError, match="orientations"):
        GameSpec(orientations=[True])


def test_a_bin_holds_at_most_max_items() -> None:
    game, policy = Packing(8, max_items=3, auto_reset=False, seed=1), make_policy("dblf")
    counts = []
    while game.alive.any():
        counts.append(game.place(*policy(game)).placed)
    assert torch.stack(counts).amax(0).tolist() == [3] * 8
    assert game.bins.boxes.shape[1] == 3
    again = Packing(8, max_items=3, seed=1)
    for _ in range(7):
        outcome = again.place(*policy(again))
        assert (outcome.done == (outcome.placed == 3)).all()


def test_a_state_can_be_put_into_another_game() -> None:
    game, policy = Packing(6, seed=2), make_policy("random", 1)
    for _ in range(8):
        game.place(*policy(game))
    other = Packing(3, seed=2)
    chosen = torch.tensor([5, 0, 3])
    other.set_state(game.state.select(chosen))
    assert torch.equal(other.mask, game.mask[chosen])
    turn = other.turn
    other.place(*make_policy("dblf")(other))
    assert other.turn != turn
    assert game.bins.count[5] + 1 == other.bins.count[0] or other.t[0] == 0


def test_a_state_of_other_games_is_refused_and_changes_nothing() -> None:
    game, other = Packing(2, seed=1), Packing(3, seed=1)
    state = game.state_dict()
    with pytest.raises(ValueError, match=r"another game: bins\.heightmap is \[3, 10, 10\]"):
        game.load_state_dict(other.state_dict())
    with pytest.raises(ValueError, match="needs the items of this game"):
        game.load_state_dict(Packing(2, items="cut1").state_dict())
    assert all(torch.equal(value, state[name]) for name, value in game.state_dict().items())


def test_a_state_is_copied_and_one_of_other_games_is_refused() -> None:
    game, other = Packing(2, seed=1), Packing(2, seed=2)
    heightmap = game.bins.heightmap.clone()
    other.set_state(game.state)
    other.place(*make_policy("dblf")(other))
    assert torch.equal(game.bins.heightmap, heightmap)
    with pytest.raises(ValueError, match="heightmap is"):
        Packing(3).set_state(game.state)
    upright = Packing(2, items={"items": [[2, 3, 4]], "upright": [True]})
    with pytest.raises(ValueError, match=r"has no items\.orientations"):
        game.set_state(upright.state)
