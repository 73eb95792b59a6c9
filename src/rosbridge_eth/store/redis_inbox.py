"""The inbox in Redis Streams: for a server that already runs a Redis, or whose workers are on several machines.

What is acknowledged must be on a disk, so a Redis that may lose or evict it is
refused: at the start, and again with every append, because its settings can be
changed while it runs. Keys and scripts: redis_inbox.lua, beside this file.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from hashlib import blake2b
from importlib import resources
from typing import Any, Final

import redis
from redis.backoff import NoBackoff
from redis.connection import parse_url
from redis.retry import Retry

from rosbridge_eth.errors import StoreError
from rosbridge_eth.records import RecordId, SealedRecord
from rosbridge_eth.store.inbox import (
    DEFAULT_LIMITS,
    DeadLetter,
    InboxLimits,
    InboxStatistics,
    LeasedRecord,
    Outcome,
    State,
)

_FORMAT = b"1"
_OUTCOMES: Final = {"N": Outcome.NEW, "D": Outcome.DUPLICATE, "C": Outcome.CONFLICT, "F": Outcome.FULL}
_STATES: Final = {
    b"U": State.UNKNOWN, b"W": State.WAITING, b"L": State.LEASED, b"1": State.DONE, b"2": State.DEAD,
}  # fmt: skip
_CODES: Final = {State.DONE: "1", State.DEAD: "2"}
_SETTINGS: Final = {
    "appendonly": "yes",
    "appendfsync": "always",
    "no-appendfsync-on-rewrite": "no",
    "maxmemory-policy": "noeviction",
}
"""Without any one of these Redis may lose what it has confirmed."""
_URL_PARTS: Final = frozenset({
    "connection_class", "db", "host", "password", "path", "port", "username",
    "ssl_ca_certs", "ssl_ca_path", "ssl_cert_reqs", "ssl_certfile", "ssl_check_hostname", "ssl_keyfile",
})  # fmt: skip
CONNECT_TIMEOUT = 2.0  # s
ANSWER_TIMEOUT = 5.0  # s; an fsync of a busy disk
_GROUP = 500  # identities in one call: Redis does nothing else meanwhile


@cache
def _script() -> tuple[str, str]:
    """The script and the name Redis knows it by."""
    text = resources.files("rosbridge_eth.store").joinpath("redis_inbox.lua").read_text(encoding="utf-8")
    return text, hashlib.sha1(text.encode(), usedforsecurity=False).hexdigest()


class RedisInbox:
    """`Inbox` in a Redis. An object belongs to one thread; open one per process, after forking.

    binding: what the records belong to (the chain and the contract), as text.
    Inboxes of other bindings in the same Redis are apart from it; those of the
    same binding are one. A call that cannot be carried out raises StoreError,
    and the next one connects anew.
    """

    def __init__(self, url: str, binding: str, limits: InboxLimits = DEFAULT_LIMITS) -> None:
        self._limits = limits
        parts = _parts_of(url)
        self._password = parts.get("password")
        self._place = _place_of(parts)
        self._prefix = f"rosbridge-eth:{blake2b(binding.encode(), digest_size=8).hexdigest()}:"
        self._redis = redis.Redis(
            connection_pool=redis.ConnectionPool(
                **parts,
                protocol=2,
                socket_connect_timeout=CONNECT_TIMEOUT,
                socket_timeout=ANSWER_TIMEOUT,
                # Not by itself: a lease whose answer was lost must not be followed by the next one unseen.
                retry=Retry(NoBackoff(), 0),
            )
        )
        try:
            self._require_durability()
            found = self._call("open", binding)
            if found != [_FORMAT, binding.encode()]:
                raise StoreError(
                    f"the keys {self._prefix}* of {self._place} are of another version or program; choose another"
                    " database of that Redis in [store] url"
                )
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> RedisInbox:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._redis.close()
        self._redis.connection_pool.disconnect()

    def append(self, records: Sequence[SealedRecord], now: float) -> list[Outcome]:
        if not records:
            return []
        arguments: list[Any] = [repr(now), self._limits.records, self._limits.bytes]
        for record in records:
            arguments += (*_name(record.id), _digest(record.ciphertext), record.ciphertext)
        with self._talking():
            pipe = self._redis.pipeline(transaction=False)
            self._queue(pipe, "EVALSHA", _script()[1], "append", arguments)
            _ask_settings(pipe)
            answers = pipe.execute(raise_on_error=False)
            if isinstance(answers[0], redis.exceptions.NoScriptError):
                self._queue(pipe, "EVAL", _script()[0], "append", arguments)
                _ask_settings(pipe)
                answers = pipe.execute(raise_on_error=False)
            for answer in answers:
                if isinstance(answer, Exception):
                    raise answer
        # The records may be there now, but not for sure tomorrow; sent again they are duplicates.
        self._check(answers[1:])
        return [_OUTCOMES[letter] for letter in answers[0].decode()]

    def lease(
        self, consumer: str, *, limit: int, max_bytes: int, now: float, ttl: float, robot: bytes | None = None
    ) -> list[LeasedRecord]:
        asked = "" if robot is None else robot.hex()
        given = self._call("lease", consumer, repr(now), repr(now + ttl), limit, max_bytes, asked)
        if not given:
            return []
        tk = _robot(given[0])
        return [
            LeasedRecord(
                SealedRecord(RecordId(tk, stream, int.from_bytes(seq, "big")), ciphertext), float(arrived), attempts
            )
            for stream, seq, arrived, attempts, ciphertext in given[1:]
        ]

    def release(self, consumer: str, ids: Iterable[RecordId]) -> None:
        self._for_each(ids, "release", consumer)

    def reclaim(self, consumer: str) -> None:
        self._call("reclaim", consumer)

    def held(self, robot: bytes, limit: int) -> list[SealedRecord]:
        return [
            SealedRecord(RecordId(robot, stream, int.from_bytes(seq, "big")), ciphertext)
            for stream, seq, ciphertext in self._call("held", robot.hex(), limit)
        ]

    def done(self, ids: Iterable[RecordId], now: float) -> None:
        self._for_each(ids, "finish", _CODES[State.DONE], "", repr(now))

    def dead_letter(self, ids: Iterable[RecordId], reason: str, now: float) -> None:
        self._for_each(ids, "finish", _CODES[State.DEAD], reason, repr(now))

    def dead_letters(self, limit: int = 100, *, after: int = 0) -> list[DeadLetter]:
        with self._talking():
            entries: Any = self._redis.xrange(self._prefix + "dead", f"0-{after + 1}", "+", limit)
        return [_dead_letter(fields) for _, fields in entries]

    def state(self, id: RecordId, now: float) -> State:
        return _STATES[self._call("state", repr(now), *_name(id))]

    def statistics(self, now: float) -> InboxStatistics:
        depth, leased, done, dead, held, oldest = self._call("statistics", repr(now))
        return InboxStatistics(depth - leased, leased, done, dead, held, now - float(oldest) if oldest else None)

    def forget(self, done_before: float, limit: int = 10_000) -> int:
        forgotten = 0
        while forgotten < limit:
            group = min(_GROUP, limit - forgotten)
            count = self._call("forget", repr(done_before), group)
            forgotten += count
            if count < group:
                break
        return forgotten

    # Talking to Redis

    def _for_each(self, ids: Iterable[RecordId], operation: str, *arguments: str) -> None:
        names = [_name(id) for id in ids]
        for start in range(0, len(names), _GROUP):
            group = names[start : start + _GROUP]
            self._call(operation, *arguments, *(part for name in group for part in name))

    def _queue(self, to: Any, command: str, script: str, operation: str, arguments: Iterable[Any]) -> Any:
        """On a pipeline, put it in line; on a client, run it. Any: execute_command has no types."""
        return to.execute_command(command, script, 1, self._prefix, operation, *arguments)

    def _call(self, operation: str, *arguments: str | bytes | int) -> Any:
        with self._talking():
            try:
                return self._queue(self._redis, "EVALSHA", _script()[1], operation, arguments)
            except redis.exceptions.NoScriptError:  # a Redis that was started since
                return self._queue(self._redis, "EVAL", _script()[0], operation, arguments)

    def _require_durability(self) -> None:
        with self._talking():
            pipe = self._redis.pipeline(transaction=False)
            _ask_settings(pipe)
            pipe.info("persistence")
            *settings, persistence = pipe.execute()
        self._check(settings)
        if persistence.get("aof_last_write_status") != "ok":
            raise StoreError(
                f"{self._place} cannot write its append-only file; see its log, make room on its disk, start again"
            )

    def _check(self, answers: Sequence[dict[str, str]]) -> None:
        """The settings are those that keep what was confirmed; StoreError with the commands that mend them."""
        found: dict[str, str] = {}
        for answer in answers:
            found |= answer
        wrong = {name: found.get(name) for name, value in _SETTINGS.items() if found.get(name) != value}
        if wrong:
            is_now = ", ".join(f"{name} is {value!r}" for name, value in wrong.items())
            mend = "; ".join(f"CONFIG SET {name} {_SETTINGS[name]}" for name in wrong)
            raise StoreError(
                f"{self._place} could lose records that robots were told are safe: {is_now}."
                f" In redis-cli: {mend}; CONFIG REWRITE"
            )

    @contextmanager
    def _talking(self) -> Iterator[None]:
        try:
            yield
        except redis.RedisError as error:
            raise StoreError(self._trouble(error)) from None

    def _trouble(self, error: redis.RedisError) -> str:
        text = str(error)
        if self._password:
            text = text.replace(str(self._password), "***")
        for kind, says in _TROUBLES:
            if kind(error):
                return f"the inbox in {self._place} cannot be used: {says}"
        if isinstance(error, redis.ConnectionError):
            text = f"{text.rstrip('.')}; start Redis, or correct [store] url"
        return f"the inbox in {self._place} cannot be used: {text}"


def _is(kind: type[redis.RedisError]) -> Callable[[redis.RedisError], bool]:
    return lambda error: isinstance(error, kind)


_TROUBLES: Final[Sequence[tuple[Callable[[redis.RedisError], bool], str]]] = (
    (_is(redis.exceptions.BusyLoadingError), "Redis is still reading its data after a start; wait"),
    (_is(redis.exceptions.AuthenticationError), "it refuses the user name or password in [store] url"),
    (_is(redis.exceptions.NoPermissionError), "its user may not use the commands; docs/howto-redis.md lists them"),
    (_is(redis.exceptions.OutOfMemoryError), "Redis is at its maxmemory; nothing was lost, raise it or let it drain"),
    (_is(redis.exceptions.ReadOnlyError), "it is a replica; give the address of the primary in [store] url"),
    (_is(redis.TimeoutError), f"it does not answer within {ANSWER_TIMEOUT:g} s"),
    (
        lambda error: "LOST" in str(error),
        "its keys are gone while the server ran (FLUSHALL, or a Redis that came back without its append-only file);"
        " restore them from a backup, or restart the server to begin with an empty inbox",
    ),
    (
        lambda error: "DAMAGED" in str(error),
        "its keys do not agree with each other, something else changed them; restore them from a backup",
    ),
)  # fmt: skip
"""What Redis may answer, and what to tell the operator; anything else in Redis's own words."""


