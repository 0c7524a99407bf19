"""Levels of a scene as a tree of chunks, which viewers load progressively."""

from cvtgs.streams.blocks import StreamReport, stream_file
from cvtgs.streams.files import INDEX_NAMES, StreamLevel, check_stream
from cvtgs.streams.plan import StreamChunk, StreamedLevel, StreamNode, StreamPlan, plan_stream
from cvtgs.streams.sog import write_sog_stream
from cvtgs.streams.tiles import check_transform, geo_transform, write_tiles

__all__ = [
    "INDEX_NAMES",
    "StreamChunk",
    "StreamLevel",
    "StreamNode",
    "StreamPlan",
    "StreamReport",
    "StreamedLevel",
    "check_stream",
    "check_transform",
    "geo_transform",
    "plan_stream",
    "stream_file",
    "write_sog_stream",
    "write_tiles",
]
