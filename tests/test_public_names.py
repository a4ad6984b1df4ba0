"""The public interface of the package: its names, and that importing it is fast."""

import subprocess
import sys
from pathlib import Path

import pytest
import yaml

import marl_pack


@pytest.mark.parametrize("name", marl_pack.__all__)
def test_a_public_name_is_what_its_module_defines(name: str) -> None:
    value = getattr(marl_pack, name)
    module = getattr(value, "__module__", "")
    assert not module.startswith("marl_pack") or getattr(sys.modules[module], name) is value


def test_importing_the_package_alone_loads_no_torch() -> None:
    code = "import marl_pack, sys; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="Pakcing"):
        marl_pack.Pakcing  # type: ignore[attr-defined]  # noqa: B018


def test_the_citation_names_the_version_of_the_package() -> None:
    citation = yaml.safe_load((Path(__file__).parent.parent / "CITATION.cff").read_text("utf-8"))
    assert citation["version"] == marl_pack.__version__
