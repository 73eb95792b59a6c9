"""Where records rest: the robot's spool until the server has them, the server's inbox until the ledger has them.

`redis_inbox.RedisInbox` is imported where it is used: a robot has no need of a Redis client.
"""

from rosbridge_eth.store.inbox import (
    DeadLetter,
    Inbox,
    InboxLimits,
    InboxStatistics,
    LeasedRecord,
    Outcome,
    State,
)
from rosbridge_eth.store.spool import Delivery, Spool, SpoolFull, SpoolLimits, SpoolStatistics
from rosbridge_eth.store.sqlite_inbox import SqliteInbox

__all__ = [
    "DeadLetter",
    "Delivery",
    "Inbox",
    "InboxLimits",
    "InboxStatistics",
    "LeasedRecord",
    "Outcome",
    "Spool",
    "SpoolFull",
    "SpoolLimits",
    "SpoolStatistics",
    "SqliteInbox",
    "State",
]
