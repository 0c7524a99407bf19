"""PlayCanvas' SOG: images of quantised numbers and a ``meta.json``, in a zip or a folder."""

from cvtgs.io.sog.read import read_sog
from cvtgs.io.sog.stream import read_lod_sog
from cvtgs.io.sog.write import EncodedSog, encode_sog, write_sog

__all__ = ["EncodedSog", "encode_sog", "read_lod_sog", "read_sog", "write_sog"]
