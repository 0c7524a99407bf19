"""Check the arguments of public functions against the types and shapes of their signatures."""

from collections.abc import Callable, Mapping
from functools import wraps
from inspect import Parameter, signature
from types import NoneType, UnionType
from typing import Any, ParamSpec, TypeVar, get_args

from jaxtyping import jaxtyped
from torch import Tensor

from cvtgs.errors import InvalidArgumentError

P = ParamSpec("P")
Result = TypeVar("Result")

_WORDS = {"Float": "floats", "Bool": "booleans", "Int": "signed integers", "Integer": "integers"}


def checked(function: Callable[P, Result]) -> Callable[P, Result]:
    """Check the classes of arguments, and the dtypes and shapes of tensors, as annotated.

    A letter of a shape stands for one length in all arguments. Numbers and texts are left to the
    function. Nothing waits for a device.
    """
    names = [*signature(function).parameters]
    given = {name: item.annotation for name, item in signature(function).parameters.items()}
    kinds = {name: kind for name, kind in given.items() if _is_class(kind)}

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> Result:
        check_kinds(kinds, dict(zip(names, args, strict=False)) | kwargs)
        return function(*args, **kwargs)

    return call


def check_kinds(kinds: Mapping[str, Any], values: Mapping[str, object]) -> None:
    """Raise unless named values are instances of classes, or tensors of shapes, of jaxtyping."""
    sizes: dict[str, int] = {}
    with jaxtyped("context"):
        for name, value in values.items():
            kind = kinds.get(name, object)
            if not isinstance(value, kind):
                wanted = " or ".join(_in_words(one, sizes) for one in get_args(kind) or [kind])
                raise InvalidArgumentError(f"{name} must be {wanted}, found {_found(value)}.")
            if isinstance(value, Tensor):
                letters = getattr(kind, "dim_str", "").split()
                sizes |= dict(zip(letters, value.shape, strict=False))


def _is_class(annotation: object) -> bool:
    """Return whether an annotation names classes of libraries, or None, and nothing else."""
    classes = get_args(annotation) if isinstance(annotation, UnionType) else (annotation,)
    return annotation is not Parameter.empty and all(
        kind is NoneType or (isinstance(kind, type) and kind.__module__ != "builtins")
        for kind in classes
    )


def _in_words(kind: Any, sizes: Mapping[str, int]) -> str:
    if not hasattr(kind, "dim_str"):
        return "None" if kind is NoneType else f"of type {kind.__name__}"
    shape = ", ".join(str(sizes.get(letter, letter)) for letter in kind.dim_str.split())
    comma = "," if kind.dim_str and "," not in shape else ""
    return f"a tensor of {_WORDS[kind.__name__.partition('[')[0]]} of shape ({shape}{comma})"


def _found(value: object) -> str:
    if isinstance(value, Tensor):
        return f"{value.dtype} of shape {tuple(value.shape)}"
    return type(value).__name__


def check_range(values: Tensor, most: int, name: str) -> None:
    """Raise unless all values are from 0 to a number; those on other devices than CPUs pass."""
    if values.device.type == "cpu" and len(values):
        low, high = (end.item() for end in values.aminmax())
        if not (low >= 0 and high <= most):
            raise InvalidArgumentError(
                f"{name} must be between 0 and {most}, found {low} to {high}."
            )
