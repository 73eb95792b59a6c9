"""Messages of any type to lines of JSON: what a source hands over becomes what a log holds, and back.

Depends on nothing else of the bridge but its errors. `sources` produces the RawMessage and Decoder defined here.
"""

from rosbridge_eth.capture.conversion import Conversion
from rosbridge_eth.capture.definitions import DefinitionError, normalised_type_name, read_definition

from rosbridge_eth.capture.lines import (  # isort: skip
    LostLine, MessageLine, StreamLine, TriggerLine, TypeLine, definition_line, parse_line,
    stream_line, trigger_line,
)  # fmt: skip
from rosbridge_eth.capture.messages import DecodeError, Decoder, RawMessage, Wire, decoder_for, decoder_for_known
from rosbridge_eth.capture.process import Capture, Record
from rosbridge_eth.capture.restoration import Restoration
from rosbridge_eth.capture.rules import NamePattern, TopicRule

__all__ = [
    "Capture", "Conversion", "DecodeError", "Decoder", "DefinitionError",
    "LostLine", "MessageLine", "NamePattern", "RawMessage", "Record", "Restoration", "StreamLine", "TopicRule",
    "TriggerLine", "TypeLine", "Wire", "decoder_for", "decoder_for_known", "definition_line", "normalised_type_name",
    "parse_line", "read_definition", "stream_line", "trigger_line",
]  # fmt: skip
