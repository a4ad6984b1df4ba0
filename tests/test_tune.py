"""The search for weights of the linear score."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from marl_pack import tune
from marl_pack.exact.choice import LINEAR
from marl_pack.exact.features import FEATURES
from marl_pack.exact.policies import HEURISTICS, Scored, make_exact_policy, read_weights
from marl_pack.exact.spec import ExactSpec
from marl_pack.exact.streams import make_goods_stream
from marl_pack.exact.tuning import Episodes, utilizations
from marl_pack.exact.tuning import tune as search

pytest.importorskip("cmaes")

ROWS = "w_mm,d_mm,h_mm,quantity\n300,200,250,2\n400,300,200,1\n200,200,200,3\n350,250,150,1\n"
SPEC = ExactSpec(bin_mm=(800, 600, 700), rule="lbcp", max_boxes=64)


def make_stream(**options: Any) -> Any:
    rows = [[300, 200, 250], [400, 300, 200], [200, 200, 200], [350, 250, 150]]
    return make_goods_stream(rows, SPEC, **{"order": "draw", "length": 30} | options)


def test_a_search_improves_a_bad_start_and_is_repeatable() -> None:
    stream = make_stream()
    bad = -HEURISTICS["max_contact"]().weights

    def run() -> list[np.ndarray[Any, Any]]:
        episodes = Episodes(stream, 3)
        generations = search(
            lambda weights, numbers: float(utilizations(weights, stream, SPEC, numbers).mean()),
            lambda: episodes.tuning(6), start=bad, population=8, seed=1,
        )  # fmt: skip
        return [next(generations).weights for _ in range(12)]

    first, again = run(), run()
    assert all((a == b).all() for a, b in zip(first, again, strict=True))
    held = Episodes(stream, 3).measuring(30)
    before, after = (utilizations(w, stream, SPEC, held).mean() for w in (bad, first[-1]))
    assert after > before + 0.05


def test_the_episodes_that_measure_are_never_tuned_on() -> None:
    drawn = Episodes(make_stream(), 0)
    tuned = {number for _ in range(50) for number in drawn.tuning(20)}
    assert not tuned & set(drawn.measuring(1000))
    rows = [[300, 200, 250]] * 60
    given = Episodes(make_goods_stream(rows, SPEC, length=5), 0)
    tuned = {number for _ in range(50) for number in given.tuning(20)}
    assert tuned | set(given.measuring(100)) == set(range(12))
    assert not tuned & set(given.measuring(100))
    with pytest.raises(ValueError, match="two or more sequences"):
        Episodes(make_goods_stream(rows, SPEC), 0)


def test_utilizations_are_those_of_games_played_with_the_weights() -> None:
    from marl_pack import ExactPacking

    stream, weights = make_stream(), HEURISTICS["max_contact"]().weights
    shares = utilizations(weights, stream, SPEC, [4, 9])
    for share, episode in zip(shares, (4, 9), strict=True):
        game = ExactPacking(1, stream, spec=SPEC, auto_reset=False, first_episode=episode)
        while game.alive.any():
            game.place(Scored(LINEAR, weights)(game))
        assert game.bins.utilization[0] == share


def test_the_command_writes_weights_that_a_policy_reads(tmp_path: Path) -> None:
    goods, out = tmp_path / "goods.csv", tmp_path / "weights.json"
    goods.write_text(ROWS)
    words = ["--items", str(goods), "--order", "draw", "--length", "20", "--games", "4",
             "--population", "6", "--bin-mm", "800", "600", "700", "--out", str(out)]  # fmt: skip
    assert tune.main([*words, "--generations", "3"]) == 0
    report = json.loads(out.read_text())
    assert report["complete"]
    assert report["generations"] == 3
    assert report["spec"]["bin_mm"] == [800, 600, 700]
    assert set(report["weights"]) == set(FEATURES)
    kept = report["tuned" if report["tuned"]["utilization"] >= report["start"]["utilization"]
                  else "start"]  # fmt: skip
    assert 0 < kept["utilization"] < 1
    policy: Any = make_exact_policy(str(out))
    assert (policy.weights == read_weights(out)).all()
    assert tune.main([*words, "--generations", "1", "--start", str(out)]) == 0


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--out", "x.csv"], "needs a name that ends in .json"),
        (["--out", "x.json", "--minutes", "0"], "--minutes 0: needs a number > 0"),
        (["--out", "x.json", "--population", "1"], "--population"),
        (["--out", "x.json", "--start", "none.json"], "none.json"),
        (["--out", "x.json", "--order", "draw"], "needs length"),
    ],
)
def test_a_wrong_option_says_what_would_be_right(
    words: list[str], message: str, tmp_path: Path, monkeypatch: Any, capsys: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("goods.csv").write_text(ROWS)
    assert tune.main(["--items", "goods.csv", *words]) == 2
    assert message in capsys.readouterr().err