def _parts_of(url: str) -> dict[str, Any]:
    """Keyword arguments of a connection pool. StoreError, which does not repeat the URL: a password may stand in it."""
    try:
        parts: dict[str, Any] = dict(parse_url(url))  # type: ignore[no-untyped-call]
    except ValueError:
        raise StoreError(
            "[store] url is not the URL of a Redis; write redis://HOST:6379/0, rediss://… for TLS or"
            " unix:///run/redis/redis.sock, and percent-encode what is not a letter or digit in a password"
        ) from None
    for name in sorted(parts.keys() - _URL_PARTS):
        raise StoreError(f"[store] url: the option {name!r} is not known")
    return parts


def _place_of(parts: dict[str, Any]) -> str:
    """How messages name it: without user and password."""
    where = parts.get("path") or f"{parts.get('host', 'localhost')}:{parts.get('port', 6379)}"
    return f"the Redis at {where} (database {parts.get('db', 0)})"


def _ask_settings(pipe: redis.client.Pipeline) -> None:
    pipe.config_get("*append*")
    pipe.config_get("maxmemory-policy")


def _name(id: RecordId) -> tuple[str, bytes, bytes]:
    return id.robot.hex(), id.stream, id.seq.to_bytes(8, "big")


def _robot(hexadecimal: bytes) -> bytes:
    return bytes.fromhex(hexadecimal.decode())


def _digest(ciphertext: bytes) -> bytes:
    return blake2b(ciphertext, digest_size=16).digest()


def _dead_letter(fields: dict[bytes, bytes]) -> DeadLetter:
    id = RecordId(_robot(fields[b"t"]), fields[b"s"], int.from_bytes(fields[b"q"], "big"))
    return DeadLetter(
        SealedRecord(id, fields[b"c"]), fields[b"x"] == b"1", fields[b"r"].decode(), float(fields[b"a"])
    )
