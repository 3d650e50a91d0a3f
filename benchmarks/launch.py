"""Processes of their own for what a benchmark measures; nothing here starts MPI."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from typing import Any


def launched(*arguments: str, ranks: int | None = None, **environment: str) -> Any:
    """Start the running script anew.

    Args:
        arguments: Its command line.
        ranks: With mpirun and so many processes; without mpirun if left out.
        environment: What is added to the variables of this process.

    Returns:
        What the last line that it printed says, as JSON.
    """
    command = [] if ranks is None else ["mpirun", "-n", str(ranks)]
    result = subprocess.run(
        [*command, sys.executable, sys.argv[0], *arguments],
        stdout=subprocess.PIPE,
        check=True,
        text=True,
        env={**os.environ, **environment},
    )
    return json.loads(result.stdout.splitlines()[-1])
