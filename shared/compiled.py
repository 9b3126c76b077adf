"""Named tuples of arrays handed to compiled code once.

Numba checks and unpacks every array of an argument on every call: some 0.1 µs each, a tenth of a
query for the sixty arrays it needs.  Inside compiled code a tuple travels array by array from one
function to the next, which takes longer to compile.  A ``Bound`` value is one pointer for both.
"""

import hashlib
import inspect
import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, TypeVar, get_args, get_type_hints

import numpy as np
from numba import njit, types
from numba.core import imputils
from numba.experimental import structref
from numba.extending import intrinsic, overload, overload_method

from palpate.shared.arrays import number_type

T = TypeVar("T")


@structref.register
class _BoundType(types.StructRef):
    """Type of a bound named tuple: its fields' types and the tuple's class."""

    def __init__(self, fields, kind):
        self.instance_class = kind
        super().__init__(fields)
        # tuples of two classes with the same fields are two types; the name is in every symbol
        fields_too = hashlib.sha256(repr(self._fields).encode()).hexdigest()[:16]
        types.Type.__init__(self, f"{kind.__module__}.{kind.__qualname__}({fields_too})")

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


_METHODS: dict[str, dict[type, Callable[..., Any]]] = {}
"""Of the classes of named tuples that compiled code knows, by their names."""


def methods(**options: bool) -> Callable[[type[T]], type[T]]:
    """Let compiled code call the methods of a class of named tuples, bound or not.

    Methods of one name have the same arguments in every class, and no field of a named tuple that
    is not bound has such a name.  Which one runs is known when the caller is compiled, so a method
    that does nothing costs nothing.

    Parameters
    ----------
    options : bool
        Of the compiler.
    """

    def register(kind: type[T]) -> type[T]:
        for name, method in list(vars(kind).items()):
            if inspect.isfunction(method) and not name.startswith("_"):
                if name not in _METHODS:
                    _overload(name, method, options)
                _METHODS.setdefault(name, {})[kind] = method
        return kind

    return register


def _overload(name: str, method: Callable[..., Any], options: Mapping[str, bool]) -> None:
    def choose(self: Any, *args: types.Type) -> Callable[..., Any] | None:
        return _METHODS[name].get(self.instance_class)

    choose.__signature__ = inspect.signature(method)  # type: ignore[attr-defined]
    how: Any = {"jit_options": {"error_model": "numpy", **options}}
    for kind in (types.BaseNamedTuple, _BoundType):
        overload_method(kind, name, **how)(choose)


def room(kind: type[T], **sizes: int) -> T:
    """Zeros for a named tuple of arrays, each annotated with its shape, and of such named tuples.

    A shape is numbers and names of ``sizes``, or products of them: ``"slots, r, 9 c"``.
    """
    arrays = []
    for hint in get_type_hints(kind, include_extras=True).values():
        if hasattr(hint, "_fields"):
            arrays.append(room(hint, **sizes))
        else:
            array, text = get_args(hint)
            product = [
                math.prod(int(f) if f.isdigit() else sizes[f] for f in axis.split())
                for axis in text.split(",")
            ]
            arrays.append(np.zeros(product, number_type(array)))
    return kind(*arrays)
