"""Every topic of the graph in one table: name, type, quality of service and frame."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class Qos(Enum):
    """The kinds of connection; ``ros/qos.py`` turns them into QoS profiles."""

    SENSOR = "sensor"  # best effort, keep 5: works with reliable and best-effort publishers alike
    RELIABLE = "reliable"  # reliable, keep 100: results
    KEYFRAME = "keyframe"  # live: reliable, the last 30 kept for a node that starts (again); replay: as RELIABLE
    LATEST = "latest"  # reliable, keep 1
    LATCHED = "latched"  # reliable, transient local, keep 1
    MAP = "map"  # reliable, transient local, keep 100
    CLOCK = "clock"  # best effort, keep 1


@dataclass(frozen=True, slots=True)
class Topic:
    """One topic of the graph."""

    name: str
    type: str
    qos: Qos
    frame: str = ""


_IMAGE, _INFO = "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo"
_POSE, _CLOUD = "geometry_msgs/msg/PoseStamped", "sensor_msgs/msg/PointCloud2"
_STATE, _TIME = "sf_interfaces/msg/StreamState", "builtin_interfaces/msg/Time"
_TF = "tf2_msgs/msg/TFMessage"

RGB_IMAGE = Topic("/sf/rgb/image", _IMAGE, Qos.SENSOR, "optical")
RGB_INFO = Topic("/sf/rgb/camera_info", _INFO, Qos.SENSOR, "optical")
DEPTH_IMAGE = Topic("/sf/depth/image", _IMAGE, Qos.SENSOR, "optical")
LIDAR_POINTS = Topic("/sf/lidar/points", _CLOUD, Qos.SENSOR, "lidar")
GIVEN_POSE = Topic("/sf/pose", _POSE, Qos.SENSOR, "map")
INPUTS = (RGB_IMAGE, RGB_INFO, DEPTH_IMAGE, LIDAR_POINTS, GIVEN_POSE)

FLEXION_IMAGE = Topic("/sf/flexion/image", _IMAGE, Qos.RELIABLE, "optical")

TRACKING_POSE = Topic("/sf/tracking/pose", _POSE, Qos.RELIABLE, "map")
TRACKING_PATH = Topic("/sf/tracking/path", "nav_msgs/msg/Path", Qos.LATCHED, "map")
KEYFRAME_IMAGE = Topic("/sf/tracking/keyframe/image", _IMAGE, Qos.KEYFRAME, "optical")
KEYFRAME_INFO = Topic("/sf/tracking/keyframe/camera_info", _INFO, Qos.KEYFRAME, "optical")
KEYFRAME_POSE = Topic("/sf/tracking/keyframe/pose", _POSE, Qos.KEYFRAME, "map")
KEYFRAME_DEPTH = Topic("/sf/tracking/keyframe/depth", _IMAGE, Qos.KEYFRAME, "optical")
KEYFRAME_LANDMARKS = Topic("/sf/tracking/keyframe/landmarks", _CLOUD, Qos.KEYFRAME, "optical")
KEYFRAME_STATE = Topic("/sf/tracking/keyframe/state", "sf_interfaces/msg/KeyframeState", Qos.KEYFRAME, "map")

DENSE_IMAGE = Topic("/sf/depth/dense/image", _IMAGE, Qos.KEYFRAME, "optical")
DENSE_VARIANCE = Topic("/sf/depth/dense/variance", _IMAGE, Qos.KEYFRAME, "optical")
DENSE_INFO = Topic("/sf/depth/dense/camera_info", _INFO, Qos.KEYFRAME, "optical")
DENSE_POSE = Topic("/sf/depth/dense/pose", _POSE, Qos.KEYFRAME, "map")
DENSE_POINTS = Topic("/sf/depth/dense/points", _CLOUD, Qos.RELIABLE, "optical")

SURFACE = Topic("/sf/recon/surface", _CLOUD, Qos.MAP, "map")
VIEW_POSE = Topic("/sf/recon/view/pose", _POSE, Qos.LATEST, "map")
VIEW_IMAGE = Topic("/sf/recon/view/image", _IMAGE, Qos.LATEST, "optical")
VIEW_DEPTH = Topic("/sf/recon/view/depth", _IMAGE, Qos.LATEST, "optical")

PRODUCTION_LINE = Topic("/sf/line", "sf_interfaces/msg/ProductionLine", Qos.LATCHED)
DIAGNOSTICS = Topic("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", Qos.RELIABLE)
TF = Topic("/tf", _TF, Qos.RELIABLE)
TF_STATIC = Topic("/tf_static", _TF, Qos.MAP)
CLOCK = Topic("/clock", "rosgraph_msgs/msg/Clock", Qos.CLOCK)

GROUND_TRUTH_PREFIX = "/ground_truth/"  # references for evaluation; discovery never takes them as input


def consumed(node: str) -> Topic:
    """Credits: the stamp a head node has taken in (``node`` is the short name, e.g. ``tracking``)."""
    return Topic(f"/sf/{node}/consumed", _TIME, Qos.RELIABLE)


def stream(node: str) -> Topic:
    """Whether the output of ``node`` goes on or has ended, and how many bundles it held."""
    return Topic(f"/sf/{node}/stream", _STATE, Qos.LATCHED)


TABLE = tuple(value for value in list(globals().values()) if isinstance(value, Topic))
