"""Write mcap files that rosbag2, Foxglove, rosbags and mcap's own readers open.

Messages are gathered in chunks; a finished chunk is on disk as a whole, so a file whose writer was killed
stays readable up to its last chunk.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import struct
import time
import zlib
from collections import Counter
from pathlib import Path
from types import TracebackType
from typing import Any

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)

from sf_interfaces.errors import FormatError
from sf_interfaces.io.definitions import definition

_MAGIC = b"\x89MCAP0\r\n"
_MESSAGE = struct.Struct("<BQHIQQ")  # opcode, record length, channel, sequence, log time, publish time
_DEFAULT_QOS = """- history: keep_last
  depth: 10
  reliability: reliable
  durability: {durability}
  deadline: {{sec: 9223372036, nsec: 854775807}}
  lifespan: {{sec: 9223372036, nsec: 854775807}}
  liveliness: automatic
  liveliness_lease_duration: {{sec: 9223372036, nsec: 854775807}}
  avoid_ros_namespace_conventions: false"""


def qos_yaml(reliable: bool = True, latched: bool = False) -> str:
    """``offered_qos_profiles`` of a channel, as rosbag2 writes them."""
    text = _DEFAULT_QOS.format(durability="transient_local" if latched else "volatile")
    return text if reliable else text.replace("reliability: reliable", "reliability: best_effort")


def _bytes(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    data: bytes = builder.end()
    return data


class McapWriter:
    """An mcap file of ROS 2 messages (profile ros2, CDR). Also a context manager.

    Args:
        path: file to write; its folder is made.
        compression: "zstd" or "" (none).
        level: zstd level; 1 is fast, negative levels are faster and compress less.
        chunk_bytes: a chunk is written when it holds this much, bytes.

    Raises:
        FormatError: the file cannot be written, or the compression is unknown.
    """

    def __init__(self, path: Path, compression: str = "zstd", level: int = 1, chunk_bytes: int = 4 << 20):
        if compression not in ("zstd", ""):
            raise FormatError(f"mcap compression '{compression}' is unknown; use zstd or ''")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("wb")
        except OSError as error:
            raise FormatError(f"cannot write {path}: {error.strerror}; choose another file") from error
        self.path = path
        self.counts: Counter[str] = Counter()
        self.bytes: Counter[str] = Counter()
        self.start_ns, self.end_ns = 0, 0
        self._compressor = zstandard.ZstdCompressor(level=level) if compression else None
        self._compression, self._chunk_bytes = compression, chunk_bytes
        self._schemas: dict[str, Schema] = {}
        self._channels: dict[tuple[str, str], Channel] = {}
        self._channel_counts: Counter[int] = Counter()
        self._indexes: list[McapRecord] = []
        self._tally: Counter[str] = Counter()
        self._closed = False
        self._reset_chunk()
        self._file.write(_MAGIC + _bytes(Header(profile="ros2", library="scenefactory")))

    def __enter__(self) -> McapWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, e: BaseException | None, t: TracebackType | None) -> None:
        self.close()

    @property
    def channels(self) -> tuple[Channel, ...]:
        """The channels so far, in the order of their first message."""
        return tuple(self._channels.values())

    def type_of(self, topic: str) -> str:
        """The type of a topic that has been written."""
        return next(kind for name, kind in self._channels if name == topic)

    @property
    def unwritten(self) -> Counter[str]:
        """Messages of each topic that were given but have not reached the file yet."""
        names = {channel.id: channel.topic for channel in self._channels.values()}
        return Counter({names[channel]: len(records) for channel, records in self._chunk_index.items()})

    def _reset_chunk(self) -> None:
        self._pieces: list[bytes] = []
        self._size = 0
        self._chunk_times: list[int] = []
        self._chunk_index: dict[int, list[tuple[int, int]]] = {}

    def _append(self, data: bytes) -> None:
        self._pieces.append(data)
        self._size += len(data)

    def _channel(self, topic: str, kind: str, qos: str | None, text: str | None) -> int:
        known = self._channels.get((topic, kind))
        if known is not None:
            return int(known.id)
        if kind not in self._schemas:
            text = text or definition(kind)
            schema = Schema(
                id=len(self._schemas) + 1,
                name=kind,
                encoding="ros2msg" if text else "",
                data=(text or "").encode(),
            )
            self._schemas[kind] = schema
            self._append(_bytes(schema))
        profiles = qos_yaml(latched=topic.endswith("/tf_static")) if qos is None else qos
        channel = Channel(
            id=len(self._channels) + 1,
            topic=topic,
            message_encoding="cdr",
            schema_id=self._schemas[kind].id,
            metadata={"offered_qos_profiles": profiles},
        )
        self._channels[topic, kind] = channel
        self._append(_bytes(channel))
        return int(channel.id)

    def write(
        self,
        topic: str,
        type: str,
        log_time_ns: int,
        cdr: bytes,
        *,
        qos: str | None = None,
        publish_time_ns: int | None = None,
        definition: str | None = None,
    ) -> None:
        """Add a serialised message. ``qos`` (rosbag2's YAML) and ``definition`` count at a topic's first."""
        channel = self._channel(topic, type, qos, definition)
        sequence = self._channel_counts[channel] & 0xFFFFFFFF
        publish = log_time_ns if publish_time_ns is None else publish_time_ns
        self._chunk_index.setdefault(channel, []).append((log_time_ns, self._size))
        self._append(_MESSAGE.pack(5, 22 + len(cdr), channel, sequence, log_time_ns, publish))
        self._append(cdr)
        first = not self._channel_counts
        self.start_ns = log_time_ns if first else min(self.start_ns, log_time_ns)
        self.end_ns = log_time_ns if first else max(self.end_ns, log_time_ns)
        self._chunk_times.append(log_time_ns)
        self._channel_counts[channel] += 1
        self.counts[topic] += 1
        self.bytes[topic] += len(cdr)
        if self._size >= self._chunk_bytes:
            self.flush()

    def flush(self) -> None:
        """Put what was gathered on disk as one chunk."""
        if self._size:
            raw = b"".join(self._pieces)
            data = self._compressor.compress(raw) if self._compressor else raw
            start, end = min(self._chunk_times, default=0), max(self._chunk_times, default=0)
            name = self._compression.encode()
            head = struct.pack("<QQQII", start, end, len(raw), zlib.crc32(raw), len(name)) + name
            head += struct.pack("<Q", len(data))
            offset = self._file.tell()
            self._file.write(struct.pack("<BQ", Opcode.CHUNK, len(head) + len(data)) + head)
            self._file.write(data)
            index_start, offsets = self._file.tell(), {}
            for channel, records in self._chunk_index.items():
                offsets[channel] = self._file.tell()
                self._file.write(_bytes(MessageIndex(channel_id=channel, records=records)))
            self._indexes.append(
                ChunkIndex(
                    chunk_length=index_start - offset,
                    chunk_start_offset=offset,
                    compression=self._compression,
                    compressed_size=len(data),
                    message_end_time=end,
                    message_index_length=self._file.tell() - index_start,
                    message_index_offsets=offsets,
                    message_start_time=start,
                    uncompressed_size=len(raw),
                )
            )
            self._tally["chunk"] += 1
            self._reset_chunk()
        self._file.flush()

    def _outside_chunk(self, record: McapRecord) -> tuple[int, int]:
        self.flush()
        offset, data = self._file.tell(), _bytes(record)
        self._file.write(data)
        return offset, len(data)

    def metadata(self, name: str, values: dict[str, str]) -> None:
        """A named record of strings."""
        offset, length = self._outside_chunk(Metadata(name=name, metadata=values))
        self._indexes.append(MetadataIndex(offset=offset, length=length, name=name))
        self._tally["metadata"] += 1

    def attachment(self, name: str, data: bytes, media_type: str = "application/octet-stream") -> None:
        """A file inside the file."""
        now = time.time_ns()
        fields: dict[str, Any] = {"create_time": now, "log_time": now, "name": name, "media_type": media_type}
        offset, length = self._outside_chunk(Attachment(data=data, **fields))
        self._indexes.append(AttachmentIndex(offset=offset, length=length, data_size=len(data), **fields))
        self._tally["attachment"] += 1

    def close(self) -> None:
        """Write the summary and close the file. May be called twice."""
        if self._closed:
            return
        self._closed = True
        self.flush()
        self._file.write(_bytes(DataEnd(0)))
        start = self._file.tell()
        statistics = Statistics(
            attachment_count=self._tally["attachment"],
            channel_count=len(self._channels),
            channel_message_counts=dict(self._channel_counts),
            chunk_count=self._tally["chunk"],
            message_count=sum(self._channel_counts.values()),
            message_end_time=self.end_ns,
            message_start_time=self.start_ns,
            metadata_count=self._tally["metadata"],
            schema_count=len(self._schemas),
        )
        records = [*self._schemas.values(), *self._channels.values(), statistics, *self._indexes]
        summary = b"".join(_bytes(record) for record in records)
        crc = zlib.crc32(summary + struct.pack("<BQQQ", Opcode.FOOTER, 20, start, 0))
        self._file.write(summary + _bytes(Footer(summary_start=start, summary_offset_start=0, summary_crc=crc)))
        self._file.write(_MAGIC)
        self._file.close()
