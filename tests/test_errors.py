"""Errors of one rank, as all ranks see them."""

import pytest
from mpi4py import MPI

from signorini_cr.errors import InputError, on_root
from signorini_cr.memory import ran_out_of_memory


def test_the_end_of_memory_on_one_rank_is_told_as_such_on_all() -> None:
    def without_room() -> None:
        raise MemoryError("Unable to allocate 8 GiB")

    with pytest.raises((MemoryError, RuntimeError)) as caught:
        on_root(MPI.COMM_WORLD, without_room)
    assert ran_out_of_memory(caught.value)


def test_mistakes_have_the_same_words_on_all_ranks() -> None:
    def refused() -> None:
        raise InputError("size is 0; it must be above 0")

    with pytest.raises(InputError, match=r"^size is 0; it must be above 0$"):
        on_root(MPI.COMM_WORLD, refused)
    with pytest.raises((ZeroDivisionError, RuntimeError)) as caught:
        on_root(MPI.COMM_WORLD, lambda: 1 / 0)
    assert not ran_out_of_memory(caught.value)
