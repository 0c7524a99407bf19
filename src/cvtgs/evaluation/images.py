"""8-bit images: encoding, resizing, colour maps of errors, and photographs of cameras."""

import io
import os
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from cvtgs.cameras import Cameras
from cvtgs.checks import checked
from cvtgs.errors import (
    FileFormatError,
    InputError,
    InputNotFoundError,
    InvalidArgumentError,
    reason_of,
)
from cvtgs.io.files import is_folder
from cvtgs.text import shown

Encoding = Literal["png", "webp"]

ERROR_SCALE = 0.3  # difference from which on the brightest colour is used

_PIXEL_ASPECT = 0.02  # difference of the focal lengths of a camera that may be its own

# Ten steps of "magma" (van der Walt and Smith 2015, CC0), which is perceptually uniform.
_MAGMA = bytes.fromhex("000004 180f3e 451077 721f81 9f2f7f cd4071 f1605d fd9567 fec98d fcfdbf")

ALPHA_SCALE = 0.2  # absolute difference of alpha from which on the brightest colours are used

# Warm where more of the background shows through, black where equal, cold where less shows.
_ALPHA = bytes.fromhex("fff6cd fab242 be5216 5c210c 000004 0e265c 1c54ac 4ea5f0 d6f0ff")

SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp")
_OTHER_SUFFIXES = (".avif", ".dng", ".exr", ".gif", ".heic", ".heif")  # of cameras' originals


def _css_gradient(colors: bytes) -> str:
    stops = (f"rgb({r} {g} {b})" for r, g, b in zip(*[iter(colors)] * 3, strict=True))
    return f"linear-gradient(90deg, {', '.join(stops)})"


CSS_GRADIENT, CSS_ALPHA_GRADIENT = _css_gradient(_MAGMA), _css_gradient(_ALPHA)


def as_bytes(values: Float[Tensor, "h w *c"]) -> UInt8[np.ndarray, "h w *c"]:
    """Round colours or accumulated alpha to 8 bits."""
    rounded = (values.detach().clamp(0, 1) * 255).round().to(torch.uint8)
    array: UInt8[np.ndarray, "h w *c"] = rounded.cpu().numpy()
    return array


def encode(image: UInt8[np.ndarray, "h w 3"], encoding: Encoding, *, quality: int = 82) -> bytes:
    """Encode an image."""
    from PIL import Image  # noqa: PLC0415 (takes time to load)

    file = io.BytesIO()
    Image.fromarray(image).save(file, format=encoding, quality=quality)  # PNG ignores it
    return file.getvalue()


def resized(image: UInt8[np.ndarray, "h w 3"], size: tuple[int, int]) -> np.ndarray:
    """Resize an image to a width and height with a Lanczos filter."""
    from PIL import Image  # noqa: PLC0415

    if (image.shape[1], image.shape[0]) == size:
        return image
    return np.asarray(Image.fromarray(image).resize(size, Image.Resampling.LANCZOS))


def read_image(
    path: Path, size: tuple[int, int], background: tuple[float, float, float]
) -> Float[np.ndarray, "h w 3"]:
    """Read an image, resize it to a width and height, and composite it over a background."""
    from PIL import Image  # noqa: PLC0415

    with _opened(path), Image.open(path) as file:
        image: Image.Image = file
        mode, kind = file.mode, file.format
        if mode.startswith("I"):  # grey of 16 bits, which convert would clip at 255
            values = np.asarray(file, dtype=np.float32)
            grey = (values * (255 / 65535)).round().clip(0, 255)
            shown = np.where(values == file.info.get("transparency", -1), 0, 255)
            image = Image.fromarray(np.stack([grey, shown], axis=2).astype(np.uint8))  # LA
        whole = image.convert("RGBA")
    if mode == "F" or (mode == "I" and kind != "PNG"):  # whose white is unknown
        found = "floats" if mode == "F" else "integers of 32 bits"
        raise FileFormatError(f"{path}: must have 8 or 16 bits a channel, found {found}.")
    pixels = np.asarray(whole.resize(size, Image.Resampling.LANCZOS), dtype=np.float32) / 255
    alpha = pixels[:, :, 3:]
    colors = pixels[:, :, :3] * alpha + np.asarray(background, dtype=np.float32) * (1 - alpha)
    return colors.astype(np.float32)


@contextmanager
def _opened(path: Path) -> Iterator[None]:
    """Convert errors on reading an image to cvtgs errors."""
    from PIL import Image, UnidentifiedImageError  # noqa: PLC0415

    try:
        yield
    except Image.DecompressionBombError as error:
        raise FileFormatError(f"{path}: must have fewer pixels; {error}") from error
    except UnidentifiedImageError as error:
        raise FileFormatError(f"{path}: must be an image, found something else.") from error
    except (OSError, SyntaxError, ValueError) as error:
        if isinstance(error, OSError) and error.errno is not None:
            reason = reason_of(error)
            raise InputError(f"{path}: the file must be readable, found: {reason}.") from error
        raise FileFormatError(f"{path}: must be a whole image, found a damaged one.") from error


