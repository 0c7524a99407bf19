"""PlayCanvas' SOG: images of quantised numbers and a ``meta.json``, in a zip or a folder."""

from cvtgs.io.sog.read import read_sog
from cvtgs.io.sog.write import write_sog

__all__ = ["read_sog", "write_sog"]
