"""Find and open the files of other programs, limit what they claim, and validate their JSON."""

import json
import os
import re
import stat
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, BinaryIO, ClassVar, TypeVar, get_args
from urllib.parse import unquote

import pydantic
from pydantic import AllowInfNan, BeforeValidator, Field, Strict

from cvtgs.errors import (
    FileFormatError,
    InputError,
    InputNotFoundError,
    check_path,
    input_errors,
)
from cvtgs.text import shown

_POINTER = b"version https://git-lfs."  # replaces a large file in a clone without Git LFS
_ITERATION = re.compile(r"iteration_(\d{1,18})")
_STEP = re.compile(r"step-(\d{1,18})\.ckpt")
_GSPLAT_STEP = re.compile(r"ckpt_(\d+)_rank0\.pt")
FREE_BYTES = 1 << 26  # a scene of at most this many bytes in memory may come from any file
MOST_EXPANSION = 64  # else, it may take this many times the bytes of its file; real ones take 4-13
MOST_JSON_BYTES = 1 << 26  # a larger .gltf has its buffers inside
_STREAMED = ("**/*.webp", "**/*.png", "**/*.sog", "**/meta.json")  # files of a lod-meta.json
LONGEST_NAME = 255  # characters that file systems allow in a name
_FLOATS = 11  # numbers of a Gaussian without SH coefficients
_MOST_WHOLE = 1 << 53  # whole numbers up to here are the same in every JSON parser


@contextmanager
def open_input(path: Path) -> Iterator[BinaryIO]:
    """Open a regular file; system errors, also on reading, become input errors of cvtgs."""
    with input_errors(path):
        try:
            mode = path.stat().st_mode
        except ValueError as error:  # a null byte, or a character that the system cannot encode
            name = shown(str(path))
            raise InputNotFoundError(f"{name}: must have the name of a file: {error}.") from error
        if not stat.S_ISREG(mode):  # opening a pipe would wait for ever
            raise _not_regular(path)
        with path.open("rb") as file:
            if file.peek(len(_POINTER)).startswith(_POINTER):
                raise FileFormatError(
                    f"{path}: must be the file itself, found a Git LFS pointer; run: git lfs pull."
                )
            yield file


def _not_regular(path: Path) -> InputError:
    kind = "directory" if is_folder(path) else "device or a pipe"
    return InputError(f"{path}: must be a regular file, found a {kind}.")


def is_file(path: Path) -> bool:
    """Return whether a file exists; False if its folder is not readable."""
    return os.path.isfile(path)  # noqa: PTH113 (Path.is_file raises without permission)


def is_folder(path: Path) -> bool:
    """Return whether a folder exists; False if its parent is not readable or the name too long."""
    return os.path.isdir(path)  # noqa: PTH112 (Path.is_dir raises for both)


def scene_file(path: str | os.PathLike[str]) -> Path:
    """Find the file that holds the scene of a folder.

    These are tried in this order:

    - ``point_cloud/iteration_*/point_cloud.ply``, the largest iteration: a model of INRIA's code;
    - ``nerfstudio_models/step-*.ckpt`` or ``step-*.ckpt``, the largest step: a run of Splatfacto;
    - ``ckpts/ckpt_*_rank0.pt`` or ``ckpt_*_rank0.pt``, the largest step: a run of gsplat's trainer;
    - ``point_cloud.ply``;
    - ``lod-meta.json``: a streamed SOG;
    - ``meta.json``: an unbundled SOG.

    Args:
        path: A folder, or a file, which is returned as it is.

    Returns:
        The file.

    Raises:
        InputError: The folder has none of these, or cannot be read.
        InvalidArgumentError: It is no path.

    Example:
        >>> scene_file("scene.ply").name
        'scene.ply'
    """
    check_path(path)
    folder = Path(path)
    if not is_folder(folder):
        return folder
    with input_errors(folder):
        found = next(filter(is_file, _scenes(folder)), None)
    if found is None:
        raise InputError(
            f"{folder}: must be a file or the folder of a trained model, found a directory "
            f"without point_cloud/iteration_*/point_cloud.ply, step-*.ckpt, ckpt_*_rank0.pt, "
            f"point_cloud.ply, lod-meta.json or meta.json."
        )
    return found


def scene_size(path: str | os.PathLike[str]) -> int:
    """Return the size of a scene on the disk.

    Args:
        path: A file, or a folder that :func:`scene_file` finds a scene in.

    Returns:
        Bytes of its file; for an unbundled SOG or a ``.gltf``, also those of the files that it
        names, and for a streamed SOG those of all SOGs and images in its folder.

    Raises:
        InputError: There is no such file, or the folder holds no scene or cannot be read.

    Example:
        >>> import tempfile
        >>> with tempfile.NamedTemporaryFile(suffix=".splat") as file:
        ...     scene_size(file.name)
        0
    """
    file = scene_file(path)
    with input_errors(file):
        parts = _parts_of(file)
        if not is_file(file):  # also a name that no file can have
            raise _not_regular(file) if os.path.exists(file) else FileNotFoundError  # noqa: PTH110
        return sum(part.stat().st_size for part in (file, *parts))


