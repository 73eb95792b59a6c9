"""The store in a Redis, or in a Redis Cluster where it must outlive a machine: on servers only.

What is acknowledged must be on a disk, so `check` refuses a Redis that may lose or evict it. One that comes back
without its newest writes, or whose replica takes over, says a lower head: by the rule, robots send the rest again.

Keys begin with "rosbridge-eth:3:<ledger>:", so that stores of several contracts may share a Redis; {TK} is the robot's
Tk in hex, a hash tag, so that a cluster has all keys of a robot on one node, and a script touches those of one alone.

    robots     set      Tk of all of which there ever was a row or a state
    {TK}:log   sorted   places of the rows, and perhaps of what is no row: score 0, so they order as bytes
    {TK}:rows  hash     head, digest, base, confirmed, block, hold, certificates: the state
                        taken, gone: bytes of all rows ever taken, and ever removed
                        r place: digest 32 | keccak256 32 | size 4 | records 4 | taken at 8, a double; longer: removed
                        c place: the chunk, d digest, h keccak256: the place
    {TK}:dead  sorted   dead letters: taken at 8 | bytes of why 2 | why | chunk, by the time they became so

A Redis that was killed within a script may carry out its first commands again, some time later (7.0.15 does, two starts
on). So nothing is counted up: every command sets what it names, and what belongs together is set by one HSET.

At `maxmemory` Redis refuses a script's first write if it takes memory, and looks at no other. `append` begins with
one that does, and is refused whole; the others begin with one that frees, and go through: a full Redis drains.
"""

from __future__ import annotations

import struct
import sys
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager, suppress
from operator import itemgetter
from typing import Any, Final

import redis
from eth_hash.auto import keccak
from redis.backoff import NoBackoff
from redis.cluster import RedisCluster
from redis.connection import parse_url
from redis.exceptions import ClusterError, OutOfMemoryError, RedisClusterException
from redis.retry import Retry

from rosbridge_eth.errors import StoreError
from rosbridge_eth.log.store import DEAD_LETTERS, DeadLetter, Offer, Outcome, Row, State, Store, Waiting, place_of

_APPEND: Final = """
local log, rows = KEYS[1], KEYS[2]
local call, outcomes, full = redis.call, {}, false
local head, newest, taken, gone = unpack(call('HMGET', rows, 'head', 'digest', 'taken', 'gone'))
head, newest, taken = head or string.rep('\\0', 24), newest or string.rep('\\0', 32), tonumber(taken or 0)
local room = ARGV[1] + (gone or 0) - taken

local function above(a, b) -- Lua's own comparison asks the locale
  for i = 1, 24 do if a:byte(i) ~= b:byte(i) then return a:byte(i) > b:byte(i) end end
  return false
end

local function digest_at(place) -- of a row
  local row = call('HGET', rows, 'r' .. place)
  return row and #row == 80 and row:sub(1, 32)
end

local function behind(place) -- the first row there
  repeat place = call('ZRANGEBYLEX', log, '(' .. place, '+', 'LIMIT', 0, 1)[1] until not place or digest_at(place)
  return place
end

for i = 2, #ARGV, 9 do -- as the docstring of Store.append has it
  local place, one_before, previous, after, digest, hash, size, row, chunk = unpack(ARGV, i, i + 8)
  local there, outcome = digest_at(place), 'S'
  if there and there ~= digest or place == head and newest ~= digest then
    outcome = 'D'
  elseif not above(place, head) then
    local first = behind(string.rep('\\0', 24))
    outcome = (there or place == head or not first or above(first, place)) and 'K' or 'D'
  else
    if previous ~= newest then
      local named = call('HGET', rows, 'd' .. previous)
      named = named and digest_at(named) and named
      local following = named and behind(named)
      if one_before == head or named and (above(head, named) or following and above(place, following)) then
        outcome = 'D'
      elseif after ~= newest and not full then
        outcome = 'N'
      end
    end
    if outcome == 'S' and there then outcome = 'K'
    elseif outcome == 'S' and (full or tonumber(size) > room) then full, outcome = true, 'F' end
    if outcome == 'S' or outcome == 'K' then
      head, newest = place, digest
      if outcome == 'S' then
        taken, room = taken + size, room - size
        call('ZADD', log, 0, place)
        call('HSET', rows, 'r' .. place, row, 'c' .. place, chunk, 'd' .. digest, place, 'h' .. hash, place,
          'head', head, 'digest', newest, 'taken', string.format('%.0f', taken))
      else
        call('HSET', rows, 'head', head, 'digest', newest)
      end
    end
  end
  outcomes[#outcomes + 1] = outcome
end
return table.concat(outcomes)"""

