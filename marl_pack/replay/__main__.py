"""Run the command ``marl-pack replay`` as ``python -m marl_pack.replay``."""

import sys

from marl_pack.replay.command import main

sys.exit(main())
