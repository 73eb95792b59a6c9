"""The reader: from what a chain has of a robot to proven records, a verdict, and files."""

from rosbridge_eth.reading.fetch import Reading, read_robot
from rosbridge_eth.reading.verdict import Bookmark, Bookmarks, Finding, Kind, Verdict
from rosbridge_eth.reading.verify import Choice, Place, ProvenRecord, Verifier

__all__ = [
    "Bookmark", "Bookmarks", "Choice", "Finding", "Kind", "Place", "ProvenRecord",
    "Reading", "Verdict", "Verifier", "read_robot",
]  # fmt: skip
