"""Values in ascending lists, against Python's own."""

import numpy as np
import pytest

from signorini_cr.arrays import found_in

pytestmark = pytest.mark.serial


@pytest.mark.parametrize("ordered", [[], [4], [-3, 0, 2, 7], list(range(-4, 9))])
@pytest.mark.parametrize("kind", [np.int32, np.int64, np.float64, np.complex128])
def test_values_are_found_at_their_places_and_no_others(ordered, kind):
    wanted = np.arange(-6, 12).reshape(3, 6)
    place, there = found_in(np.array(ordered, dtype=kind), wanted.astype(kind))
    assert place.shape == there.shape == wanted.shape
    assert there.ravel().tolist() == [value in ordered for value in wanted.ravel()]
    assert [ordered[i] for i in place[there]] == wanted[there].tolist()
    assert (place >= 0).all() and (place < max(len(ordered), 1)).all()


def test_nothing_is_wanted():
    for ordered in ([], [1, 2]):
        place, there = found_in(np.array(ordered, dtype=np.int64), np.empty((0, 3), dtype=np.int64))
        assert place.shape == there.shape == (0, 3)
