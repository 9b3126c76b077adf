"""Named tuples of arrays handed to compiled code once.

Numba checks and unpacks every array of an argument on every call: some 0.1 µs each, a tenth of a
query for the sixty arrays it needs.  Inside compiled code a tuple travels array by array from one
function to the next, which takes longer to compile.  A ``Bound`` value is one pointer for both.
"""

import inspect
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from numba import njit, types
from numba.core import imputils
from numba.experimental import structref
from numba.extending import intrinsic, overload


@structref.register
class _BoundType(types.StructRef):
    """Type of a bound named tuple: its fields' types and the tuple's class, ``kind``."""

    def __init__(self, fields, kind):
        self.kind = kind
        super().__init__(fields)
        # tuples of two classes with the same fields are two types
        types.Type.__init__(self, f"Bound({kind.__module__}.{kind.__qualname__}){self._fields}")

    def preprocess_fields(self, fields):
        """Drop literal types: they would compile a kernel anew for every value."""
        return tuple((name, types.unliteral(kind)) for name, kind in fields)


class Bound(structref.StructRefProxy):
    """A named tuple to compiled code, by reference; made by ``bind``."""


structref.define_boxing(_BoundType, Bound)


@intrinsic
def _fill(typingctx, bound, content):
    """Write the members of a named tuple into a new ``Bound``; return that."""

    def codegen(context, builder, signature, args):
        data = structref._Utils(context, builder, bound).get_data_struct(args[0])
        for i, (name, kind) in enumerate(zip(content.fields, content.types, strict=True)):
            value = builder.extract_value(args[1], i)
            context.nrt.incref(builder, kind, value)
            setattr(data, name, value)
        return imputils.impl_ret_borrowed(context, builder, bound, args[0])

    return bound(bound, content), codegen


def _new(content):
    """Make a ``Bound`` of a named tuple that is none yet, in compiled code."""


@overload(_new)
def _new_compiled(content):
    if isinstance(content, _BoundType):
        return lambda content: content
    kind = _BoundType(zip(content.fields, content.types, strict=True), content.instance_class)

    def new(content):
        # the compiler passes the typing context
        return _fill(structref.new(kind), content)  # type: ignore[call-arg]

    return new


@njit(cache=True)
def bind_compiled(content):
    """Bind a named tuple whose nested ones are bound, in compiled code."""
    return _new(content)


def bind(content: NamedTuple) -> Any:
    """Bind a named tuple, and every one nested in it, to a value of one machine word."""
    return bind_compiled(
        type(content)(*(bind(part) if hasattr(part, "_fields") else part for part in content))
    )


def kind_of(value: types.Type) -> type | None:
    """Class of the named tuple, bound or not, that a value of this numba type is."""
    if isinstance(value, types.NamedTuple | types.NamedUniTuple):
        return value.instance_class
    return value.kind if isinstance(value, _BoundType) else None


def by_type(
    piece: Callable[..., Any], table: Mapping[type, Callable[..., Any]], **options: bool
) -> None:
    """Compile calls of ``piece`` as calls of the function for the type of their first argument.

    Parameters
    ----------
    piece : function
        Names the arguments and says what is done; never run itself.
    table : mapping of type to function
        Of the classes of named tuples, bound or not; the functions have the arguments of ``piece``,
        the first of any name.
    options : bool
        Of the compiler.
    """

    def choose(*args: types.Type) -> Callable[..., Any] | None:
        kind = kind_of(args[0])
        return None if kind is None else table.get(kind)

    jit_options: Any = {"error_model": "numpy"} | options
    choose.__signature__ = inspect.signature(next(iter(table.values())))  # type: ignore[attr-defined]
    overload(piece, jit_options=jit_options)(choose)