def error_map(
    one: UInt8[np.ndarray, "h w 3"], other: UInt8[np.ndarray, "h w 3"]
) -> UInt8[np.ndarray, "h w 3"]:
    """Map the root mean square difference over the channels to colours."""
    difference = (one.astype(np.float32) - other.astype(np.float32)) / 255
    return error_colors(np.sqrt(np.square(difference).mean(axis=2)))


def error_colors(differences: Float[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """Map differences of colour to colours."""
    return _colors_of(differences / ERROR_SCALE, _MAGMA)


def alpha_error_map(
    full: UInt8[np.ndarray, "h w"], small: UInt8[np.ndarray, "h w"]
) -> UInt8[np.ndarray, "h w 3"]:
    """Map the alpha of a simplified scene minus that of the full one to colours."""
    return alpha_colors((small.astype(np.float32) - full.astype(np.float32)) / 255)


def alpha_colors(differences: Float[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """Map differences of alpha to colours: warm below zero, cold above."""
    return _colors_of((differences / ALPHA_SCALE + 1) / 2, _ALPHA)


def _colors_of(values: Float[np.ndarray, "h w"], colors: bytes) -> UInt8[np.ndarray, "h w 3"]:
    """Map values in [0, 1] to colours by interpolation in a list of colours."""
    steps = np.frombuffer(colors, np.uint8).reshape(-1, 3)
    positions = np.linspace(0, 1, len(steps))
    channels = [np.interp(values, positions, steps[:, channel]) for channel in range(3)]
    return np.stack(channels, axis=2).round().astype(np.uint8)


@checked
def load_photographs(
    folder: str | os.PathLike[str],
    cameras: Cameras,
    *,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Float[Tensor, "c h w 3"]:
    """Read the photograph of every camera, at the cameras' size.

    The file name in the folder is the camera's name, or as many of its last parts as there are in
    the folder; the suffix may differ or be missing in the camera's name. Other files, and masks
    of another format than that of the name, are ignored; transparent pixels show the background.
    Photographs of another size are scaled to that of the cameras, in width and height
    independently.

    Memory: ``12 c h w`` bytes.

    Args:
        folder: The folder of the photographs.
        cameras: Cameras with names.
        background: Colour behind transparent pixels, in [0, 1].

    Returns:
        ``(c, h, w, 3)`` images in [0, 1], float32.

    Raises:
        InvalidArgumentError: The cameras have no names, two names match one photograph, or a name
            matches photographs of several formats, none of which is its own.
        InputNotFoundError: There is no such folder, or a camera has no photograph in it.
        InputError: A photograph cannot be read.
        FileFormatError: A photograph is no image.

    Example:
        >>> import tempfile
        >>> from cvtgs.evaluation.images import encode
        >>> cameras = Cameras(viewmats=torch.eye(4)[None], Ks=torch.eye(3)[None], width=4,
        ...                   height=2, names=("train/a",))
        >>> with tempfile.TemporaryDirectory() as images:
        ...     _ = (Path(images) / "a.png").write_bytes(encode(np.zeros((4, 8, 3), "u1"), "png"))
        ...     load_photographs(images, cameras).shape
        torch.Size([1, 2, 4, 3])
    """
    found = Photographs(folder, cameras, background=background)
    images = torch.empty(len(found), cameras.height, cameras.width, 3, dtype=torch.float32)
    for image, one in zip(images, found, strict=True):
        image.copy_(one[0])
    return images


class Photographs:
    """What :func:`load_photographs` returns, one by one, each read when it is its turn.

    Args:
        folder: The folder of the photographs.
        cameras: Cameras with names.
        background: Colour behind transparent pixels, in [0, 1].

    Raises:
        InvalidArgumentError: As for :func:`load_photographs`.
        InputNotFoundError: Likewise. What cannot be read is an error when it is its turn.
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        cameras: Cameras,
        *,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> None:
        self._paths = _find_all(Path(folder), cameras)
        self._size = (cameras.width, cameras.height)
        self._background = background

    def __len__(self) -> int:
        return len(self._paths)

    def __iter__(self) -> Iterator[Float[Tensor, "1 h w 3"]]:
        for path in self._paths:
            yield torch.from_numpy(read_image(path, self._size, self._background))[None]


@checked
def fit_cameras(cameras: Cameras, folder: str | os.PathLike[str]) -> Cameras:
    """Resize cameras to their photographs if those are smaller, as in ``images_4``.

    Args:
        cameras: Cameras with names.
        folder: The folder of the photographs, which are found as by :func:`load_photographs`.

    Returns:
        Cameras with scaled intrinsics, or the same cameras; the most frequent size is used.

    Raises:
        InvalidArgumentError: The cameras have no names, two names match one photograph, or an
            aspect ratio differs.
        InputNotFoundError: There is no such folder, or a camera has no photograph in it.
        FileFormatError: A photograph is no image.

    Example:
        >>> import tempfile
        >>> from cvtgs.evaluation.images import encode
        >>> cameras = Cameras(viewmats=torch.eye(4)[None], Ks=torch.eye(3)[None], width=16,
        ...                   height=8, names=("a",))
        >>> with tempfile.TemporaryDirectory() as images:
        ...     _ = (Path(images) / "a.png").write_bytes(encode(np.zeros((4, 8, 3), "u1"), "png"))
        ...     fit_cameras(cameras, images).width
        8
    """
    from PIL import Image  # noqa: PLC0415

    paths, sizes = _find_all(Path(folder), cameras), []
    for path in paths:
        with _opened(path), Image.open(path) as file:  # does not decode the pixels
            sizes.append(file.size)
    (width, height), _ = Counter(sizes).most_common(1)[0]
    stretches = (cameras.Ks[:, 1, 1] / cameras.Ks[:, 0, 0]).tolist()  # from a size of its own
    for path, (wide, high), stretch in zip(paths, sizes, stretches, strict=True):
        # The tolerance allows for sizes that were rounded when the photographs were scaled.
        tolerance = 1.5 * max(cameras.width, cameras.height) * max(1.0, stretch)
        wanted = wide * cameras.height
        errors = [abs(wanted - high * cameras.width * x) for x in (1.0, stretch)]
        if abs(stretch - 1) > _PIXEL_ASPECT:  # of which the camera's own pixels may have a part
            errors[1] -= _PIXEL_ASPECT * wanted
        if min(errors) > tolerance:
            raise InvalidArgumentError(
                f"{path}: photographs must have the aspect ratio of the cameras' images, "
                f"{cameras.width} x {cameras.height}, found {wide} x {high}."
            )
    return cameras.resized(width, height) if width < cameras.width else cameras


def _find_all(place: Path, cameras: Cameras) -> list[Path]:
    """Return the path of every camera's photograph."""
    if not cameras.names:
        raise InvalidArgumentError(
            "photographs are matched by the names of the cameras, but these have none."
        )
    if not is_folder(place):
        raise InputNotFoundError(f"{place}: the folder of photographs must exist, found none.")
    found = [_find(place, name) for name in cameras.names]  # names may repeat
    missing = [name for name, path in zip(cameras.names, found, strict=True) if path is None]
    if missing:
        raise InputNotFoundError(
            f"{place}: must hold a photograph of every camera; {len(missing)} of "
            f"{len(found)} cameras have none, the first is {missing[0]!r}."
        )
    paths = [path for path in found if path]
    owners: dict[Path, str] = {}
    for name, path in zip(cameras.names, paths, strict=True):
        owner = owners.setdefault(path, name)
        if owner != name:
            raise InvalidArgumentError(
                f"{place}: every camera must have its own photograph, but {owner!r} and {name!r} "
                f"both match {path.name}; give the folder that holds the folders in these names."
            )
    return paths


def _find(folder: Path, name: str) -> Path | None:
    """Look for the whole name, then for fewer of its last parts; each as it is, then by suffix."""
    whole = PurePosixPath(name.replace("\\", "/"))
    parts = [part for part in whole.parts if part not in ("/", ".", "..")]
    for first in range(len(parts)):
        exact = folder.joinpath(*parts[first:])
        if exact.suffix.lower() in SUFFIXES and exact.is_file():
            return exact
        own = _format_of(exact.suffix)
        has_suffix = own in (*map(_format_of, SUFFIXES), *_OTHER_SUFFIXES)
        base = exact.with_suffix("") if has_suffix else exact
        found: dict[str, Path] = {}
        for suffix in SUFFIXES:
            for written in (suffix, suffix.upper(), suffix.title()):
                candidate = base.with_name(base.name + written)
                if candidate.is_file():
                    found.setdefault(_format_of(suffix), candidate)
        if len(found) > 1 and own not in found:  # one may be a mask
            names = " and ".join(path.name for path in found.values())
            raise InvalidArgumentError(
                f"{folder}: must hold one photograph of camera {shown(name)}, found {names}."
            )
        if found:
            return found.get(own) or next(iter(found.values()))
    return None


def _format_of(suffix: str) -> str:
    """Return the usual suffix of an image format."""
    return {".jpeg": ".jpg", ".tiff": ".tif"}.get(suffix.lower(), suffix.lower())
