"""Exit with 0 where this Python can run signorini_cr: DOLFINx, real petsc4py, gmsh, SciPy.

Prints the folders Python imports from, one a line: as long as none of them changes, neither does
the answer.
"""

import contextlib
import importlib.util
import os
import sys

for folder in sys.path[1:]:
    if os.path.isdir(folder):
        print(folder)
sys.stdout.flush()

if sys.version_info < (3, 12):  # noqa: UP036 (the active Python may be any)
    sys.exit(1)
if not all(importlib.util.find_spec(name) for name in ("dolfinx", "petsc4py", "gmsh", "scipy")):
    sys.exit(1)

try:
    with contextlib.suppress(ModuleNotFoundError):
        import dolfinx_solver  # noqa: F401 (the wheels' DOLFINx wants it first)
    import dolfinx
    import dolfinx.fem.petsc
    import gmsh  # noqa: F401
    import numpy as np
    from petsc4py import PETSc
except Exception as error:
    sys.exit(f"container/run: {sys.executable} has DOLFINx, but cannot load it: {error}")

version = tuple(int(part) for part in dolfinx.__version__.split(".")[:2])
if version < (0, 9) or PETSc.ScalarType is not np.float64:
    sys.exit(1)
