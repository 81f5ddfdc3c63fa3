"""Read any bag: a rosbag2 folder, .mcap (also one whose writer was killed), .db3 or a ROS 1 .bag."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

from mcap.reader import make_reader
from rosbags.convert.converter import migrate_bytes
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Connection, Qos
from rosbags.rosbag2.metadata import dump_qos_v8
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from sf_interfaces.errors import FormatError
from sf_interfaces.io.definitions import typestore
from sf_interfaces.io.recovery import TornMcap

_SUFFIXES = (".mcap", ".db3", ".bag")
_RENAMED = {"tf/msg/tfMessage": "tf2_msgs/msg/TFMessage"}
_MAGIC = b"\x89MCAP0\r\n"


@dataclass(frozen=True, slots=True)
class TopicInfo:
    """One topic of a bag. ``qos`` is rosbag2's YAML of the recorded profiles ("" when unknown)."""

    name: str
    type: str
    count: int
    qos: str


@dataclass(frozen=True, slots=True)
class RawMessage:
    """One message as recorded: ``stamp_ns`` is its log time, ``data`` CDR of the ROS 2 type."""

    topic: str
    type: str
    stamp_ns: int
    data: bytes


def is_bag(path: Path) -> bool:
    """Whether a path looks like a bag: by suffix, or a folder with metadata.yaml."""
    return path.suffix in _SUFFIXES or (path / "metadata.yaml").is_file()


def _is_torn(path: Path) -> bool:
    """Whether an mcap file begins as one but lacks its end."""
    if path.suffix != ".mcap":
        return False
    with path.open("rb") as file:
        if file.read(8) != _MAGIC:
            return False
        size = file.seek(0, 2)
        file.seek(max(8, size - 8))
        return file.read() != _MAGIC


