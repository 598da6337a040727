"""python -m overfly: the command line."""

import sys

from overfly.cli import main

sys.exit(main())
