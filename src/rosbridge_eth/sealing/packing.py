"""Making a payload small: raw deflate (RFC 1951) with a preset dictionary.

The dictionary is the JSON that captured messages share; a short record is
mostly that, so it halves what has to be written to the chain. It is part of
the format's version 1 and never changes within it. Deflate marks its own end;
what follows in the record is padding, and has to be zeros.
"""

from __future__ import annotations

import zlib
from typing import Final

from rosbridge_eth.sealing.errors import Malformed
from rosbridge_eth.sealing.layout import MAX_PAYLOAD

DICTIONARY: Final = (
    b'"ranges":["intensities":["covariance":["position_covariance":["name":["velocity":["effort":["latitude":'
    b'"longitude":"altitude":"status":"level":"message":"values":[{"key":"value":"transforms":[{"transform":'
    b'{"translation":{"rotation":{"angle_min":"angle_max":"angle_increment":"time_increment":"scan_time":'
    b'"range_min":"range_max":"height":"width":"encoding":"is_bigendian":"step":"fields":[{"offset":"datatype":'
    b'"count":"point_step":"row_step":"is_dense":"voltage":"temperature":"current":"charge":"percentage":'
    b'"sm3":"length":"NaN""Infinity"null,false,true,"map","base_link","base_footprint","imu_link","odom_combined",'
    b'std_msgs/msg/String","data":{"data":"sensor_msgs/msg/LaserScan"sensor_msgs/msg/JointState"'
    b'sensor_msgs/msg/BatteryState"sensor_msgs/msg/NavSatFix"geometry_msgs/msg/PoseStamped"tf2_msgs/msg/TFMessage"'
    b'/scan","/joint_states","/battery_state","/fix","/tf","/cmd_vel","/pose","type":"geometry_msgs/msg/Twist",'
    b'"delivery":"latest","data":{"linear":{"x":0.0,"y":0.0,"z":0.0},"angular":{"x":0.0,"y":0.0,"z":0.0}}}'
    b'{"v":1,"topic":"/imu/data","type":"sensor_msgs/msg/Imu","received_ns":17,"wall_ns":17,"mono_ns":1,"clock":false,'
    b'"delivery":"reliable","data":{"header":{"seq":0,"stamp":17,"frame_id":"imu_link"},"orientation":{"x":0.0,"y":'
    b'-0.0,"z":0.0,"w":1.0},"orientation_covariance":[0.0,0.0,0.0,0.0,0.0,0.0,0.0,0.0,0.0],"angular_velocity":{"x":-0.0'
    b',"y":0.0,"z":-0.0},"angular_velocity_covariance":[-1.0,0.0,0.0],"linear_acceleration":{"x":0.0,"y":0.0,"z":9.8},'
    b'"linear_acceleration_covariance":[0.0,0.0]}}'
    b'{"v":1,"topic":"/robot_1/odom","type":"nav_msgs/msg/Odometry","received_ns":17,"wall_ns":17,"mono_ns":1,'
    b'"clock":true,"delivery":"reliable","data":{"header":{"stamp":17,"frame_id":"odom"},"child_frame_id":"base_link",'
    b'"pose":{"pose":{"position":{"x":-0.0,"y":0.0,"z":0.0},"orientation":{"x":0.0,"y":0.0,"z":0.0,"w":0.99}}},'
    b'"twist":{"twist":{"linear":{"x":0.0,"y":0.0,"z":0.0},"angular":{"x":0.0,"y":0.0,"z":-0.0}}}}}'
)

_SMALL: Final = 2048
# A window just large enough for dictionary and payload: setting up the usual 256 KiB of state costs more
# than compressing a short payload does. Any window is read with the largest one.
_WINDOW_SMALL, _WINDOW = -12, -15


def pack(payload: bytes) -> bytes:
    small = len(payload) <= _SMALL
    stream = zlib.compressobj(
        6, zlib.DEFLATED, _WINDOW_SMALL if small else _WINDOW, 5 if small else 8, zlib.Z_DEFAULT_STRATEGY, DICTIONARY
    )
    return stream.compress(payload) + stream.flush()


def unpack(packed: bytes) -> bytes:
    """The payload; Malformed if it is no deflate stream, above MAX_PAYLOAD, or not followed by zeros alone."""
    stream = zlib.decompressobj(_WINDOW, DICTIONARY)
    try:
        payload = stream.decompress(packed, MAX_PAYLOAD + 1)
    except zlib.error:
        raise Malformed("a record's payload is not a deflate stream") from None
    if len(payload) > MAX_PAYLOAD:
        raise Malformed(f"a record's payload unpacks to more than {MAX_PAYLOAD} bytes")
    if not stream.eof or stream.unused_data.strip(b"\0"):
        raise Malformed("a record's payload is cut short or followed by something else")
    return payload
