"""The settings of a training run: typed, from YAML files and the command line."""

from marl_pack.config.checks import ConfigError
from marl_pack.config.parsing import from_dict, keys, make_parser, parse
from marl_pack.config.schema import Agent, Config, Evaluation, Game, Output, Selection

__all__ = [
    "Agent",
    "Config",
    "ConfigError",
    "Evaluation",
    "Game",
    "Output",
    "Selection",
    "from_dict",
    "keys",
    "make_parser",
    "parse",
]
