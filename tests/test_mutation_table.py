"""The records of mutations follow the code: each has one place, and tests that exist."""

from pathlib import Path

import pytest
from mutation_table import MUTATIONS, PACKAGE, Mutation

TESTS = Path(__file__).parent


@pytest.mark.parametrize("mutation", MUTATIONS, ids=lambda mutation: mutation.name)
def test_a_mutation_has_one_place_in_the_code_and_tests_that_exist(mutation: Mutation) -> None:
    code = (TESTS.parent / PACKAGE / mutation.file).read_text()
    assert code.count(mutation.old) == 1, "the record needs to follow the code"
    assert mutation.new != mutation.old
    assert mutation.tests
    for test in mutation.tests:
        file, _, name = test.partition("::")
        assert f"def {name}(" in (TESTS / file).read_text() or not name


def test_mutations_have_names_of_their_own() -> None:
    assert len({mutation.name for mutation in MUTATIONS}) == len(MUTATIONS)
