"""The pages of results say what the figures in results/ say."""

import shutil
from pathlib import Path

import pytest

from benchmarks.record import RESULTS, Results
from experiments.page import PAGE, PAGES, README, readme, render


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_a_page_is_what_its_figures_and_its_text_make(page: Path) -> None:
    assert page.read_text("utf-8") == PAGES[page](), "run `make results`"


def test_the_page_has_at_most_200_lines() -> None:
    assert len(PAGE.read_text("utf-8").splitlines()) <= 200


def test_a_missing_table_is_refused_with_the_command_that_measures_it(tmp_path: Path) -> None:
    shutil.copytree(RESULTS, tmp_path, dirs_exist_ok=True)
    (tmp_path / "planning.json").unlink()
    with pytest.raises(ValueError, match=r"run `python -m experiments\.planning`$"):
        render(tmp_path)


def test_a_missing_row_is_refused_with_the_command_that_measures_it(tmp_path: Path) -> None:
    shutil.copytree(RESULTS, tmp_path, dirs_exist_ok=True)
    Results("packing", tmp_path).remove("--policy dblf --items $MARL_PACK_DATA/rs.npz")
    with pytest.raises(ValueError, match=r"no row '--policy dblf .*rs\.npz'; python -m exp"):
        render(tmp_path)


def test_the_readme_has_the_same_figures() -> None:
    page = README.read_text("utf-8")
    assert page == readme(page), "run `make results`"
