"""sensor_msgs/PointCloud2 <-> PointCloud."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sf_interfaces.errors import FormatError
from sf_interfaces.ros.stamps import Factory, header, sequence, to_ns
from sf_interfaces.types import PointCloud, UInt8

_DATATYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_TIME_FIELDS = ("t", "time", "timestamp", "offset_time", "time_stamp")  # Ouster, Velodyne, Hesai, Livox, ...
_LONGEST_SWEEP_NS = 10_000_000_000
_NANOSECONDS_AS_FLOAT = 1e12  # a float time beyond this can only count nanoseconds
_LONGEST_POINT = 1 << 20  # bytes; no driver has so many fields


def _records(msg: Any) -> NDArray[np.void]:
    """The points [N] as records with the message's fields, as a view where rows carry no padding."""
    order = ">" if msg.is_bigendian else "<"
    if int(msg.point_step) > _LONGEST_POINT:
        raise FormatError(f"cloud has points of {msg.point_step} bytes; mend the driver that wrote it")
    names, formats, offsets = [], [], []
    for field in msg.fields:
        kind = _DATATYPES.get(int(field.datatype))
        if kind is None:
            raise FormatError(f"cloud field '{field.name}' has unknown datatype {field.datatype}")
        size = np.dtype(kind).itemsize * max(1, int(field.count))
        if field.offset + size > msg.point_step:
            raise FormatError(f"cloud field '{field.name}' lies beyond point_step {msg.point_step}; mend its driver")
        if field.name and field.name not in names:
            names.append(field.name)
            formats.append((order + kind, max(1, int(field.count))) if field.count > 1 else order + kind)
            offsets.append(int(field.offset))
    missing = [name for name in "xyz" if name not in names]
    if missing:
        raise FormatError(f"cloud has no field '{missing[0]}', only {names}; choose a topic with 3D points")
    layout = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": int(msg.point_step)})
    height, width = int(msg.height), int(msg.width)
    row, row_step = width * layout.itemsize, int(msg.row_step)
    data = np.frombuffer(msg.data, dtype=np.uint8)
    if height <= 1:  # many drivers leave row_step wrong where there is only one row
        row_step = row
    if row_step < row or data.size < max(0, height - 1) * row_step + (row if height else 0):
        raise FormatError(
            f"cloud of {width}x{height} points of {layout.itemsize} bytes with row_step {msg.row_step} "
            f"holds {data.size} bytes; mend the driver that wrote it"
        )
    grid: NDArray[np.void] = np.ndarray((height, width), layout, buffer=data.data, strides=(row_step, layout.itemsize))
    return grid.reshape(-1)


def _scalars(records: NDArray[np.void], name: str) -> NDArray[Any]:
    """A field [N] that has one value for each point."""
    values = records[name]
    if values.ndim != 1:
        raise FormatError(f"cloud field '{name}' has {values.shape[1]} values a point, not one; mend its driver")
    return values


def _time_offsets(values: NDArray[Any], stamp_ns: int, name: str) -> NDArray[np.int64]:
    """Per-point times -> ns after the header stamp.

    Integers count nanoseconds, floats seconds (or nanoseconds where only that is possible). Times nearer to
    the header stamp than to zero are absolute.
    """
    if not len(values):
        return np.zeros(0, dtype=np.int64)
    if values.dtype.kind == "f":
        seconds = np.asarray(values, dtype=np.float64)
        if not np.isfinite(seconds).all():
            raise FormatError(f"cloud field '{name}' holds times that are not finite; mend the driver")
        if np.abs(seconds).max() > _NANOSECONDS_AS_FLOAT:
            ns = seconds.astype(np.int64)
        else:
            whole = np.floor(seconds)
            ns = whole.astype(np.int64) * 1_000_000_000 + np.rint((seconds - whole) * 1e9).astype(np.int64)
    else:
        ns = values.astype(np.int64)
    relative = ns - stamp_ns
    if np.median(np.abs(relative)) < np.median(np.abs(ns)):
        ns = relative
    if np.abs(ns).max() > _LONGEST_SWEEP_NS:
        raise FormatError(
            f"cloud field '{name}' gives a point {np.abs(ns).max() / 1e9:.1f} s off its stamp; "
            "use integer nanoseconds or float seconds"
        )
    return ns


