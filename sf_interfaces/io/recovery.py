"""Read an mcap file that was never finished: whole chunks count, the torn end is left out."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Schema
from mcap.stream_reader import breakup_chunk

_HEAD = struct.Struct("<BQ")


@dataclass(frozen=True, slots=True)
class Entry:
    """Where one message lies: its chunk's place in the file and its place in the chunk."""

    log_time: int
    chunk: int
    position: int
    channel: int


class TornMcap:
    """The messages of an unfinished file, in the order of log time."""

    def __init__(self, path: Path):
        self._path = path
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.entries: list[Entry] = []
        self._cached: tuple[int, list[bytes]] = (-1, [])
        for offset, chunk in self._chunks():
            position = 0
            for record in breakup_chunk(chunk):
                if isinstance(record, Schema):
                    self.schemas[record.id] = record
                elif isinstance(record, Channel):
                    self.channels[record.id] = record
                else:
                    entry = Entry(record.log_time, offset, position, record.channel_id)
                    self.entries.append(entry)
                    position += 1
        self.entries.sort(key=lambda entry: entry.log_time)

    def _chunks(self) -> Iterator[tuple[int, Chunk]]:
        with self._path.open("rb") as file:
            file.seek(8)
            while len(head := file.read(_HEAD.size)) == _HEAD.size:
                opcode, length = _HEAD.unpack(head)
                offset = file.tell()
                if opcode != Opcode.CHUNK:
                    file.seek(length, 1)
                    continue
                data = file.read(length)
                if len(data) < length:
                    return
                yield offset, Chunk.read(ReadDataStream(BytesIO(data)))

    def _messages(self, chunk: int) -> list[bytes]:
        if self._cached[0] != chunk:
            with self._path.open("rb") as file:
                file.seek(chunk)
                records = breakup_chunk(Chunk.read(ReadDataStream(file)))
            self._cached = (chunk, [r.data for r in records if not isinstance(r, (Schema, Channel))])
        return self._cached[1]

    def data(self, entry: Entry) -> bytes:
        """The bytes of one message."""
        return self._messages(entry.chunk)[entry.position]
