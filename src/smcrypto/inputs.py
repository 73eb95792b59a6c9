"""What every public function does first: take any bytes-like object, refuse all that is of another type.

And what all objects that hold a secret key have in common.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NoReturn, TypeAlias

from smcrypto.errors import InvalidLength

if TYPE_CHECKING:
    # collections.abc.Buffer exists from Python 3.12 only; type checkers know it by this name in every version.
    from typing_extensions import Buffer, Self

    BytesLike: TypeAlias = Buffer
else:
    BytesLike = bytes | bytearray | memoryview

__all__ = ["BytesLike", "KeyHolder", "as_bytes", "as_exact_bytes", "require_int", "require_type"]


def as_bytes(value: BytesLike, name: str) -> bytes:
    """`value` as bytes, copied unless it is bytes already; TypeError names the argument."""
    if type(value) is bytes:
        return value
    try:
        return memoryview(value).tobytes()
    except TypeError:
        raise TypeError(f"{name} must be bytes-like, not {type(value).__name__}") from None


def as_exact_bytes(value: BytesLike, name: str, length: int) -> bytes:
    """As `as_bytes`, and InvalidLength unless it is exactly `length` bytes."""
    data = as_bytes(value, name)
    if len(data) != length:
        raise InvalidLength(f"{name} must be {length} bytes, not {len(data)}")
    return data


def require_int(value: int, name: str) -> int:
    """`value` itself; TypeError, naming the argument, unless it is an int. True and False are none."""
    if not isinstance(value, int) or isinstance(value, bool):
        raise TypeError(f"{name} must be an int, not {type(value).__name__}")
    return value


def require_type(value: object, kind: type, name: str) -> None:
    """TypeError, naming the argument, unless `value` is a `kind`."""
    if not isinstance(value, kind):
        raise TypeError(f"{name} must be a {kind.__name__}, not {type(value).__name__}")


class KeyHolder:
    """An immutable object with a secret key: its copy is itself, and it is not pickled."""

    __slots__ = ()

    def __copy__(self) -> Self:
        return self

    def __deepcopy__(self, memo: object) -> Self:
        return self

    def __reduce__(self) -> NoReturn:
        raise TypeError(f"a {type(self).__name__} is not pickled: that would write its key")
