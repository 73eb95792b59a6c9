"""The inbox in a Redis: for a server that already runs one, or whose workers are on several machines.

What is acknowledged must be on a disk, so `check` refuses a Redis that may lose or evict it. Keys and script:
redis.lua, beside this file. A Redis that was started anew, or another one that took over, may lack the newest rows;
`append` finds that out by Redis' run_id, and raises InboxExchanged.

A position is the id of an entry of the robot's Stream: milliseconds and a counter, 64 bits each.
"""

from __future__ import annotations

import hashlib
import operator
import secrets
import struct
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from importlib import resources
from typing import Any, Final

import redis
from eth_hash.auto import keccak
from redis.backoff import NoBackoff
from redis.connection import parse_url
from redis.retry import Retry

from rosbridge_eth.errors import StoreError
from rosbridge_eth.inbox import DEAD_LETTERS, DeadLetter, Head, Inbox, InboxExchanged, Outcome, Row, Waiting
from rosbridge_eth.log.chunk import Chunk
from rosbridge_eth.log.database import NothingThere

_OUTCOMES: Final = {"S": Outcome.STORED, "K": Outcome.KNOWN, "D": Outcome.DIFFERENT, "F": Outcome.FULL}
_ROW: Final = struct.Struct(">32s32s24sIIdQQQ")  # see `log` in redis.lua
_SETTINGS: Final = {
    "appendonly": "yes",
    "appendfsync": "always",
    "no-appendfsync-on-rewrite": "no",
    "maxmemory-policy": "noeviction",
}
"""Without any one of these Redis may lose what it has confirmed."""
COMMANDS: Final = {
    "eval": ("return 1", 0), "evalsha": ("0" * 40, 0), "config|get": ("appendonly",), "info": ("server",),
    "hset": ("K", "f", 1), "hget": ("K", "f"), "hmget": ("K", "f"), "hgetall": ("K",), "hincrby": ("K", "f", 1),
    "hdel": ("K", "f"), "exists": ("K",), "set": ("K", 1), "get": ("K",),
    "xadd": ("K", "*", "f", 1), "xdel": ("K", "1-1"), "xtrim": ("K", "MAXLEN", 1), "xrange": ("K", "-", "+"),
    "xrevrange": ("K", "+", "-"), "del": ("K",),
}  # fmt: skip
"""Every command that is used here and in the script, with arguments to try the right to it; K: a key of its own, which
the last one removes."""
_URL_PARTS: Final = frozenset({
    "connection_class", "db", "host", "password", "path", "port", "username",
    "ssl_ca_certs", "ssl_ca_path", "ssl_cert_reqs", "ssl_certfile", "ssl_check_hostname", "ssl_keyfile",
})  # fmt: skip
CONNECT_TIMEOUT = 2.0  # s
ANSWER_TIMEOUT = 5.0  # s; an fsync of a busy disk


@cache
def _script() -> tuple[str, str]:
    """The script and the name Redis knows it by."""
    text = resources.files("rosbridge_eth.inbox").joinpath("redis.lua").read_text(encoding="utf-8")
    return text, hashlib.sha1(text.encode(), usedforsecurity=False).hexdigest()


