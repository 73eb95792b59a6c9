"""The sealed record: signed by the robot, encrypted to its readers, before it leaves the robot's memory."""

from rosbridge_eth.sealing.errors import Altered, Forged, Malformed, NoGrant, NoReaders, RecordTooLarge
from rosbridge_eth.sealing.layout import Header, Kind, Opening, Sign, Verify, parse_header
from rosbridge_eth.sealing.opener import OpenedRecord, Opener, OpenStream, read_opening
from rosbridge_eth.sealing.sealer import Sealer, StreamLimits

__all__ = [
    "Altered",
    "Forged",
    "Header",
    "Kind",
    "Malformed",
    "NoGrant",
    "NoReaders",
    "OpenStream",
    "OpenedRecord",
    "Opener",
    "Opening",
    "RecordTooLarge",
    "Sealer",
    "Sign",
    "StreamLimits",
    "Verify",
    "parse_header",
    "read_opening",
]