def _parts_of(file: Path) -> list[Path]:
    """Return the other files of a scene of several files, each once."""
    if file.name == "lod-meta.json":
        return [part for pattern in _STREAMED for part in file.parent.glob(pattern)]
    is_gltf = file.suffix.lower() == ".gltf"
    if not (is_gltf or file.name == "meta.json") or not is_file(file):
        return []
    if file.stat().st_size >= MOST_JSON_BYTES:
        return []
    with suppress(FileFormatError, AttributeError, KeyError, TypeError):  # a damaged file
        document = parse_json(file.read_bytes(), file)
        if is_gltf:
            buffers = document.get("buffers", [])
            names = [unquote(buffer["uri"]) for buffer in buffers if "uri" in buffer]
        else:
            parts = [part for part in document.values() if isinstance(part, dict)]
            names = [name for part in parts for name in part.get("files", ())]
        places = {file.parent / name for name in names if is_within(name)}
        return [place for place in places if is_file(place)]
    return []


def _scenes(folder: Path) -> Iterator[Path]:
    """Yield where the scene of a folder may be."""
    for part in _numbered(folder / "point_cloud", _ITERATION):
        yield part / "point_cloud.ply"
    for steps in (folder / "nerfstudio_models", folder):
        yield from _numbered(steps, _STEP)
    for steps in (folder / "ckpts", folder):
        yield from _numbered(steps, _GSPLAT_STEP)
    for name in ("point_cloud.ply", "lod-meta.json", "meta.json"):
        yield folder / name


def _numbered(folder: Path, pattern: re.Pattern[str]) -> list[Path]:
    """Return the numbered entries of a folder, the largest number first."""
    if not folder.is_dir():
        return []
    matches = [(pattern.fullmatch(part.name), part) for part in folder.iterdir()]
    numbers = [(int(match[1]), part) for match, part in matches if match]
    return [part for _, part in sorted(numbers, reverse=True)]


def check_expansion(path: Path | str, *, count: int, sh_degree: int, stored: int) -> None:
    """Refuse a file that claims far more Gaussians than it can hold, before it is unpacked."""
    wanted = 4 * count * (_FLOATS + 3 * (sh_degree + 1) ** 2)
    if wanted > FREE_BYTES + MOST_EXPANSION * stored:
        raise FileFormatError(
            f"{path}: a scene must take at most {FREE_BYTES >> 20} MiB plus {MOST_EXPANSION} times "
            f"the bytes of its file, found {count:,} Gaussians that take {wanted:,} bytes in a "
            f"file of {stored:,}; if you trust the file, pass trust_sizes=True (--trust-sizes)."
        )


class Document(pydantic.BaseModel):
    """A JSON object of which some keys are read; errors quote the descriptions of fields."""

    model_config: ClassVar[pydantic.ConfigDict] = pydantic.ConfigDict(frozen=True)


Number = Annotated[float, Strict(), AllowInfNan(False), Field(description="a finite number")]
Whole = Annotated[
    int,
    Strict(),
    # 800.0 counts as 800
    BeforeValidator(lambda n: int(n) if isinstance(n, float) and n.is_integer() else n),
    Field(ge=-_MOST_WHOLE, le=_MOST_WHOLE, description="a whole number"),
]
Size = Annotated[Whole, Field(ge=0, description="a whole number of at least 0")]
Text = Annotated[str, Strict(), Field(description="a string")]
Flag = Annotated[bool, Strict(), Field(description="true or false")]
Items = Annotated[list[Any], Field(description="a list")]
Vector = Annotated[tuple[Number, Number, Number], Field(description="3 finite numbers")]
FourNumbers = Annotated[
    tuple[Number, Number, Number, Number], Field(description="4 finite numbers")
]
AnyDocument = TypeVar("AnyDocument", bound=Document)


def validated(model: type[AnyDocument], value: Any, where: str) -> AnyDocument:
    """Validate a value against a model; errors name the place, the key and the value."""
    try:
        return model.model_validate(value)
    except pydantic.ValidationError as error:
        text = _sentence(model, value, error.errors(include_url=False)[0]["loc"], where)
        raise FileFormatError(text) from error


def _sentence(model: type[Document], value: Any, keys: Sequence[int | str], where: str) -> str:
    if not isinstance(value, dict):
        return f"{where}: must be a JSON object, found {shown(value)}."
    key = str(keys[0])
    annotation = model.model_fields[key].annotation
    for part in (annotation, *get_args(annotation)):
        if isinstance(part, type) and issubclass(part, Document):
            return _sentence(part, value.get(key), keys[1:], f"{where}: {key!r}")
    schema = model.model_json_schema()["properties"][key]
    required = schema.get("description") or schema["anyOf"][0]["description"]  # X, X | None
    found = shown(value[key]) if key in value else "none"
    return f"{where}: {key!r} must be {required}, found {found}."


def is_within(name: str) -> bool:
    """Return whether a file that another one names is in its folder or below, on every system."""
    path = PurePosixPath(name)
    plain = name.isprintable() and not set(name) & set("\\:")
    return plain and path.name != "" and not path.is_absolute() and ".." not in path.parts


def read_json(path: Path) -> Any:
    """Read and parse a JSON file."""
    with open_input(path) as file:
        return parse_json(file.read(), path)


def parse_json(data: bytes, path: str | Path) -> Any:
    """Parse the bytes of a JSON file."""
    try:
        return json.loads(data.decode("utf-8-sig"))
    except (RecursionError, ValueError) as error:  # also nested too deeply, or not UTF-8
        raise FileFormatError(f"{path}: must be JSON in UTF-8, found: {error}.") from error
