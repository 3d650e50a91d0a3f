"""The scalar physics: −∇·(κ∇u) + c u = f, or a form of one's own, between obstacles on Γ1."""

from __future__ import annotations

from functools import cached_property

from .data.admissible import NOT_DEFINITE, check_data
from .data.diffusion import DiffusionOnMesh
from .data.quadrature import Compiled
from .estimate.certificate import Certificate, certify
from .fem.problem import Forms
from .mesh.domain import Domain
from .vi.solved import Solved


class Diffusion(Forms):
    """The forms of a problem, its data, and the certificate; a `Physics`."""

    @cached_property
    def compiled(self) -> Compiled:
        """The data, ready for any mesh."""
        return Compiled(self)

    @property
    def galerkin(self) -> bool:
        """True if quadrature sees the same on all meshes: κ jumps between cells, if at all."""
        return self.steady and self.of_one is None

    @property
    def not_definite(self) -> str | None:
        """The message for a form of the user's own that is found not to be positive definite."""
        return NOT_DEFINITE if self.problem.form is not None else None

    def check(self, domain: Domain) -> None:
        """Refuse data for which there is no solution; collective."""
        check_data(self, domain)

    def on(self, domain: Domain) -> DiffusionOnMesh:
        """Take it to a mesh; collective."""
        return DiffusionOnMesh(self.compiled, domain)

    def certify(self, solution: Solved) -> Certificate:
        """Bound the error of a solution, or say why that can't be done; collective."""
        return certify(solution)
