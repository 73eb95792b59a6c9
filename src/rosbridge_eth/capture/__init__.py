"""Messages of any type to JSON-ready records: what a source hands over becomes what is sealed.

Depends on nothing else of the bridge but its errors. `sources` produces the
RawMessage and Decoder defined here.
"""

from rosbridge_eth.capture.conversion import Conversion
from rosbridge_eth.capture.definitions import Definition, DefinitionError, normalised_type_name, read_definition
from rosbridge_eth.capture.messages import (
    DecodeError,
    Decoder,
    RawMessage,
    Wire,
    decoder_for,
    decoder_for_known,
)
from rosbridge_eth.capture.paths import DEFAULT_FIELDS, parse_path, value_at
from rosbridge_eth.capture.process import Capture, Cause, Notice, TopicStatistics
from rosbridge_eth.capture.record import DELIVERIES, CapturedRecord, Delivery
from rosbridge_eth.capture.restoration import Restoration, Restored
from rosbridge_eth.capture.rules import NamePattern, TopicRule

__all__ = [
    "DEFAULT_FIELDS",
    "DELIVERIES",
    "Capture",
    "CapturedRecord",
    "Cause",
    "Conversion",
    "DecodeError",
    "Decoder",
    "Definition",
    "DefinitionError",
    "Delivery",
    "NamePattern",
    "Notice",
    "RawMessage",
    "Restoration",
    "Restored",
    "TopicRule",
    "TopicStatistics",
    "Wire",
    "decoder_for",
    "decoder_for_known",
    "normalised_type_name",
    "parse_path",
    "read_definition",
    "value_at",
]
