"""The documentation says what the code does."""

import pytest

from docs.pages import DOCS, PAGES


@pytest.mark.parametrize("name", PAGES)
def test_a_page_is_what_the_code_determines(name: str) -> None:
    page = (DOCS / name).read_text("utf-8")
    assert PAGES[name](page) == page, "run make pages"
