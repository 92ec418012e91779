"""The limit of BLAS to one thread."""

import threading

import numpy as np
import pytest
from threadpoolctl import threadpool_info

from vertax._base.blas import one_blas_thread


def blas_threads():
    np.linalg.norm(np.ones((2, 2)) @ np.ones((2, 2)))  # loads the library
    numbers = {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}
    if not numbers:
        pytest.skip("NumPy has a BLAS that threadpoolctl does not know")
    return numbers


def test_the_limit_ends_with_the_last_of_several_calls():
    before = blas_threads()
    inside, leave = threading.Event(), threading.Event()

    def other():
        with one_blas_thread():
            inside.set()
            leave.wait(10)

    thread = threading.Thread(target=other)
    with one_blas_thread():
        assert blas_threads() == {1}
        thread.start()
        assert inside.wait(10)
    assert blas_threads() == {1}  # the other call goes on
    leave.set()
    thread.join()
    assert blas_threads() == before


def test_the_limit_ends_with_an_error_of_a_decorated_function():
    before = blas_threads()
    numbers = []

    @one_blas_thread()
    def fail():
        numbers.append(blas_threads())
        raise ValueError

    for _ in range(2):
        with pytest.raises(ValueError):  # noqa: PT011
            fail()
    assert numbers == [{1}, {1}]
    assert blas_threads() == before
