"""Levels of a scene as a tree of chunks, which viewers load progressively."""

from cvtgs.streams.blocks import StreamReport, stream_file
from cvtgs.streams.files import StreamLevel
from cvtgs.streams.plan import StreamChunk, StreamedLevel, StreamNode, StreamPlan, plan_stream
from cvtgs.streams.sog import write_sog_stream
from cvtgs.streams.tiles import geo_transform, write_tiles

__all__ = [
    "StreamChunk",
    "StreamLevel",
    "StreamNode",
    "StreamPlan",
    "StreamReport",
    "StreamedLevel",
    "geo_transform",
    "plan_stream",
    "stream_file",
    "write_sog_stream",
    "write_tiles",
]
