"""A short run of the sources that no other test draws from, and of the classes of outcomes."""

from itertools import islice
from pathlib import Path

import pytest
from fuzz.program import (
    REFUSED,
    RIGHT,
    WronglyAcceptedError,
    arguments,
    attempt,
    games,
    millimetres,
    packers,
    selection,
    service,
)


def test_wrong_arguments_are_refused_in_one_line_or_right(tmp_path: Path) -> None:
    for name, case in islice(arguments(seed=2, folder=tmp_path), 400):
        outcome, detail = attempt(case)
        assert outcome in (REFUSED, RIGHT), f"{name}: {detail}"


def test_random_games_equal_plain_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MARL_PACK_CHECK", "1")
    for name, case in islice(games(seed=3, folder=tmp_path), 8):
        outcome, detail = attempt(case)
        assert outcome in (REFUSED, RIGHT), f"{name}: {detail}"


def test_random_games_with_selection_are_equal_in_both_backends(tmp_path: Path) -> None:
    for name, case in islice(selection(seed=6, folder=tmp_path), 12):
        outcome, detail = attempt(case)
        assert outcome in (REFUSED, RIGHT), f"{name}: {detail}"


def test_random_games_in_millimetres_pass_plain_checks(tmp_path: Path) -> None:
    for name, case in islice(millimetres(seed=5, folder=tmp_path), 25):
        outcome, detail = attempt(case)
        assert outcome in (REFUSED, RIGHT), f"{name}: {detail}"


def test_random_calls_of_packers_pass_plain_checks(tmp_path: Path) -> None:
    for name, case in islice(packers(seed=4, folder=tmp_path), 10):
        outcome, detail = attempt(case)
        assert outcome in (REFUSED, RIGHT), f"{name}: {detail}"


def test_random_requests_to_the_service_are_answered_right(tmp_path: Path) -> None:
    for name, case in islice(service(seed=6, folder=tmp_path), 10):
        outcome, detail = attempt(case)
        assert outcome in (REFUSED, RIGHT), f"{name}: {detail}"


@pytest.mark.parametrize(
    ("error", "outcome"),
    [
        (ValueError("one line"), REFUSED),
        (ValueError("two\nlines"), "traceback"),
        (TypeError("not an int"), "traceback"),
        (AssertionError("differs"), "wrong result"),
        (WronglyAcceptedError("bad"), "wrongly accepted"),
        (MemoryError(), "memory"),
    ],
)
def test_every_way_to_fail_has_its_class(error: BaseException, outcome: str) -> None:
    def case() -> str:
        raise error

    assert attempt(case)[0] == outcome
