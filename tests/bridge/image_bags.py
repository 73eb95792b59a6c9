"""A bag of a robot with a camera and a lidar: images at 30 Hz, raw and compressed, clouds at 10 Hz, and positions."""

from __future__ import annotations

from pathlib import Path

import numpy
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore

STORE = get_typestore(Stores.ROS1_NOETIC)
T = STORE.types
RATE, IMAGES = 30, 60
START = 1_763_690_000 * 10**9
CAMERA, JPEG, CLOUD, ODOM = "/camera/image_raw", "/camera/compressed", "/lidar/points", "/odom"


def bag_of_images(path: Path) -> dict[str, list[tuple[int, bytes]]]:
    """Two seconds: raw images with a moving pattern and noise, a compressed stream of noise, clouds, odometry."""
    random = numpy.random.default_rng(1)
    y, x = numpy.mgrid[0:120, 0:160]
    written: dict[str, list[tuple[int, bytes]]] = {name: [] for name in (CAMERA, JPEG, CLOUD, ODOM)}
    fields = [T["sensor_msgs/msg/PointField"](name, 4 * n, 7, 1) for n, name in enumerate("xyz")]
    with Writer(path) as bag:
        kinds = {CAMERA: "sensor_msgs/msg/Image", JPEG: "sensor_msgs/msg/CompressedImage",
                 CLOUD: "sensor_msgs/msg/PointCloud2", ODOM: "geometry_msgs/msg/PointStamped"}  # fmt: skip
        lines = {topic: bag.add_connection(topic, kind, typestore=STORE) for topic, kind in kinds.items()}
        for n in range(IMAGES):
            at = START + n * 10**9 // RATE
            header = T["std_msgs/msg/Header"](n, T["builtin_interfaces/msg/Time"](at // 10**9, at % 10**9), "camera")
            pattern = numpy.stack([(x + 3 * n) % 256, (y + n) % 256, (x + y) % 256], -1)
            pixels = (pattern + random.integers(0, 3, pattern.shape)).astype(numpy.uint8).reshape(-1)
            messages = {
                CAMERA: T[kinds[CAMERA]](header, 120, 160, "rgb8", 0, 480, pixels),
                JPEG: T[kinds[JPEG]](header, "jpeg", random.integers(0, 256, 30_000 + 97 * n).astype(numpy.uint8)),
                ODOM: T[kinds[ODOM]](header, T["geometry_msgs/msg/Point"](float(n), -float(n), 0.5)),
            }
            if n % 3 == 0:
                points = random.normal(size=(8_000, 3)).astype("<f4").tobytes()
                data = numpy.frombuffer(points, numpy.uint8)
                messages[CLOUD] = T[kinds[CLOUD]](header, 1, 8_000, fields, False, 12, 96_000, data, True)
            for topic, message in messages.items():
                raw = bytes(STORE.serialize_ros1(message, kinds[topic]))
                bag.write(lines[topic], at, raw)
                written[topic].append((at, raw))
    return written
