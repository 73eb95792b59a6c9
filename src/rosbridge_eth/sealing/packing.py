"""Making a payload small before it is encrypted: long numbers as binary, the rest by deflate with a dictionary.

The JSON of a captured message is a text that hardly changes and numbers that
hardly repeat, so the two are taken apart:

    packed = mode 1 | raw deflate (RFC 1951) of the text | numbers

mode 0: the text is the payload, there are no numbers. mode 1: in the text, a
byte 01, 02 or 03 stands for the next number, which is

    01  a double: 8 bytes, IEEE 754, big-endian
    02  a double that is a float32 as well: 4 bytes
    03  an integer: its difference from the one before (at first: from 0), as
        a byte that tells how many bytes follow, and these, two's complement

A double is written in the text as Python's `repr` does, the shortest decimal
that reads back the same; an integer in decimal. A number that is not written
like that, or is short, stays in the text, so every payload comes back byte by
byte. The dictionary is the text that common messages share; like the rules it
is part of the format's version 1 and never changes within it. Deflate marks
its own end, numbers are counted: what follows is padding and has to be zeros.
"""

from __future__ import annotations

import re
import struct
import zlib
from typing import Final

from rosbridge_eth.sealing.errors import Malformed
from rosbridge_eth.sealing.layout import MAX_PAYLOAD

DICTIONARY: Final = (
    b'"ranges":["intensities":["covariance":["position_covariance":["name":["velocity":["effort":["latitude":\1,'
    b'"longitude":\1,"altitude":\1,"status":"level":"message":"values":[{"key":"value":"transforms":[{"transform":'
    b'{"translation":{"rotation":{"angle_min":"angle_max":"angle_increment":"time_increment":"scan_time":'
    b'"range_min":"range_max":"height":"width":"encoding":"is_bigendian":"step":"fields":[{"offset":"datatype":'
    b'"count":"point_step":"row_step":"is_dense":"voltage":"temperature":"current":"charge":"percentage":'
    b'"sm3":"length":"NaN""Infinity"null,false,true,"map","base_link","base_footprint","imu_link","odom_combined",'
    b'std_msgs/msg/String","data":{"data":"sensor_msgs/msg/LaserScan"sensor_msgs/msg/JointState"'
    b'sensor_msgs/msg/BatteryState"sensor_msgs/msg/NavSatFix"geometry_msgs/msg/PoseStamped"tf2_msgs/msg/TFMessage"'
    b'/scan","/joint_states","/battery_state","/fix","/tf","/cmd_vel","/pose","type":"geometry_msgs/msg/Twist",'
    b'"delivery":"latest","data":{"linear":{"x":0.0,"y":0.0,"z":0.0},"angular":{"x":0.0,"y":0.0,"z":0.0}}}'
    b'\2,\2,\2,\2,\2,\2,\1,\1,\1,\1,0.0,0.0,0.0,0.0,0.0,0.0,0.0,0.0,'
    b'{"v":1,"topic":"/imu/data","type":"sensor_msgs/msg/Imu","received_ns":\3,"wall_ns":\3,"mono_ns":\3,"clock":false,'
    b'"delivery":"reliable","data":{"header":{"seq":0,"stamp":\3,"frame_id":"imu_link"},"orientation":{"x":\1,"y":\1,'
    b'"z":\1,"w":\1},"orientation_covariance":[1e-06,0.0,0.0,0.0,1e-06,0.0,0.0,0.0,1e-06],"angular_velocity":'
    b'{"x":\1,"y":\1,"z":\1},"angular_velocity_covariance":[0.0004,0.0,0.0,0.0,0.0004,0.0,0.0,0.0,0.0004],'
    b'"linear_acceleration":{"x":\1,"y":\1,"z":\1},"linear_acceleration_covariance":[0.01,0.0,0.0,0.0,0.01,0.0,0.0,0.0,0.01]}}'
    b'"pose":{"pose":{"position":{"x":\1,"y":\1,"z":0.0},"orientation":{"x":0.0,"y":0.0,"z":\1,"w":\1}}},'
    b'"twist":{"twist":{"linear":{"x":\1,"y":0.0,"z":0.0},"angular":{"x":0.0,"y":0.0,"z":\1}}}}}'
    b'{"v":1,"topic":"/robot_1/odom","type":"nav_msgs/msg/Odometry","received_ns":\3,"wall_ns":\3,"mono_ns":\3,'
    b'"clock":true,"delivery":"reliable","data":{"header":{"stamp":\3,"frame_id":"odom"},"child_frame_id":"base_link",'
    b'"pose":{"pose":{"position":{"x":\1,"y":\1,"z":\1},"orientation":{"x":\1,"y":\1,"z":\1,"w":\1}}},'
    b'"twist":{"twist":{"linear":{"x":\1,"y":\1,"z":\1},"angular":{"x":\1,"y":\1,"z":\1}}}}}'
)

