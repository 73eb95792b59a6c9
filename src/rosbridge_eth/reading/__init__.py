"""The reader: from what the chain has of a robot to proven records, what is wrong with them, and files."""

from rosbridge_eth.reading.findings import Finding, FindingKind, Severity
from rosbridge_eth.reading.history import (
    ChainItem,
    ChainRegistration,
    ProvenHistory,
    ProvenRecord,
    StreamSummary,
    join_certificates,
    prove,
    split_certificates,
)

__all__ = [
    "ChainItem",
    "ChainRegistration",
    "Finding",
    "FindingKind",
    "ProvenHistory",
    "ProvenRecord",
    "Severity",
    "StreamSummary",
    "join_certificates",
    "prove",
    "split_certificates",
]
