"""The demos of the certificate and of adaptive meshes, and the picture of where the error sits."""

import pytest
from test_demos import DEMOS, is_picture, run

from signorini_cr import InputError, exact, solve
from signorini_cr.output.errorplot import plot_error

pytestmark = pytest.mark.slow


@pytest.mark.serial
@pytest.mark.parametrize("ranks", [1, 2])
@pytest.mark.parametrize(
    ("demo", "pictures"),
    [
        ("demo_certificate.py", ["certificate"]),
        (
            "demo_adaptive.py",
            ["adaptive-l-shape-error", "adaptive-hole-mesh", "adaptive-convergence"],
        ),
    ],
)
def test_demo(demo, pictures, ranks, tmp_path):
    result = run(ranks, DEMOS / demo, tmp_path, levels=3)
    assert result.returncode == 0, result.stdout[-1000:] + result.stderr[-4000:]
    for name in pictures:
        assert is_picture(tmp_path / f"{name}.png")


def test_picture_of_the_error(shared_tmp_path):
    domain = exact.S1.structured(6)
    plot_error(solve(exact.S1.problem, domain), shared_tmp_path / "error.png", "S1")
    assert is_picture(shared_tmp_path / "error.png")
    with pytest.raises(InputError, match="no bound to draw"):
        plot_error(solve(exact.S1.problem, domain, "P1"), shared_tmp_path / "none.png")
