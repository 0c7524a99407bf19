"""PlayCanvas' SOG: images of quantised numbers and a ``meta.json``, in a zip or a folder."""

from cvtgs.io.sog.read import read_sog
from cvtgs.io.sog.write import SOG_HOLDS, write_sog

__all__ = ["SOG_HOLDS", "read_sog", "write_sog"]