class RedisInbox(Inbox):
    """`Inbox` in a Redis. An object belongs to one thread; open one per process, after forking.

    Inboxes of other ledgers in the same Redis are apart from it; those of the same one are one. A call that cannot
    be carried out raises StoreError, and the next one connects anew.
    """

    def __init__(
        self, url: str, ledger: bytes, max_bytes: int, max_bytes_per_robot: int, *, read_only: bool = False
    ) -> None:
        self._ledger, self._read_only = ledger, read_only
        self.max_bytes, self.max_bytes_per_robot = max_bytes, max_bytes_per_robot
        parts = _parts_of(url)
        self._password, self._user = parts.get("password"), parts.get("username") or "default"
        where = parts.get("path") or f"{parts.get('host', 'localhost')}:{parts.get('port', 6379)}"
        self._place = f"the Redis at {where} (database {parts.get('db', 0)})"
        self._prefix = f"rosbridge-eth:2:{ledger[:8].hex()}:"
        # No retries: the caller decides what follows a call whose answer was lost. Any: answers have no types.
        pool = redis.ConnectionPool(
            **parts, protocol=2, socket_connect_timeout=CONNECT_TIMEOUT, socket_timeout=ANSWER_TIMEOUT,
            retry=Retry(NoBackoff(), 0),
        )  # fmt: skip
        self._redis: Any = redis.Redis(connection_pool=pool)
        try:
            self._open()
        except BaseException as error:
            if isinstance(error.__context__, redis.ResponseError):
                self._require_rights()
            self.close()
            raise

    def _open(self) -> None:
        with self._talking():
            if self._read_only:
                self.id, ledger = self._redis.hmget(self._prefix + "meta", "id", "ledger")
            else:
                new = ("open", secrets.token_bytes(16), "", "", self._ledger)
                self.id, ledger = self._redis.eval(_script()[0], 1, self._prefix, *new)
            self._run_id = self._redis.info("server")["run_id"]
        if self.id is None:
            self.check()
            raise NothingThere(f"there is no inbox in {self._place} yet")
        if ledger != self._ledger:
            raise StoreError(
                f"the keys {self._prefix}* of {self._place} are of another contract or program; choose another"
                " database of that Redis in [store] url"
            )

    def close(self) -> None:
        self._redis.close()
        self._redis.connection_pool.disconnect()

    # What changes something

    def append(self, chunks: Sequence[tuple[bytes, Chunk]], now: float) -> list[Outcome]:
        calls: dict[bytes, list[Any]] = {} if chunks else {b"": []}
        for tk, chunk in chunks:
            calls.setdefault(tk, [repr(now), self.max_bytes_per_robot, self.max_bytes]).extend(_row(chunk))
        answers = self._run([("append", tk, arguments) for tk, arguments in calls.items()])
        letters = {tk: iter(answer.decode()) for tk, answer in zip(calls, answers, strict=True)}
        return [_OUTCOMES[next(letters[tk])] for tk, _ in chunks]

    def raise_heads(self, tk: bytes, heads: Mapping[bytes, Head]) -> None:
        flat = [part for stream, head in heads.items() for part in (stream, _number(head.number), head.digest)]
        self._run([("raise_heads", tk, flat)])

    def remove(self, tk: bytes, positions: Collection[int], why: str | None = None) -> None:
        self._run([("remove", tk, (tk, why or "", DEAD_LETTERS, *map(_entry, positions)))])

    def _put_in_front(self, tk: bytes, front: Sequence[Chunk], on_chain: set[bytes], now: float) -> None:
        rows = [part for chunk in front for part in _row(chunk)]
        self._run([("put_in_front", tk, (repr(now), len(front), *rows, *on_chain))])

    def _save(self, tk: bytes, text: str) -> None:
        self._run([("save", tk, (text,))])

    # What reads

    def head(self, tk: bytes, stream: bytes) -> Head | None:
        with self._talking():
            found = self._redis.hget(self._key("heads", tk), stream)
        return None if found is None else Head(int.from_bytes(found[:8], "big"), found[8:])

    def sizes(self) -> dict[bytes, int]:
        with self._talking():
            found = self._redis.hgetall(self._prefix + "robots")
        return {bytes.fromhex(robot.decode()): int(size) for robot, size in found.items()}

    def find(self, tk: bytes, hash: bytes) -> int | None:
        with self._talking():
            found = self._redis.hget(self._key("places", tk), hash)
        return None if found is None else _position(found)

    def rows(self, tk: bytes, after: int | None, limit: int) -> list[Row]:
        with self._talking():
            found = self._redis.xrange(self._key("log", tk), _behind(after), "+", limit)
        rows: list[Row] = []
        for entry, fields in found:
            digest, hash, _, size, records, taken_at, *_ = _ROW.unpack(fields[b"r"])
            rows.append(Row(_position(entry), digest, hash, size, taken_at, records))
        return rows

    def chunks(self, tk: bytes, positions: Collection[int]) -> list[bytes]:
        with self._talking():
            pipe = self._redis.pipeline(transaction=False)
            for position in positions:
                pipe.xrange(self._key("log", tk), _entry(position), _entry(position))
            digests = [fields[b"r"][:32] for entries in pipe.execute() for _, fields in entries]
            found = self._redis.hmget(self._key("chunks", tk), digests) if digests else []
        if len(digests) != len(positions) or None in found:
            raise StoreError(f"the inbox in {self._place} has no such row any more")
        return list(found)

    def waiting(self, tk: bytes, after: int | None) -> Waiting:
        with self._talking():
            pipe = self._redis.pipeline(transaction=False)
            pipe.xrange(self._key("log", tk), _behind(after), "+", 1)
            pipe.xrevrange(self._key("log", tk), count=1)
            first, last = pipe.execute()
        if not first:
            return Waiting(0, 0, 0, None)
        _, _, _, size, records, oldest, *begin = _ROW.unpack(first[0][1][b"r"])
        chunks, more_records, more_bytes = map(operator.sub, _ROW.unpack(last[0][1][b"r"])[6:], begin)
        return Waiting(chunks + 1, more_records + records, more_bytes + size, oldest)

    def dead(self, limit: int = 100) -> list[DeadLetter]:
        with self._talking():
            found = self._redis.xrevrange(self._prefix + "dead", count=limit)
        return [DeadLetter(row[b"t"], row[b"w"].decode(), float(row[b"a"]), row[b"c"]) for _, row in found]

    def _load(self, tks: Sequence[bytes]) -> Sequence[str | bytes | None]:
        with self._talking():
            pipe = self._redis.pipeline(transaction=False)
            for tk in tks:
                pipe.get(self._key("state", tk))
            return list(pipe.execute())

    # What is asked of Redis, and talking to it

    def _require_rights(self) -> None:
        missing = dict.fromkeys(right for name in COMMANDS if (right := self._lacks(name)))
        if missing:
            raise StoreError(
                f"{self._place}: its user lacks rights; in redis-cli: ACL SETUSER {self._user} {' '.join(missing)}"
                " (docs/howto-redis.md)"
            )

    def check(self) -> None:
        self._require_rights()
        with self._talking():
            found = self._redis.config_get("*append*") | self._redis.config_get("maxmemory-policy")
            written = self._redis.info("persistence")["aof_last_write_status"]
        wrong = {name: found.get(name) for name, value in _SETTINGS.items() if found.get(name) != value}
        if wrong:
            is_now = ", ".join(f"{name} is {value!r}" for name, value in wrong.items())
            mend = "; ".join(f"CONFIG SET {name} {_SETTINGS[name]}" for name in wrong)
            raise StoreError(
                f"{self._place} could lose chunks that robots were told are safe: {is_now}."
                f" In redis-cli: {mend}; CONFIG REWRITE"
            )
        if written != "ok":
            raise StoreError(
                f"{self._place} cannot write its append-only file; see its log, make room on its disk, start again"
            )

    def _lacks(self, name: str) -> str | None:
        """What the user lacks to use a command, as ACL SETUSER takes it."""
        arguments = (self._prefix + "check" if part == "K" else part for part in COMMANDS[name])
        try:
            with self._talking():
                self._redis.execute_command(*name.split("|"), *arguments)
        except StoreError as error:
            if isinstance(error.__context__, redis.exceptions.NoPermissionError):
                return "~rosbridge-eth:*" if "keys" in str(error) else f"+{name}"
            if not isinstance(error.__context__, redis.ResponseError):  # that would be about the arguments
                raise
        return None

    def _key(self, kind: str, tk: bytes) -> str:
        return f"{self._prefix}{kind}:{tk.hex()}"

    def _run(self, calls: Collection[tuple[str, bytes, Sequence[Any]]]) -> list[Any]:
        """Operations of the script, (name, Tk, arguments), each whole or not at all; their answers."""
        with self._talking():
            pipe = self._redis.pipeline(transaction=False)
            for operation, tk, arguments in calls:
                pipe.evalsha(_script()[1], 1, self._prefix, operation, self.id, self._run_id, tk.hex(), *arguments)
            answers: list[Any] = pipe.execute(raise_on_error=False)
            for answer in answers:
                if isinstance(answer, redis.exceptions.NoScriptError):  # `_open` gave it one: it was started anew
                    raise redis.ResponseError("EXCHANGED")
                if isinstance(answer, Exception):
                    raise answer
        return answers

    @contextmanager
    def _talking(self) -> Iterator[None]:
        """Turn Redis' errors into StoreError, with what to do."""
        try:
            yield
        except redis.RedisError as error:
            if "EXCHANGED" in str(error):
                self._open()
                raise InboxExchanged(f"the inbox in {self._place} was emptied or exchanged, or started anew") from None
            text = str(error).rstrip(".").replace(str(self._password or "\0"), "***")
            if isinstance(error, redis.ConnectionError):
                text += "; start Redis, or correct [store] url"
            raise StoreError(f"the inbox in {self._place} cannot be used: {text}") from None


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


def _row(chunk: Chunk) -> tuple[Any, ...]:
    """A chunk as the script takes it."""
    header, encoded = chunk.header, chunk.encoded
    place = (header.stream, _number(header.number))
    return (*place, header.digest, keccak(encoded), len(encoded), header.records, encoded)


def _number(number: int) -> bytes:
    return number.to_bytes(8, "big")


def _position(entry: bytes) -> int:
    milliseconds, counter = entry.split(b"-")
    return int(milliseconds) << 64 | int(counter)


def _entry(position: int) -> bytes:
    return b"%d-%d" % (position >> 64, position & (2**64 - 1))


def _behind(position: int | None) -> bytes:
    return b"-" if position is None or position < 0 else b"(" + _entry(position)
