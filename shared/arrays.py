"""Types of arrays, as annotations name them."""

from types import UnionType
from typing import Any, Union, get_args, get_origin

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Field = NDArray[np.float32]
Ints = NDArray[np.int64]
Numbers = NDArray[np.int32]
Flags = NDArray[np.bool_]


def number_type(kind: Any) -> Any:
    """Type of the numbers of an annotated array, which may be absent."""
    if get_origin(kind) in (Union, UnionType):
        kind = get_args(kind)[0]
    *_, dtype = get_args(kind)  # of NDArray, or before NumPy 2.5 of what that stood for
    return (get_args(dtype) or (dtype,))[0]
