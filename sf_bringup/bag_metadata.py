"""rosbag2's ``metadata.yaml``, which makes a folder with an mcap file a bag."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import yaml

from sf_interfaces.io.mcap_writer import McapWriter


def write_bag_metadata(folder: Path, writer: McapWriter) -> None:
    """rosbag2's metadata.yaml beside a finished file."""
    count = sum(writer.counts.values())
    start, duration = (
        {"nanoseconds_since_epoch": writer.start_ns},
        {"nanoseconds": writer.end_ns - writer.start_ns},
    )
    kinds = {channel.topic: channel for channel in writer.channels}
    topics = [
        {
            "topic_metadata": {
                "name": topic,
                "type": writer.type_of(topic),
                "serialization_format": "cdr",
                "offered_qos_profiles": yaml.safe_load(channel.metadata["offered_qos_profiles"]) or [],
                "type_description_hash": "",
            },
            "message_count": writer.counts[topic],
        }
        for topic, channel in kinds.items()
    ]
    file = {"path": writer.path.name, "starting_time": start, "duration": duration, "message_count": count}
    information = {
        "version": 9,
        "storage_identifier": "mcap",
        "duration": duration,
        "starting_time": start,
        "message_count": count,
        "topics_with_message_count": topics,
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": [writer.path.name],
        "files": [file],
        "custom_data": None,
        "ros_distro": "jazzy",
    }
    text = yaml.safe_dump({"rosbag2_bagfile_information": information}, sort_keys=False)
    (folder / "metadata.yaml").write_text(text)
