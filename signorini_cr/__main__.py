"""``python3 -m signorini_cr`` is the command ``signorini-cr``."""

import signal
import sys

# Until there is something to be told of, Ctrl-C ends the process without a word
if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, signal.SIG_DFL)

from .app.cli import main

if __name__ == "__main__":
    sys.exit(main())
