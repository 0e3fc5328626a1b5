"""`python -m sgwarp`: the command line, where its script is not on PATH."""

import sys

from sgwarp.cli import main

sys.exit(main())
