"""The solution as functions that other programs can integrate and write: are they what they say?"""

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import ufl
from dolfinx import fem, io
from dolfinx.mesh import compute_midpoints
from helpers import integral, on_a_slope, slope
from mpi4py import MPI

pytestmark = pytest.mark.ranks

WORLD = MPI.COMM_WORLD


@pytest.fixture(scope="module", params=[2, 3])
def solution(request):
    return on_a_slope(request.param)


def test_u_is_the_affine_function_with_the_cr_dofs_at_the_facets_midpoints(solution):
    u, mesh = solution.u_dg(), solution.domain.mesh
    d = mesh.topology.dim
    corners = u.x.array[u.function_space.dofmap.list]
    dofs = solution.u.x.array[solution.u.function_space.dofmap.list]
    for opposite in range(d + 1):
        means = np.delete(corners, opposite, axis=1).mean(axis=1)
        assert means == pytest.approx(dofs[:, opposite], abs=1e-14)
    # the corners are where the values belong: DOLFINx's own interpolation is the same function
    own = fem.Function(u.function_space)
    own.interpolate(solution.u)
    assert u.x.array == pytest.approx(own.x.array, abs=1e-14)
    assert integral((u - solution.u) ** 2 * ufl.dx) < 1e-25
    assert integral(ufl.inner(ufl.grad(u - solution.u), ufl.grad(u - solution.u)) * ufl.dx) < 1e-20


def test_a_conforming_solution_is_itself():
    solution = on_a_slope(2, element="P1")
    functions = solution.functions()
    # without a certificate there is neither an indicator nor a companion
    assert list(functions) == ["u", "pressure", "contact", "obstacle"]
    assert integral((functions["u"] - solution.u) ** 2 * ufl.dx) < 1e-25
    force = integral(functions["pressure"] * ufl.dx)
    # the mean of two vertices' pressures spreads the force otherwise at the ends of Γ1 only
    assert force == pytest.approx(solution.contact.force, rel=0.1)


def test_the_functions_on_the_contact_boundary_integrate_to_its_figures(solution):
    functions, contact = solution.functions(), solution.contact
    pressure, state, alpha = (functions[name] for name in ("pressure", "contact", "obstacle"))
    mesh = pressure.function_space.mesh
    d = mesh.topology.dim
    assert mesh is state.function_space.mesh and mesh is alpha.function_space.mesh
    assert d == solution.domain.mesh.topology.dim - 1
    assert mesh.topology.index_map(d).size_global == contact.number
    assert 0 < contact.number_active < contact.number
    assert integral(pressure * ufl.dx) == pytest.approx(contact.force, rel=1e-12)
    assert integral(state * ufl.dx) == pytest.approx(contact.length, rel=1e-12)
    # values stand on the facets that they are of: α is affine, its means those at the middles
    number = mesh.topology.index_map(d).size_local
    middles = compute_midpoints(mesh, d, np.arange(number, dtype=np.int32))
    assert alpha.x.array[:number] == pytest.approx(slope(middles.T), abs=1e-13)
    assert integral(abs(pressure) * (1 - state) * ufl.dx) == 0.0


def test_indicator_and_companion_are_the_certificates(solution):
    functions, certificate = solution.functions(), solution.certificate
    indicator, v, mesh = functions["indicator"], functions["companion"], solution.domain.mesh
    d = mesh.topology.dim
    cells = np.arange(mesh.topology.index_map(d).size_local, dtype=np.int32)
    assert indicator.x.array[: len(cells)] ** 2 == pytest.approx(certificate.indicators)
    # v − u_h has the norm that the certificate reports, up to the lifting
    gap = integral(ufl.inner(ufl.grad(v - solution.u), ufl.grad(v - solution.u)) * ufl.dx)
    assert np.sqrt(gap) == pytest.approx(certificate.parts["companion"], rel=1e-6)
    assert v.function_space.element.basix_element.discontinuous is False


def test_dolfinx_writes_every_function(solution, shared_tmp_path):
    """One file for what is on cells, one for Γ1, and VTX where DOLFINx has ADIOS2."""
    functions = solution.functions()
    for name, function in functions.items():
        with io.VTKFile(WORLD, shared_tmp_path / f"{name}.pvd", "w") as file:
            file.write_function(function, 0.0)
        if hasattr(io, "VTXWriter"):
            with io.VTXWriter(WORLD, shared_tmp_path / f"{name}.bp", [function]) as file:
                file.write(0.0)
    for name in ("indicator", "pressure"):
        function = functions[name]
        with io.XDMFFile(WORLD, shared_tmp_path / f"{name}.xdmf", "w") as file:
            file.write_mesh(function.function_space.mesh)
            file.write_function(function, 0.0)
    WORLD.barrier()
    # every cell has corners of its own in the file of u: nothing is joined up
    cells, points = written(shared_tmp_path, "u")
    corners = solution.domain.mesh.topology.dim + 1
    assert (cells, points) == (solution.cells, corners * solution.cells)
    assert written(shared_tmp_path, "pressure")[0] == solution.contact.number


def written(folder: Path, name: str) -> tuple[int, int]:
    """Cells in the pieces that VTKFile has written, and their corners; ghosts left out."""
    cells, points = 0, 0
    for path in folder.glob(f"{name}*.vtu"):
        piece = ElementTree.parse(path).getroot().find(".//Piece")
        ghost, connectivity = (
            np.array((piece.find(f"*/DataArray[@Name='{array}']").text or "").split(), dtype=int)
            for array in ("vtkGhostType", "connectivity")
        )
        cells += np.count_nonzero(ghost == 0)
        corners = connectivity.reshape(len(ghost), -1) if len(ghost) else connectivity
        points += len(np.unique(corners[ghost == 0]))
    return cells, points
