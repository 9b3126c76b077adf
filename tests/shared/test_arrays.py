from typing import Any, Generic, TypeVar

import numpy as np
import pytest

from palpate.shared.arrays import Array, Flags, Numbers, number_type

T = TypeVar("T")


class Alias(Generic[T]):
    """What ``NDArray`` is from NumPy 2.5 on."""


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        (Array, np.float64),
        (Numbers, np.int32),
        (Flags | None, np.bool_),
        (Alias[np.float32], np.float32),
        (Alias[np.float32] | None, np.float32),
        (np.ndarray[tuple[Any, ...], np.dtype[np.int16]], np.int16),
    ],
)
def test_the_numbers_of_an_annotated_array_have_a_type_in_every_numpy(kind, expected):
    assert number_type(kind) is expected
