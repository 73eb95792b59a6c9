"""Which back end a store's URL names."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from rosbridge_eth.errors import ConfigError
from rosbridge_eth.log.store import Store


def open_store(
    url: str, *, file: Path, ledger: bytes, max_bytes: int, max_bytes_per_robot: int, read_only: bool = False
) -> Store:
    """The store at `url`, for one ledger (chunk.ledger_id): "sqlite", in `file`, or a Redis.

    The bounds are on the rows as they travel; the one on all robots together is SQLite's alone, a Redis has its own
    maxmemory. read_only: nothing is made or changed; database.NothingThere where there is no store yet. StoreError.
    """
    if url == "sqlite":
        from rosbridge_eth.log.sqlite import SqliteStore

        return SqliteStore(file, ledger, max_bytes, max_bytes_per_robot, read_only=read_only)
    if not find_spec("redis"):
        raise ConfigError("a store in a Redis needs redis: pip install 'pysmcrypto[redis]'")
    from rosbridge_eth.log.redis import RedisStore

    return RedisStore(url, ledger, max_bytes, max_bytes_per_robot)
