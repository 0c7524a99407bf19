"""Image files and lettering; the only file that knows Pillow, and it imports it when needed."""

import io
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, UInt8

from cvtgs.errors import FileFormatError, InputError

Encoding = Literal["png", "webp"]


def encode(image: UInt8[np.ndarray, "h w 3"], encoding: Encoding, *, quality: int = 82) -> bytes:
    """Write an image to bytes."""
    from PIL import Image  # noqa: PLC0415 (loads in its time)

    settings: dict[str, Any] = {"png": {}, "webp": {"quality": quality}}[encoding]
    file = io.BytesIO()
    Image.fromarray(image).save(file, format=encoding, **settings)
    return file.getvalue()


def resized(image: UInt8[np.ndarray, "h w 3"], size: tuple[int, int]) -> np.ndarray:
    """Scale an image, smoothly in both directions."""
    from PIL import Image  # noqa: PLC0415

    if (image.shape[1], image.shape[0]) == size:
        return image
    return np.asarray(Image.fromarray(image).resize(size, Image.Resampling.LANCZOS))


def read_image(
    path: Path, size: tuple[int, int], background: tuple[float, float, float]
) -> Float[np.ndarray, "h w 3"]:
    """Read a photograph at a size."""
    from PIL import Image, UnidentifiedImageError  # noqa: PLC0415

    try:
        with Image.open(path) as file:
            whole = file.convert("RGBA")
    except UnidentifiedImageError as error:
        raise FileFormatError(f"{path}: must be an image, found something else.") from error
    except (OSError, SyntaxError, ValueError) as error:
        if isinstance(error, OSError) and error.errno is not None:
            reason = (error.strerror or str(error)).lower()
            raise InputError(f"{path}: the file must be readable, found: {reason}.") from error
        raise FileFormatError(f"{path}: must be a whole image, found a damaged one.") from error
    pixels = np.asarray(whole.resize(size, Image.Resampling.LANCZOS), dtype=np.float32) / 255
    alpha = pixels[:, :, 3:]
    colors = pixels[:, :, :3] * alpha + np.asarray(background, dtype=np.float32) * (1 - alpha)
    return colors.astype(np.float32)


def lettering(text: str, size: float) -> UInt8[np.ndarray, "h w"]:
    """Draw a line of text."""
    from PIL import Image, ImageDraw, ImageFont  # noqa: PLC0415

    font = ImageFont.load_default(size)
    left, _, right, _ = font.getbbox(text)
    height = round(1.35 * size)
    canvas = Image.new("L", (max(1, round(right - left) + 2), height))
    ImageDraw.Draw(canvas).text((1 - left, 0.05 * size), text, fill=255, font=font)
    return np.asarray(canvas)