class BagReader:
    """A bag, opened. Also a context manager.

    Attributes:
        topics: what it holds, by name; topics without messages are included.
        start_ns, end_ns: first and last log time.
        torn: the file was never finished; what had reached the disk is read.

    Raises:
        FormatError: missing, empty, damaged, or no bag at all.
    """

    def __init__(self, path: Path):
        self.path = path = Path(path)
        self._stack = ExitStack()
        self._torn: TornMcap | None = None
        self._any: AnyReader | None = None
        if not path.exists():
            raise FormatError(f"bag {path} does not exist; check the path")
        if not is_bag(path):
            raise FormatError(f"{path} is no bag; give a rosbag2 folder, .mcap, .db3 or .bag")
        if path.is_file() and path.stat().st_size == 0:
            raise FormatError(f"bag {path} is an empty file; record it again")
        try:
            files = sorted(path.glob("*.mcap")) if path.is_dir() else [path]
            torn = next((file for file in files if _is_torn(file)), None)
            if torn is not None and len(files) == 1:
                self._open_torn(torn)
            else:
                self._any = self._stack.enter_context(AnyReader([path], default_typestore=typestore()))
                self._open_any(self._any)
        except FormatError:
            raise
        except Exception as error:  # the readers below raise a dozen kinds on damaged files
            words = " ".join(str(error).split()).rstrip(".")
            raise FormatError(f"bag {path} cannot be read ({words}); record or copy it again") from error
        if not sum(topic.count for topic in self.topics.values()):
            raise FormatError(f"bag {path} holds no message; record it again")

    def __enter__(self) -> BagReader:
        return self

    def __exit__(self, kind: type[BaseException] | None, e: BaseException | None, t: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Close the files."""
        self._stack.close()

    @property
    def torn(self) -> bool:
        return self._torn is not None

    def metadata(self) -> dict[str, dict[str, str]]:
        """Named records of strings of an mcap file that was finished; other bags have none."""
        files = sorted(self.path.glob("*.mcap")) if self.path.is_dir() else [self.path]
        found: dict[str, dict[str, str]] = {}
        for path in files if not self.torn else []:
            if path.suffix == ".mcap":
                with path.open("rb") as file:
                    found |= {record.name: dict(record.metadata) for record in make_reader(file).iter_metadata()}
        return found

    def _open_torn(self, path: Path) -> None:
        self._torn = torn = TornMcap(path)
        counts = Counter(entry.channel for entry in torn.entries)
        self._store: Any = get_typestore(Stores.EMPTY)
        types = dict(typestore().fielddefs)
        for schema in torn.schemas.values():
            if schema.encoding == "ros2msg":
                types.update(get_types_from_msg(schema.data.decode(), schema.name))
        self._store.register(types)
        self.topics = {
            channel.topic: TopicInfo(
                channel.topic,
                torn.schemas[channel.schema_id].name,
                counts[channel.id],
                channel.metadata.get("offered_qos_profiles", ""),
            )
            for channel in torn.channels.values()
        }
        self.start_ns = torn.entries[0].log_time if torn.entries else 0
        self.end_ns = torn.entries[-1].log_time if torn.entries else 0

    def _open_any(self, reader: AnyReader) -> None:
        self._store = reader.typestore if reader.is2 else typestore()
        self.topics = {}
        self._connections: dict[str, list[Connection]] = {}
        for connection in reader.connections:
            kind = connection.msgtype if reader.is2 else _RENAMED.get(connection.msgtype, connection.msgtype)
            if not reader.is2 and kind not in self._store.types:
                continue  # a ROS 1 type without a ROS 2 counterpart cannot be expressed in CDR
            profiles: list[Qos] = getattr(connection.ext, "offered_qos_profiles", [])
            before = self.topics.get(connection.topic)
            count = connection.msgcount + (before.count if before else 0)
            self.topics[connection.topic] = TopicInfo(connection.topic, kind, count, dump_qos_v8(profiles))
            self._connections.setdefault(connection.topic, []).append(connection)
        self.start_ns, self.end_ns = reader.start_time, reader.end_time - 1

    def messages(self, topics: Collection[str] | None = None) -> Iterator[RawMessage]:
        """All messages, or those of some topics, in the order of log time.

        Raises:
            FormatError: a named topic is not in the bag, or its data is damaged.
        """
        for topic in topics or ():
            if topic not in self.topics:
                known = ", ".join(sorted(self.topics))
                raise FormatError(f"bag {self.path} has no topic {topic}; it has {known}")
        wanted = self.topics.keys() if topics is None else set(topics)
        try:
            yield from self._read_torn(wanted) if self._torn else self._read_any(wanted)
        except Exception as error:  # the readers below raise a dozen kinds on damaged files
            words = " ".join(str(error).split()).rstrip(".")
            raise FormatError(f"bag {self.path} is damaged ({words}); copy or record it again") from error

    def _read_torn(self, wanted: Collection[str]) -> Iterator[RawMessage]:
        assert self._torn is not None
        for entry in self._torn.entries:
            channel = self._torn.channels[entry.channel]
            if channel.topic in wanted:
                kind = self.topics[channel.topic].type
                yield RawMessage(channel.topic, kind, entry.log_time, self._torn.data(entry))

    def _read_any(self, wanted: Collection[str]) -> Iterator[RawMessage]:
        assert self._any is not None
        connections = [c for topic in self.topics if topic in wanted for c in self._connections[topic]]
        cache: dict[str, object] = {}
        for connection, stamp, data in self._any.messages(connections) if connections else ():
            kind = self.topics[connection.topic].type
            if not self._any.is2:
                converted = migrate_bytes(
                    self._any.typestore, self._store, connection.msgtype, kind, cache, data,
                    src_is2=False, dst_is2=True,
                )  # fmt: skip
                data = bytes(converted)
            yield RawMessage(connection.topic, kind, stamp, bytes(data))

    def decode(self, raw: RawMessage) -> Any:
        """The message object of raw bytes.

        Raises:
            FormatError: the bytes do not fit the type.
        """
        try:
            return self._store.deserialize_cdr(raw.data, raw.type)
        except Exception as error:  # malformed bytes surface as index, value, struct or serde errors
            raise FormatError(
                f"a {raw.type} on {raw.topic} at {raw.stamp_ns} ns in {self.path} is malformed ({error}); "
                "record it again"
            ) from error