def _colors(values: NDArray[Any]) -> UInt8:
    """Packed 0x00rrggbb, stored as uint32 or (PCL's habit) as float32 bits -> [N, 3]."""
    packed = np.ascontiguousarray(values.astype(values.dtype.newbyteorder("=")))
    if packed.dtype.itemsize != 4:
        raise FormatError("cloud field 'rgb' must be float32 or uint32; choose another cloud")
    packed = packed.view(np.uint32)
    return np.stack([packed >> 16, packed >> 8, packed], axis=-1).astype(np.uint8)


def decode_cloud(msg: Any) -> PointCloud:
    """sensor_msgs/PointCloud2 -> points in metres with colour and per-point time where the cloud has them.

    Points that are not finite (holes of an organised cloud) are dropped. Time fields ``t``, ``time``,
    ``timestamp`` and ``offset_time`` of any type become ns after the header stamp.

    Raises:
        FormatError: no x, y, z, or fields and lengths that do not fit.
    """
    records = _records(msg)
    stamp_ns = to_ns(msg.header.stamp)
    points = np.stack([_scalars(records, axis).astype(np.float32) for axis in "xyz"], axis=-1)
    keep = np.isfinite(points).all(axis=1)
    names = records.dtype.names or ()
    color = next((name for name in ("rgb", "rgba") if name in names), None)
    time = next((name for name in _TIME_FIELDS if name in names), None)
    return PointCloud(
        points[keep],
        None if color is None else _colors(_scalars(records, color)[keep]),
        None if time is None else _time_offsets(_scalars(records, time)[keep], stamp_ns, time),
        stamp_ns,
        msg.header.frame_id,
    )


def decode_field(msg: Any, name: str) -> NDArray[Any]:
    """One field of a cloud, such as ``intensity``, for the points :func:`decode_cloud` keeps.

    Raises:
        FormatError: no such field, or a malformed cloud.
    """
    records = _records(msg)
    if name not in (records.dtype.names or ()):
        raise FormatError(f"cloud has no field '{name}', only {list(records.dtype.names or ())}")
    keep = np.isfinite(np.stack([records[axis] for axis in "xyz"], axis=-1)).all(axis=1)
    out: NDArray[Any] = records[name][keep]
    return out.astype(out.dtype.newbyteorder("="))


def encode_cloud(make: Factory, cloud: PointCloud, intensity: NDArray[Any] | None = None) -> Any:
    """PointCloud -> PointCloud2 with x y z float32 and, where given, rgb, intensity and time (float32 s).

    Stamp and frame are the cloud's own.
    """
    columns: dict[str, NDArray[Any]] = {axis: cloud.points[:, i] for i, axis in enumerate("xyz")}
    if cloud.colors is not None:
        r, g, b = cloud.colors.astype(np.uint32).T
        columns["rgb"] = (r << 16 | g << 8 | b).astype("<u4").view("<f4")
    if intensity is not None:
        columns["intensity"] = np.asarray(intensity)
    if cloud.time_offset_ns is not None:
        columns["time"] = cloud.time_offset_ns * 1e-9
    table = np.empty(len(cloud), dtype=[(name, "<f4") for name in columns])
    for name, values in columns.items():
        if values.shape != (len(cloud),):
            raise FormatError(f"cloud field '{name}' has shape {values.shape}, needs ({len(cloud)},)")
        table[name] = values
    point_field = make("sensor_msgs/msg/PointField")
    fields = [point_field(name=n, offset=4 * i, datatype=7, count=1) for i, n in enumerate(columns)]
    cls = make("sensor_msgs/msg/PointCloud2")
    return cls(
        header=header(make, cloud.stamp_ns, cloud.frame_id),
        height=1,
        width=len(cloud),
        fields=fields,
        is_bigendian=False,
        point_step=table.itemsize,
        row_step=table.nbytes,
        data=sequence(cls, table.view(np.uint8)),
        is_dense=True,
    )
