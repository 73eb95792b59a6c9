"""Messages of any type to lines of JSON: what a source hands over becomes what a log holds, and back.

Depends on nothing else of the bridge but its errors. `sources` produces the RawMessage and Decoder defined here.
"""

from rosbridge_eth.capture.conversion import Conversion
from rosbridge_eth.capture.definitions import Definition, DefinitionError, normalised_type_name, read_definition
from rosbridge_eth.capture.lines import (
    MAX_LINE,
    Line,
    LostLine,
    MessageLine,
    StreamLine,
    TypeLine,
    definition_line,
    parse_line,
    stream_line,
)
from rosbridge_eth.capture.messages import DecodeError, Decoder, RawMessage, Wire, decoder_for, decoder_for_known
from rosbridge_eth.capture.paths import parse_path, value_at
from rosbridge_eth.capture.process import Capture, Captured, Cause, Notice, TopicStatistics
from rosbridge_eth.capture.restoration import Restoration, Restored
from rosbridge_eth.capture.rules import NamePattern, TopicRule

__all__ = [
    "MAX_LINE", "Capture", "Captured", "Cause", "Conversion", "DecodeError", "Decoder", "Definition",
    "DefinitionError", "Line", "LostLine", "MessageLine", "NamePattern", "Notice", "RawMessage", "Restoration",
    "Restored", "StreamLine", "TopicRule", "TopicStatistics", "TypeLine", "Wire", "decoder_for", "decoder_for_known",
    "definition_line", "normalised_type_name", "parse_line", "parse_path", "read_definition", "stream_line",
    "value_at",
]  # fmt: skip
