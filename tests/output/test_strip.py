"""The picture strip of a run in time: which moments, one scale, contact marked."""

import numpy as np
import pytest
from helpers import HELD_ABOVE
from mpi4py import MPI

from signorini_cr import InputError, Problem, solve
from signorini_cr.output import canvas
from signorini_cr.output.plots import drawn
from signorini_cr.output.strip import MOST_MOMENTS, chosen, moment, plot_strip

pytestmark = pytest.mark.slow

image = pytest.importorskip("matplotlib.image")
COMM = MPI.COMM_WORLD


@pytest.mark.serial
@pytest.mark.parametrize("steps", [1, 2, 5, 6, 7, 24, 1000])
def test_first_and_last_are_among_the_steps_chosen(steps):
    found = sorted(chosen(steps))
    assert found[0] == 1 and found[-1] == steps and len(found) == min(MOST_MOMENTS, steps)
    if steps > 1:
        assert np.ptp(np.diff(found)) <= 1


def test_a_strip_shows_what_touches_when(shared_tmp_path):
    """All of Γ1 first, pressed down by the load, and nothing of it then: u = 2 (1 − y²)."""
    domain = HELD_ABOVE.mesh(0.3)
    moments = [
        moment(time, solve(Problem(f=load, obstacle=-0.1, dirichlet=0.0), domain))
        for time, load in ((1.0, -4.0), (2.0, 4.0))
    ]
    path = shared_tmp_path / "strip.png"
    drawn(COMM, lambda: plot_strip(moments, path, "price in $"))
    if COMM.rank == 0:
        lengths = [
            [np.linalg.norm(np.diff(lines, axis=1), axis=-1).sum() for lines in each]
            for each in ((m.touching, m.free, m.boundary) for m in moments)
        ]
        assert np.allclose(lengths, [[1, 0, 4], [0, 1, 4]])
        # −u'' = 4 and u'(0) = 0 give 2 (1 − y²)
        assert moments[1].limits[1] == pytest.approx(2.0, rel=0.05)
        assert moments[0].limits[0] < -0.1
        red = np.array([int(canvas.RED[i : i + 2], 16) for i in (1, 3, 5)]) / 255
        pixels = np.abs(image.imread(path)[..., :3] - red).max(axis=-1) < 0.02
        half = pixels.shape[1] // 2
        # the key of colours below has some as well
        assert pixels[:-100, :half].sum() > 1000 and pixels[:-100, half:].sum() == 0
    with pytest.raises(InputError, match="one moment at least"):
        plot_strip([])


@pytest.mark.parametrize("number", [1, 4, 5, 6])
def test_a_strip_of_any_number_of_moments(number, shared_tmp_path):
    """Places in the last row may be left over."""
    domain = HELD_ABOVE.mesh(0.5)
    solution = solve(Problem(f=-4.0, obstacle=-0.1), domain)
    moments = [moment(float(k), solution) for k in range(number)]
    figure = drawn(COMM, lambda: plot_strip(moments, shared_tmp_path / f"{number}.png"))
    if COMM.rank == 0:
        *panels, bar = figure.axes
        gap = "\n" if number > 1 else " "  # three side by side are narrow
        titles = [rf"$t$ = {k}:{gap}all of $\Gamma_1$ in contact" for k in range(number)]
        assert [axes.get_title() for axes in panels] == titles
        assert "u_h" in bar.get_ylabel()