_PLAIN, _SPLIT = b"\0", b"\1"
_DOUBLE, _FLOAT, _INTEGER = "\1", "\2", "\3"
_PLACE = re.compile("[\1\2\3]")
_PLACE_KEPT = re.compile("([\1\2\3])")
# A fraction of 8 digits or more, or an integer of 7 to 19: below, the text is as short.
_NUMBER = re.compile(r"(-?[0-9]+\.[0-9]{8,}(?:e[-+][0-9]+)?|-?[0-9]{7,19})")
_MAX_FLOAT = 3.4028234663852886e38  # of a float32, IEEE 754
_MAX_INTEGER = 10  # bytes of a difference of two integers of 19 digits, its length included
_pack_double, _pack_float = struct.Struct(">d").pack, struct.Struct(">f").pack
_unpack_double, _unpack_float = struct.Struct(">d").unpack_from, struct.Struct(">f").unpack_from

_SMALL: Final = 2048
# A window just large enough for dictionary and text: setting up the usual 256 KiB of state costs more
# than compressing a short text does. Any window is read with the largest one.
_WINDOW_SMALL, _WINDOW = -12, -15


def pack(payload: bytes) -> bytes:
    text = payload.decode("latin-1")  # any bytes at all; what looks like a number is ASCII in UTF-8
    if _PLACE.search(text):
        return _PLAIN + _deflate(payload)
    parts, numbers, before = _NUMBER.split(text), list[bytes](), 0
    for index in range(1, len(parts), 2):
        token = parts[index]
        if "." in token:
            value = float(token)
            if repr(value) == token:
                parts[index], number = _pack_fraction(value)
                numbers.append(number)
        else:
            integer = int(token)
            if str(integer) == token:
                parts[index] = _INTEGER
                difference = integer - before
                size = (difference.bit_length() + 8) // 8
                numbers.append(size.to_bytes(1, "big") + difference.to_bytes(size, "big", signed=True))
                before = integer
    return _SPLIT + _deflate("".join(parts).encode("latin-1")) + b"".join(numbers)


def _pack_fraction(value: float) -> tuple[str, bytes]:
    if abs(value) <= _MAX_FLOAT:
        single = _pack_float(value)
        if _unpack_float(single)[0] == value:
            return _FLOAT, single
    return _DOUBLE, _pack_double(value)


def _deflate(text: bytes) -> bytes:
    small = len(text) <= _SMALL
    stream = zlib.compressobj(
        6, zlib.DEFLATED, _WINDOW_SMALL if small else _WINDOW, 5 if small else 8, zlib.Z_DEFAULT_STRATEGY, DICTIONARY
    )
    return stream.compress(text) + stream.flush()


def unpack(packed: bytes) -> bytes:
    """The payload; Malformed if it is not packed like that, above MAX_PAYLOAD, or not followed by zeros alone."""
    stream = zlib.decompressobj(_WINDOW, DICTIONARY)
    try:
        text = stream.decompress(packed[1:], MAX_PAYLOAD + 1)
    except zlib.error:
        raise Malformed("a record's payload is not a deflate stream") from None
    if len(text) > MAX_PAYLOAD:
        raise Malformed(f"a record's payload unpacks to more than {MAX_PAYLOAD} bytes")
    if not stream.eof:
        raise Malformed("a record's payload is cut short")
    rest = stream.unused_data
    if packed.startswith(_SPLIT):
        payload, at = _join(text.decode("latin-1"), rest)
    elif packed.startswith(_PLAIN):
        payload, at = text, 0
    else:
        raise Malformed("a record's payload is packed in an unknown mode")
    if len(payload) > MAX_PAYLOAD:
        raise Malformed(f"a record's payload unpacks to more than {MAX_PAYLOAD} bytes")
    if rest[at:].strip(b"\0"):
        raise Malformed("a record's payload is followed by something that is not padding")
    return payload


def _join(text: str, numbers: bytes) -> tuple[bytes, int]:
    """The payload, and where in `numbers` the last one ends. No number's text is longer than 16 times its bytes."""
    parts, at, before = _PLACE_KEPT.split(text), 0, 0
    try:
        for index in range(1, len(parts), 2):
            if parts[index] == _DOUBLE:
                parts[index], at = repr(_unpack_double(numbers, at)[0]), at + 8
            elif parts[index] == _FLOAT:
                parts[index], at = repr(_unpack_float(numbers, at)[0]), at + 4
            else:
                size = numbers[at]
                if not 0 < size < _MAX_INTEGER or at + 1 + size > len(numbers):
                    raise Malformed("a record's payload has an integer of an impossible size")
                before += int.from_bytes(numbers[at + 1 : at + 1 + size], "big", signed=True)
                parts[index], at = str(before), at + 1 + size
    except (struct.error, IndexError):
        raise Malformed("a record's payload has fewer numbers than its text has places") from None
    return "".join(parts).encode("latin-1"), at
