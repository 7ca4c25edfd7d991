"""Compressed bytes, unpacked in small pieces, so that memory stays small."""

import bz2
import io
import zlib
from collections.abc import Callable, Iterator
from typing import Any

from sim2gp.data.logs.file import import_optional

STEP = 2**18  # bytes of one piece


def pieces(content: bytes, kind: str, what: str) -> Iterator[bytes]:
    """Unpacked bytes in pieces of at most `STEP`; ``kind`` is "zstd", "lz4" and so on.

    ``what`` names the file where a package is missing (E135). ValueError for another
    compression, and any error of its library for damaged bytes.
    """
    if kind in ("", "none"):
        yield content
    elif kind == "zstd":
        zstandard = import_optional("zstandard", "ros", what)
        stream = zstandard.ZstdDecompressor().stream_reader(
            io.BytesIO(content), read_across_frames=True
        )
        while part := stream.read(STEP):
            yield part
    elif kind == "lz4":
        frames = import_optional("lz4.frame", "ros", what)
        yield from _streamed(content, frames.LZ4FrameDecompressor)
    elif kind == "bz2":
        yield from _streamed(content, bz2.BZ2Decompressor)
    else:
        raise ValueError(f"unknown compression {kind[:40]!r}")


def _streamed(content: bytes, make: Callable[[], Any]) -> Iterator[bytes]:
    """Of the two libraries with ``max_length``, and of frames after each other."""
    while content:
        stream, given = make(), content
        while not stream.eof:
            part = stream.decompress(given, max_length=STEP)
            given = b""
            if part:
                yield part
            elif stream.needs_input:
                raise EOFError("compressed data end too early")
        content = stream.unused_data or b""


def inflate(content: bytes) -> Iterator[bytes]:
    """Unpacked bytes of a zlib stream, as HDF5 compresses with gzip."""
    stream = zlib.decompressobj()
    while not stream.eof:
        part = stream.decompress(content, STEP)
        content = stream.unconsumed_tail
        if part:
            yield part
        elif not content:
            raise EOFError("compressed data end too early")


def lzf_pieces(content: bytes) -> Iterator[bytes]:
    """Zeros, as many as bytes that h5py's LZF would unpack to, found token by token."""
    place = size = 0
    while place < len(content):
        token = content[place]
        if token < 32:  # so many bytes and one are copied from the input
            place += token + 2
            size += token + 1
        else:  # a copy of what was unpacked before
            length = token >> 5
            if length == 7:
                length += content[place + 1]
            place += 3 if token >> 5 == 7 else 2
            size += length + 2
        if size >= STEP:
            yield bytes(size)
            size = 0
    yield bytes(size)
