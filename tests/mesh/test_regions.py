"""Materials from polygons inside a polygon and from gmsh's physical surfaces."""

import numpy as np
import pytest
from dolfinx.mesh import compute_midpoints
from helpers import areas
from mpi4py import MPI

from signorini_cr import Domain, InputError, Polygon, read_gmsh
from signorini_cr.errors import on_root
from signorini_cr.mesh.families import structured
from signorini_cr.mesh.refinement import refine, refine_marked

COMM = MPI.COMM_WORLD
DECK = [[0, 0], [4, 0], [4, 0.3], [0, 0.3]]
SIDES = ["neumann", "dirichlet", "contact", "dirichlet"]
DUCT = Polygon([[1.2, 0.08], [2.8, 0.08], [2.8, 0.2], [1.2, 0.2]], ["neumann"] * 4)
TOP = [[-1, 0.25], [5, 0.25], [5, 0.5], [-1, 0.5]]


def of_materials(domain: Domain) -> dict[str, float]:
    """The area of each; collective."""
    size = areas(domain.mesh)
    return {
        name: COMM.allreduce(float(size[domain.materials.where(name)[: len(size)]].sum()))
        for name in domain.materials.numbers
    }


@pytest.mark.slow
def test_polygons_that_meet_in_every_way():
    """Beyond the domain, around and beside a hole, side by side, and apart from all others."""
    polygons = {
        "top": TOP,
        "left": [[0, 0], [1.2, 0], [1.2, 0.25], [0, 0.25]],
        "below": [[1.2, 0], [2, -1], [3, 0.0], [2.8, 0.08], [2.0, 0.1], [1.2, 0.08]],
        "apart": [[3.2, 0.05], [3.6, 0.05], [3.4, 0.2]],
    }
    domain = Polygon(DECK, SIDES, [DUCT], materials=polygons).mesh(0.1)
    # below: the trapezoid under the duct and the triangle beside it
    wanted = {"top": 0.2, "left": 0.3, "below": 0.08 * (1.6 + 1.8) / 2, "apart": 0.03}
    assert of_materials(domain) == pytest.approx(wanted, rel=1e-12)
    for fine, _ in (refine(domain), refine_marked(domain, domain.materials.where("top"))):
        assert of_materials(fine) == pytest.approx(wanted, rel=1e-12)


def test_cells_are_of_the_material_that_they_lie_in():
    domain = Polygon(DECK, SIDES, materials={"top": TOP}).mesh(0.2)
    cells = np.arange(domain.mesh.topology.index_map(2).size_local, dtype=np.int32)
    above = compute_midpoints(domain.mesh, 2, cells)[:, 1] > 0.25
    assert np.array_equal(domain.materials.where("top"), above)


def test_a_polygon_that_crosses_itself_or_squares_that_do_not_follow():
    with pytest.raises(InputError, match="material bow: edge 0 crosses edge 2"):
        Polygon(DECK, SIDES, materials={"bow": [[0, 0], [1, 1], [1, 0], [0, 1]]})
    with pytest.raises(InputError, match="squares do not follow"):
        structured(Polygon(DECK, SIDES, materials={"top": TOP}), 10)


@pytest.mark.parametrize("version", [2.2, 4.1])
def test_physical_surfaces(version, shared_tmp_path):
    path = shared_tmp_path / "two.msh"
    on_root(COMM, _write, path, version)
    domain = read_gmsh(path, materials=["rock"])
    assert of_materials(domain) == pytest.approx({"rock": 0.6}, rel=1e-12)
    assert domain.materials.others == ("Sand",)
    both = read_gmsh(path, materials=["Sand", "rock"])
    assert both.materials.others == ()
    assert of_materials(both) == pytest.approx({"Sand": 0.4, "rock": 0.6}, rel=1e-12)
    assert read_gmsh(path).materials.numbers == {}
    with pytest.raises(InputError, match="no physical surface with triangles is named 'soil'; the"):
        read_gmsh(path, materials=["soil"])
    if version == 4.1:  # 2.2 has no surface twice
        with pytest.raises(InputError, match="surfaces 'rock' and 'all' share"):
            read_gmsh(path, materials=["rock", "all"])


def _write(path, version):
    """The unit square, of sand up to y = 0.4, of rock above."""
    gmsh = pytest.importorskip("gmsh")
    gmsh.initialize(argv=[], readConfigFiles=False, interruptible=False)
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.option.setNumber("Mesh.MshFileVersion", version)
        geo = gmsh.model.geo
        at = [geo.addPoint(x, y, 0, 0.3) for y in (0, 0.4, 1) for x in (0, 1)]
        pairs = [(0, 1), (1, 3), (3, 2), (2, 0), (3, 5), (5, 4), (4, 2)]
        lines = [geo.addLine(at[i], at[j]) for i, j in pairs]
        sand = geo.addPlaneSurface([geo.addCurveLoop(lines[:4])])
        rock = geo.addPlaneSurface([geo.addCurveLoop([*lines[4:], -lines[2]])])
        geo.synchronize()
        gmsh.model.addPhysicalGroup(1, lines[:1], name="contact")
        gmsh.model.addPhysicalGroup(1, lines[5:6], name="dirichlet")
        gmsh.model.addPhysicalGroup(2, [sand], name="Sand")
        gmsh.model.addPhysicalGroup(2, [rock], name="rock")
        if version == 4.1:
            gmsh.model.addPhysicalGroup(2, [sand, rock], name="all")
        gmsh.model.mesh.generate(2)
        gmsh.write(str(path))
    finally:
        gmsh.finalize()
