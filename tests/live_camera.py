"""An independent camera: plain rclpy, sensor-data QoS, RGB-D from a bag, raw or compressed. Imports nothing of ours.

python live_camera.py FRAMES.npz NAMESPACE [--compressed] [--rate HZ] [--seconds S] [--log FILE]
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import argparse
import array
import struct
import time

import cv2
import numpy as np
import rclpy
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, CompressedImage, Image


def fill(msg: Image, pixels: np.ndarray, encoding: str) -> Image:
    msg.height, msg.width, msg.step = pixels.shape[0], pixels.shape[1], pixels.strides[0]
    msg.encoding = encoding
    msg.data = array.array("B", pixels.tobytes())
    return msg


def pack(msg: CompressedImage, data: bytes, form: str) -> CompressedImage:
    msg.format = form
    msg.data = array.array("B", data)
    return msg


def calibration(k: np.ndarray, shape: tuple[int, ...]) -> CameraInfo:
    msg = CameraInfo()
    msg.height, msg.width = shape[:2]
    msg.distortion_model = "plumb_bob"
    msg.k = [k[0], 0.0, k[2], 0.0, k[1], k[3], 0.0, 0.0, 1.0]
    return msg


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("frames")
    parser.add_argument("namespace")
    parser.add_argument("--compressed", action="store_true")
    parser.add_argument("--rate", type=float, default=10.0)
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--log", help="file that gets the stamp in ns and the number of each frame")
    args = parser.parse_args()
    data = np.load(args.frames)
    rgb, mm, k = data["rgb"], data["mm"], data["k"]
    rclpy.init()
    node = rclpy.create_node("driver", namespace=args.namespace)
    kind = CompressedImage if args.compressed else Image
    ends = ("/compressed", "/compressedDepth") if args.compressed else ("", "")
    color = node.create_publisher(kind, f"color/image_raw{ends[0]}", qos_profile_sensor_data)
    depth = node.create_publisher(kind, f"depth/image_raw{ends[1]}", qos_profile_sensor_data)
    info = node.create_publisher(CameraInfo, "color/camera_info", qos_profile_sensor_data)
    begin, i = time.monotonic(), 0
    while time.monotonic() - begin < args.seconds:
        # There and back again, so that the motion never jumps.
        index = i % (2 * len(rgb) - 2)
        index = index if index < len(rgb) else 2 * len(rgb) - 2 - index
        calibrated = calibration(k, rgb[index].shape)
        calibrated.header.stamp = node.get_clock().now().to_msg()
        calibrated.header.frame_id = "driver_optical"
        if args.compressed:
            jpeg = cv2.imencode(".jpg", rgb[index][..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()
            png = cv2.imencode(".png", mm[index], [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()
            sent = [
                (color, pack(CompressedImage(), jpeg, "rgb8; jpeg compressed bgr8")),
                (depth, pack(CompressedImage(), struct.pack("<iff", 0, 0.0, 0.0) + png, "16UC1; compressedDepth png")),
            ]
        else:
            sent = [(color, fill(Image(), rgb[index], "rgb8")), (depth, fill(Image(), mm[index], "16UC1"))]
        if args.log:  # before it is sent, so that a frame which arrived is known even if this process is stopped here
            stamp = calibrated.header.stamp
            with open(args.log, "a") as log:
                log.write(f"{stamp.sec * 1_000_000_000 + stamp.nanosec} {index}\n")
        for publisher, msg in sent:
            msg.header = calibrated.header
            publisher.publish(msg)
        info.publish(calibrated)
        i += 1
        rclpy.spin_once(node, timeout_sec=0)
        time.sleep(max(0.0, begin + i / args.rate - time.monotonic()))


if __name__ == "__main__":
    main()