_REMOVE: Final = """
local log, rows, dead = unpack(KEYS)
local call, why, letters = redis.call, ARGV[1], tonumber(ARGV[2])
local gone, now = tonumber(call('HGET', rows, 'gone') or 0), call('TIME')
call('HDEL', rows, '') -- frees, if nothing
for i = 3, #ARGV do
  local place, row = ARGV[i], call('HGET', rows, 'r' .. ARGV[i])
  if row then
    local digest, hash, size, _, taken_at = struct.unpack('>c32c32I4I4c8', row)
    if #row == 80 then
      if why ~= '' then
        local letter = taken_at .. struct.pack('>I2', #why) .. why .. call('HGET', rows, 'c' .. place)
        call('ZADD', dead, now[1] * 1e6 + now[2] + i, letter)
        call('ZREMRANGEBYRANK', dead, 0, -letters - 1)
      end
      gone = gone + size
      call('HSET', rows, 'r' .. place, row .. '-', 'gone', string.format('%.0f', gone))
    end
    call('HDEL', rows, 'c' .. place, 'd' .. digest, 'h' .. hash, 'r' .. place)
  end
  call('ZREM', log, place)
end"""

_SAVE: Final = """
redis.call('HDEL', KEYS[2], '') -- frees, if nothing
redis.call('HSET', KEYS[2], unpack(ARGV))"""

_OUTCOMES: Final = {
    "S": Outcome.STORED, "K": Outcome.KNOWN, "N": Outcome.NOT_NEXT, "D": Outcome.DIFFERENT, "F": Outcome.FULL,
}  # fmt: skip
_ROW: Final = struct.Struct(">32s32sIId")
_AT_ONCE: Final = 500
"""Chunks that one script takes, and rows that one answer holds."""
_SETTINGS: Final = {
    "appendonly": "yes",
    "appendfsync": "always",
    "no-appendfsync-on-rewrite": "no",
    "maxmemory-policy": "noeviction",
}
"""Without any one of these Redis may lose what it has confirmed."""
COMMANDS: Final = {
    "multi": (), "exec": (), "eval": ("return 1", 0), "config|get": ("appendonly",), "info": ("server",), "time": (),
    "hset": ("K", "f", 1), "hget": ("K", "f"), "hmget": ("K", "f"), "hdel": ("K", "f"), "zadd": ("K", 0, "m"),
    "zrem": ("K", "m"), "zrangebylex": ("K", "-", "+"), "zrevrange": ("K", 0, 0), "zremrangebyrank": ("K", 0, 0),
    "sadd": ("K", "m"), "smembers": ("K",), "cluster|slots": (), "command": (), "del": ("K",),
}  # fmt: skip
"""Every command that is used here, in the scripts and by a cluster's client, with arguments to try the right to it.
K: a key of its own, which the last one removes."""
_RIGHTS: Final = " ".join(["~rosbridge-eth:*", "+client", "+select", *(f"+{name}" for name in COMMANDS)])
"""What the user may do, as ACL SETUSER takes it."""
_NO_RIGHT: Final = "permissions"
"""In every error of a Redis that refuses a command for want of a right, also in that of a transaction."""
_URL_PARTS: Final = frozenset({
    "connection_class", "db", "host", "password", "path", "port", "username",
    "ssl_ca_certs", "ssl_ca_path", "ssl_cert_reqs", "ssl_certfile", "ssl_check_hostname", "ssl_keyfile",
})  # fmt: skip
CONNECT_TIMEOUT = 2.0  # s
ANSWER_TIMEOUT = 5.0  # s; an fsync of a busy disk


