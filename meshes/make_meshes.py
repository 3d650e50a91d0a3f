"""Make signorini.msh (format 4.1) and signorini-2.2.msh: the upper half of the unit disk.

This is what a mesh needs to be read by signorini_cr: physical curves named contact, dirichlet
and, if there are any, neumann; and a physical surface, since gmsh saves only what has a group.
"""

import sys
from pathlib import Path

import gmsh

SIZE = 0.25


def main(folder: Path) -> None:
    """Write both files into a folder."""
    gmsh.initialize(argv=[], readConfigFiles=False, interruptible=False)
    gmsh.option.setNumber("General.Terminal", 0)
    gmsh.model.add("half disk")
    geo = gmsh.model.geo
    left, middle, right, top = (
        geo.addPoint(x, y, 0, SIZE) for x, y in ((-1, 0), (0, 0), (1, 0), (0, 1))
    )
    floor = [geo.addLine(left, middle), geo.addLine(middle, right)]
    arc = [geo.addCircleArc(right, middle, top), geo.addCircleArc(top, middle, left)]
    disk = geo.addPlaneSurface([geo.addCurveLoop(floor + arc)])
    geo.synchronize()

    gmsh.model.addPhysicalGroup(1, floor, name="contact")
    gmsh.model.addPhysicalGroup(1, arc, name="dirichlet")
    gmsh.model.addPhysicalGroup(2, [disk], name="domain")

    gmsh.model.mesh.generate(2)
    for version, name in ((4.1, "signorini.msh"), (2.2, "signorini-2.2.msh")):
        gmsh.option.setNumber("Mesh.MshFileVersion", version)
        gmsh.write(str(folder / name))
    gmsh.finalize()


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent)
