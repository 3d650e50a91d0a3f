"""``python3 -m signorini_cr`` is the command ``signorini-cr``."""

import sys

from .app.cli import main

sys.exit(main())
