"""Run any command: ``python -m marl_pack COMMAND`` is ``marl-pack COMMAND``."""

import sys

from marl_pack.cli import main

if __name__ == "__main__":
    sys.exit(main(program="python -m marl_pack"))
