"""Run the judge's commands: ``python -m marl_pack.sapien_check table1 | controls | stack``."""

import sys

from marl_pack.physics.command import main

if __name__ == "__main__":
    sys.exit(main())
