"""Print every setting at its default, with comments: ``python -m marl_pack.config``."""

from marl_pack.config.defaults import default_yaml

if __name__ == "__main__":
    print(default_yaml(), end="")