class RedisStore(Store):
    """`Store` in a Redis. An object belongs to one thread; open one per process, after forking.

    Stores of other ledgers in the same Redis are apart from it; those of the same one are one. A call that cannot be
    carried out raises StoreError, and the next one connects again.
    """

    def __init__(self, url: str, ledger: bytes, max_bytes: int, max_bytes_per_robot: int) -> None:
        self.max_bytes, self.max_bytes_per_robot = max_bytes, max_bytes_per_robot
        parts = _parts_of(url)
        self._password, self._user = parts.get("password"), parts.get("username") or "default"
        self._prefix = f"rosbridge-eth:3:{ledger.hex()}:"
        settings: dict[str, Any] = {
            "protocol": 2, "socket_connect_timeout": CONNECT_TIMEOUT, "socket_timeout": ANSWER_TIMEOUT,
        }  # fmt: skip
        # No retries: the caller decides what follows a call whose answer was lost. Any: answers have no types.
        pool = redis.ConnectionPool(**parts, **settings, retry=Retry(NoBackoff(), 0))
        self._redis: Any = redis.Redis(connection_pool=pool)
        self._where = _where(self._redis)
        try:
            with self._talking():
                self._cluster = bool(self._redis.info("cluster")["cluster_enabled"])
                if self._cluster:
                    self._try_rights(self._redis)
                    self._redis.close()
                    self._redis = RedisCluster.from_url(url, **settings, retry=Retry(NoBackoff(), 1))
        except StoreError:
            self.close()
            raise

    def close(self) -> None:
        self._redis.close()

    # What changes something

    def append(self, offers: Sequence[Offer], now: float) -> list[Outcome]:
        calls: dict[bytes, list[Any]] = {}
        for tk, chunk, after in offers:
            header, encoded, hash = chunk.header, chunk.encoded, keccak(chunk.encoded)
            row = _ROW.pack(header.digest, hash, len(encoded), header.records, now)
            before = header.stream + ((header.number - 1) % 2**64).to_bytes(8, "big")
            calls.setdefault(tk, []).append(
                (place_of(header), before, header.previous, after, header.digest, hash, len(encoded), row, encoded)
            )
        scripts = [(_APPEND, 2, tk, [self.max_bytes_per_robot, *(part for row in rows for part in row)])
                   for tk, rows in calls.items()]  # fmt: skip
        letters = dict[bytes, Iterator[str]]()
        for (tk, rows), answer in zip(calls.items(), self._run(scripts) if scripts else [], strict=True):
            letters[tk] = iter("F" * len(rows) if isinstance(answer, OutOfMemoryError) else answer.decode())
        return [_OUTCOMES[next(letters[tk])] for tk, _, _ in offers]

    def set_state(self, tk: bytes, **changes: Any) -> None:
        [known] = self.states([tk])
        if known != known._replace(**changes):
            self._run([(_SAVE, 2, tk, [part for change in changes.items() for part in change])])

    def remove(self, tk: bytes, places: Collection[bytes], why: str = "") -> None:
        self._run([(_REMOVE, 3, tk, [why, DEAD_LETTERS, *places])])

    def _run(self, scripts: Sequence[tuple[str, int, bytes, Sequence[Any]]]) -> list[Any]:
        """Run scripts, (text, how many of the robot's keys, Tk, arguments), each whole or not at all; their answers.

        An append for which Redis has no memory answers OutOfMemoryError.
        """
        with self._talking():
            with suppress(OutOfMemoryError):
                self._redis.sadd(self._prefix + "robots", *(tk for _, _, tk, _ in scripts))
            try:  # as a transaction it is one fsync, where Redis makes one for every 16 KiB that it reads
                answers = self._piped(scripts, transaction=len(scripts) > 1 and not self._cluster)
            except OutOfMemoryError:  # it is refused whole; each script begins as it has to for this
                answers = self._piped(scripts, transaction=False)
            for answer in answers:
                if isinstance(answer, Exception) and not isinstance(answer, OutOfMemoryError):
                    raise answer
        return answers

    def _piped(self, scripts: Sequence[tuple[str, int, bytes, Sequence[Any]]], *, transaction: bool) -> list[Any]:
        pipe = self._redis.pipeline(transaction=transaction)
        for script, keys, tk, arguments in scripts:
            names = [self._key(kind, tk) for kind in ("log", "rows", "dead")[:keys]]
            pipe.execute_command("EVAL", script, keys, *names, *arguments)
        return list(pipe.execute(raise_on_error=transaction))

    # What looks

    def _ask(self, *commands: tuple[Any, ...]) -> list[Any]:
        """The answers to commands, asked at once."""
        with self._talking():
            pipe = self._redis.pipeline(transaction=False)
            for command in commands:
                pipe.execute_command(*command)
            return list(pipe.execute()) if commands else []

    def _robots(self) -> list[bytes]:
        [found] = self._ask(("SMEMBERS", self._prefix + "robots"))
        return sorted(found)

    def states(self, tks: Sequence[bytes]) -> list[State]:
        found = self._ask(*(("HMGET", self._key("rows", tk), *State._fields) for tk in tks))
        return [State(*(_parsed(*pair) for pair in zip(values, State(), strict=True))) for values in found]

    def _place(self, tk: bytes, index: bytes) -> bytes | None:
        """Where an entry of the index of rows leads, if there is a row."""
        [place] = self._ask(("HGET", self._key("rows", tk), index))
        return place if place and self._rows(tk, [place]) else None

    def find(self, tk: bytes, hash: bytes) -> bytes | None:
        return self._place(tk, b"h" + hash)

    def has(self, tk: bytes, digest: bytes) -> bool:
        return self._place(tk, b"d" + digest) is not None

    def _rows(self, tk: bytes, places: Sequence[bytes]) -> list[Row]:
        [found] = self._ask(("HMGET", self._key("rows", tk), *(b"r" + place for place in places)))
        pairs = zip(places, found, strict=True)
        return [Row(place, *_ROW.unpack(row)) for place, row in pairs if row and len(row) == _ROW.size]

    def rows(self, tk: bytes, after: bytes, limit: int) -> list[Row]:
        rows = list[Row]()
        while len(rows) < limit:
            begin = ("ZRANGEBYLEX", self._key("log", tk), b"(" + after, "+", "LIMIT", 0)
            [places] = self._ask((*begin, min(_AT_ONCE, limit - len(rows))))
            if not places:
                break
            rows += self._rows(tk, places)
            after = places[-1]
        return rows

    def chunks(self, tk: bytes, places: Sequence[bytes]) -> list[bytes]:
        found = self._ask(*(("HGET", self._key("rows", tk), b"c" + place) for place in places))
        if None in found:
            raise StoreError(f"the store in {self._where} has no such row any more")
        return found

    def sizes(self) -> dict[bytes, int]:
        robots = self._robots()
        found = self._ask(*(("HMGET", self._key("rows", tk), "taken", "gone") for tk in robots))
        return {tk: int(taken or 0) - int(gone or 0) for tk, (taken, gone) in zip(robots, found, strict=True)}

    def waiting(self, tk: bytes) -> Waiting:
        [state] = self.states([tk])
        rows = self.rows(tk, state.confirmed, sys.maxsize)
        records, size = sum(row.records for row in rows), sum(row.size for row in rows)
        return Waiting(len(rows), records, size, min((row.taken_at for row in rows), default=None))

    def dead(self, limit: int = 100) -> list[DeadLetter]:
        robots = self._robots()
        found = self._ask(*(("ZREVRANGE", self._key("dead", tk), 0, limit - 1, "WITHSCORES") for tk in robots))
        letters = list[tuple[float, DeadLetter]]()
        for tk, answer in zip(robots, found, strict=True):
            for letter, at in zip(answer[::2], answer[1::2], strict=True):
                taken_at, size = struct.unpack_from(">dH", letter)
                why = letter[10 : 10 + size].decode()
                letters.append((float(at), DeadLetter(tk, why, taken_at, letter[10 + size :])))
        return [letter for _, letter in sorted(letters, key=itemgetter(0), reverse=True)[:limit]]

    # What is asked of Redis, and talking to it

    def check(self) -> None:
        with self._talking():
            nodes = [self._redis]
            if self._cluster:  # replicas, too: each may have to hold what is stored here
                nodes = [self._redis.get_redis_connection(node) for node in self._redis.get_nodes()]
            for node in nodes:
                self._try_rights(node)
                found = node.config_get("*append*") | node.config_get("maxmemory-policy")
                wrong = [f"CONFIG SET {name} {value}" for name, value in _SETTINGS.items() if found.get(name) != value]
                if wrong:
                    raise StoreError(
                        f"{_where(node)} could lose chunks that robots were told are safe."
                        f" In redis-cli: {'; '.join(wrong)}; CONFIG REWRITE"
                    )
                if node.info("persistence")["aof_last_write_status"] != "ok":
                    raise StoreError(
                        f"{_where(node)} cannot write its append-only file; see its log, make room on its disk, start"
                        " again"
                    )

    def _try_rights(self, node: Any) -> None:
        """redis.ResponseError unless the user may use every command."""
        for name, arguments in COMMANDS.items():
            try:
                given = (self._prefix + "check" if argument == "K" else argument for argument in arguments)
                node.execute_command(*name.split("|"), *given)
            except redis.ResponseError as error:
                if _NO_RIGHT in str(error):  # else it is about the arguments
                    raise

    def _key(self, kind: str, tk: bytes) -> str:
        return f"{self._prefix}{{{tk.hex()}}}:{kind}"

    @contextmanager
    def _talking(self) -> Iterator[None]:
        """Turn Redis' errors into StoreError, with what to do."""
        try:
            yield
        except (redis.RedisError, RedisClusterException) as error:
            text = str(error).rstrip(".").replace(str(self._password or "\0"), "***")
            if _NO_RIGHT in text:
                text += f"; in redis-cli: ACL SETUSER {self._user} {_RIGHTS} (docs/howto-redis.md)"
            elif not isinstance(error, redis.ResponseError) or isinstance(error, ClusterError):
                text += "; start Redis, or correct [store] url"
            raise StoreError(f"the store in {self._where} cannot be used: {text}") from None


def _where(node: Any) -> str:
    parts = node.connection_pool.connection_kwargs
    where = parts.get("path") or f"{parts.get('host', 'localhost')}:{parts.get('port', 6379)}"
    return f"the Redis at {where} (database {parts.get('db', 0)})"


def _parsed(value: bytes | None, default: object) -> Any:
    """A field of the state as Redis keeps it."""
    if value is None or isinstance(default, bytes):
        return default if value is None else value
    return int(value) if isinstance(default, int) else value.decode()


def _parts_of(url: str) -> dict[str, Any]:
    """Keyword arguments of a connection pool. StoreError, which does not repeat the URL: a password may stand in it."""
    try:
        parts: dict[str, Any] = dict(parse_url(url))  # type: ignore[no-untyped-call]
        if parts.keys() - _URL_PARTS:
            raise ValueError(parts)
    except ValueError:
        raise StoreError(
            "[store] url is not the URL of a Redis, or has an option that is not known; write redis://HOST:6379/0,"
            " rediss://… for TLS or unix:///run/redis/redis.sock, and percent-encode what is not a letter or digit in a"
            " password"
        ) from None
    return parts
