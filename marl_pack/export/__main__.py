"""Run the command: ``python -m marl_pack.export CHECKPOINT``."""

import sys

from marl_pack.export.command import main

if __name__ == "__main__":
    sys.exit(main())
