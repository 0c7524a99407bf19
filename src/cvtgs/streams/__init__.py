"""Levels of a scene as a tree of chunks that viewers load while they show it."""

from cvtgs.streams.plan import StreamChunk, StreamNode, StreamPlan, plan_stream
from cvtgs.streams.sog import StreamLevel, check_stream, write_sog_stream
from cvtgs.streams.tiles import write_tiles

__all__ = [
    "StreamChunk",
    "StreamLevel",
    "StreamNode",
    "StreamPlan",
    "check_stream",
    "plan_stream",
    "write_sog_stream",
    "write_tiles",
]
