"""Arrays handed to compiled code once.

Numba checks and unpacks every array of an argument on every call: some 0.1 µs each, a tenth of a
query for the sixty arrays it needs.  A ``Bound`` value carries a named tuple of them across in one.
"""

from numba import njit, types
from numba.experimental import structref


@structref.register
class _BoundType(types.StructRef):
    def preprocess_fields(self, fields):
        """Drop literal types: they would compile a kernel anew for every value."""
        return tuple((name, types.unliteral(kind)) for name, kind in fields)


class Bound(structref.StructRefProxy):
    """A named tuple of arrays, ``content`` to compiled code; made by ``bind``."""


structref.define_proxy(Bound, _BoundType, ["content"])


@njit(cache=True)
def bind(content):
    """Bind a named tuple, which may nest others, to a value of one machine word."""
    return Bound(content)
