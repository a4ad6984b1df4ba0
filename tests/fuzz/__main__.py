"""Run ``python -m tests.fuzz``: see :mod:`tests.fuzz.program`."""

import sys

from .program import main

sys.exit(main())
