"""Lossless WebP images of numbers; the only file of ``io`` that knows Pillow."""

import io
import warnings

import numpy as np
from jaxtyping import UInt8

from cvtgs.errors import FileFormatError


def decode_webp(content: bytes, where: str, *, most_pixels: int) -> UInt8[np.ndarray, "h w 4"]:
    """Decode an image that stores numbers in its channels."""
    from PIL import Image, UnidentifiedImageError  # noqa: PLC0415 (loads in its time)

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(io.BytesIO(content), formats=("WEBP", "PNG")) as image:
                if image.width * image.height > most_pixels:
                    raise FileFormatError(
                        f"{where} must have at most {most_pixels:,} pixels, "
                        f"found {image.width} x {image.height}."
                    )
                return np.asarray(image.convert("RGBA"))
    except UnidentifiedImageError as error:
        raise FileFormatError(f"{where} must be a WebP image, found something else.") from error
    except FileFormatError:
        raise
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise FileFormatError(f"{where} must be a whole image, found: {error}.") from error


def encode_webp(numbers: UInt8[np.ndarray, "h w 4"]) -> bytes:
    """Write numbers to a lossless image, those below opacity 0 too."""
    from PIL import Image  # noqa: PLC0415

    file = io.BytesIO()
    Image.fromarray(numbers).save(file, format="webp", lossless=True, exact=True, quality=80)
    return file.getvalue()
