"""HTTP to a node that may be slow, broken or hostile; and what went wrong, sorted by what the caller can do about it.

requests has a timeout for each read and none for an answer, and takes bodies of
any size. The adapter here gives every answer a deadline and a limit, and hands
the JSON error of an HTTP 4xx or 5xx to web3, which would show the status alone.

Nodes say the same thing in different words, mostly under one code (-32000).
TABLE is matched in order, without regard to case. Where the words are from:

    geth     core/txpool/errors.go, core/error.go, core/vm/errors.go
    anvil    crates/anvil/core, crates/anvil/src/eth/error.rs (Foundry)
    others   Nethermind's AcceptTxResult, Besu's RpcErrorType, Erigon's txpoolcfg
    py-evm   eth/validation.py, eth/vm/base.py
"""

from __future__ import annotations

import functools
import http.client
import io
import re
import socket
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlsplit

import requests
from requests.adapters import HTTPAdapter

from rosbridge_eth.errors import ChainError, ConfigError

MAX_ANSWER = 64 * 2**20  # bytes; the events of a full block are a tenth of it
AT_ONCE = 50  # requests in one HTTP request
_PIECE = 64 * 1024


class ChainUnavailable(ChainError):
    """No answer, a refusal, or an answer that cannot be used. The same request may succeed later."""


class TooMuch(ChainUnavailable):
    """The node, or the limit here, wants events asked for in smaller pieces."""


class AlreadyKnown(ChainError):
    """The node has this very transaction: as good as accepted."""


class NonceTooLow(ChainError):
    """The account has gone past this nonce."""


class Underpriced(ChainError):
    """The fee is too low: for the node, for the next block, or to replace what has this nonce."""


class OutOfFunds(ChainError):
    """The account cannot pay for gas limit * fee + value."""


class Reverted(ChainError):
    """The contract refuses. `name` is its error, '' where it gave none."""

    def __init__(self, message: str, name: str = "") -> None:
        super().__init__(message)
        self.name = name


TABLE: tuple[tuple[type[ChainError], str], ...] = (
    (AlreadyKnown, r"already known|already imported|(?<!un)known transaction|alreadyknown|already exists"),
    (NonceTooLow, r"nonce too low|nonce too old|oldnonce|nonce .*is lower than|invalid transaction nonce"),
    (
        Underpriced,
        r"underpriced|fee too low|feetoolow|max fee per gas less than block base fee|lower than block's base fee|"
        r"gas price too low|gas price below|max priority fee per gas higher|replacementnotallowed|tip .*too low",
    ),
    (OutOfFunds, r"insufficient ?(funds|balance)|upfront cost exceeds|not enough funds|sender.* account balance"),
    (Reverted, r"revert"),
    (
        TooMuch,
        r"block range|range too (wide|large)|range.*exceed|too many results|more than \d+ results|"
        r"query returned more|response (size|too large)|log response",
    ),
)
_PATTERNS = tuple((kind, re.compile(pattern, re.IGNORECASE | re.DOTALL)) for kind, pattern in TABLE)


def limit_recursion() -> None:
    """Put Python's limit back, which py_ecc (imported by web3 and eth_account) and py-evm raise for the whole process.

    With theirs, JSON nested deeply enough overflows the C stack, which no exception handler survives.
    """
    sys.setrecursionlimit(1000)


def classify(message: object) -> ChainError:
    """The error that a node's words stand for."""
    words = printable(message)
    return next((kind(words) for kind, pattern in _PATTERNS if pattern.search(words)), ChainUnavailable(words))


def printable(text: object, limit: int = 300) -> str:
    """A stranger's words on one line, without control characters."""
    return "".join(c if c.isprintable() else " " for c in str(text)[:limit]).strip()


def shown(url: str) -> str:
    """A node's address as people see it: without password and path, which may hold an access key."""
    parts = urlsplit(url)
    return f"{parts.scheme}://{parts.netloc.rpartition('@')[2]}"


def _is_url(text: str) -> bool:
    try:
        parts = urlsplit(text)
        return parts.scheme in ("http", "https") and bool(parts.hostname) and parts.port != 0
    except ValueError:  # brackets that do not close, a port beyond 65,535
        return False


# ---------------------------------------------------------------------- deadline and limit


class _Timed(io.RawIOBase):
    """A socket's bytes until a moment of time.monotonic()."""

    def __init__(self, raw: io.RawIOBase, sock: socket.socket, deadline: float) -> None:
        self._raw, self._sock, self._deadline = raw, sock, deadline

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int | None:
        left = self._deadline - time.monotonic()
        if left <= 0:
            raise TimeoutError("the answer took too long")
        self._sock.settimeout(left)
        return self._raw.readinto(buffer)

    def close(self) -> None:
        self._raw.close()
        super().close()


class _Response(http.client.HTTPResponse):
    def __init__(self, deadline: float, sock: socket.socket, *args: Any, **options: Any) -> None:
        super().__init__(sock, *args, **options)
        raw: Any = self.fp
        self.fp = io.BufferedReader(_Timed(raw.detach(), sock, deadline))


class _DeadlineMixin:
    """A connection whose timeout is that of a whole answer, from its first byte on."""

    def getresponse(self) -> Any:
        connection: Any = self
        connection.response_class = functools.partial(_Response, time.monotonic() + connection.timeout)
        return super().getresponse()  # type: ignore[misc]


def _set_deadline(manager: Any) -> None:
    """The connections of these pools are such ones."""
    pools = {}
    for scheme, pool in manager.pool_classes_by_scheme.items():
        connection = type("Connection", (_DeadlineMixin, pool.ConnectionCls), {})
        pools[scheme] = type("Pool", (pool,), {"ConnectionCls": connection})
    manager.pool_classes_by_scheme = pools


class BoundedAdapter(HTTPAdapter):
    """Answers of at most `limit` bytes, unpacked; the deadline is the request's timeout."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        super().__init__()

    def init_poolmanager(self, *args: Any, **options: Any) -> None:
        super().init_poolmanager(*args, **options)
        _set_deadline(self.poolmanager)

    def proxy_manager_for(self, proxy: str, **options: Any) -> Any:
        if proxy not in self.proxy_manager:
            _set_deadline(super().proxy_manager_for(proxy, **options))
        return self.proxy_manager[proxy]

    def send(self, request: Any, *args: Any, **options: Any) -> requests.Response:
        response = super().send(request, *args, **(options | {"stream": True}))
        body = bytearray()
        try:
            for piece in response.iter_content(_PIECE):
                body += piece
                if len(body) > self._limit:
                    raise TooMuch(f"an answer of more than {self._limit} bytes")
        finally:
            response.close()
        response._content = bytes(body)
        if response.status_code >= 400 and b'"jsonrpc"' in body:
            response.status_code = 200
        return response


def session(limit: int = MAX_ANSWER) -> requests.Session:
    """A session for one node; every request of it is to be given a timeout."""
    made = requests.Session()
    adapter = BoundedAdapter(limit)
    made.mount("http://", adapter)
    made.mount("https://", adapter)
    return made


# ---------------------------------------------------------------------- requests


class Node:
    """web3 on a node, without the middleware that asks for the chain id before every call and wraps every answer."""

    def __init__(self, where: Any, timeout: float, abi: Sequence[Mapping[str, Any]]) -> None:
        """where: a URL, or a provider of web3. abi: of the contract whose errors are told by name.

        ConfigError where the URL is none of a node.
        """
        from web3 import HTTPProvider, Web3
        from web3.middleware import ExtraDataToPOAMiddleware

        limit_recursion()
        self._abi, self._session, self.url = abi, None, "embedded"
        if isinstance(where, str):
            if not _is_url(where):
                raise ConfigError('this is no URL of a node: write "http://127.0.0.1:8545" or "https://..."')
            self.url, self._session = shown(where), session()
            options = {"timeout": timeout, "allow_redirects": False}
            where = HTTPProvider(where, options, self._session, exception_retry_configuration=None)
        where.global_ccip_read_enabled = False  # EIP-3668: a node's error would have us fetch any URL it names
        self.w3 = Web3(where, middleware=[ExtraDataToPOAMiddleware])

    def close(self) -> None:
        if self._session is not None:
            self._session.close()

    def many(self, requests: Sequence[tuple[str, list[Any]]], at_once: int = AT_ONCE) -> list[Any]:
        """The answers to many requests in few HTTP requests; a ChainError in the place of one that was refused."""
        answers: list[Any] = []
        for start in range(0, len(requests), at_once):
            page: Any = list(requests[start : start + at_once])
            with self.asking():
                got: Any = self.w3.provider.make_batch_request(page)  # type: ignore[attr-defined]
                if not isinstance(got, list) or len(got) != len(page):
                    raise self._error(got.get("error", "no batches") if isinstance(got, dict) else "a wrong count")
                answers += [self._error(answer["error"]) if answer.get("error") else answer["result"] for answer in got]
        return answers

    @contextmanager
    def asking(self) -> Iterator[None]:
        """What web3, requests or our own checks make of a node's answer becomes a ChainError."""
        from web3.exceptions import ContractLogicError, Web3RPCError

        try:
            yield
        except ChainError:
            raise
        except ContractLogicError as error:
            raise self._error({"message": f"execution reverted: {error.message}", "data": error.data}) from error
        except Web3RPCError as error:
            raise self._error((error.rpc_response or {}).get("error", str(error))) from error
        except requests.RequestException as error:
            why = f"{self.url} does not answer ({_reason(error)}); start that node, or name another"
            raise ChainUnavailable(why) from error
        except Exception as error:  # a stranger's words went through five libraries, each with errors of its own
            words = printable(error) or type(error).__name__
            raise ChainUnavailable(f"{self.url} gave an answer that cannot be used: {words}") from error

    def _error(self, error: Any) -> ChainError:
        """The error object of a JSON-RPC answer."""
        message, data = (error.get("message"), error.get("data")) if isinstance(error, dict) else (error, None)
        found = classify(message)
        if isinstance(found, Reverted):
            return self._reverted(data) or Reverted(f"the contract refuses: {found}")
        return type(found)(f"{self.url}: {found}")

    def _reverted(self, data: Any) -> Reverted | None:
        """The contract's own error, where `data` holds one."""
        from eth_abi.abi import decode
        from eth_abi.exceptions import DecodingError
        from eth_hash.auto import keccak

        try:
            code = bytes.fromhex(str(data.get("data") if isinstance(data, dict) else data).removeprefix("0x"))
            for item in self._abi:
                types = [entry["type"] for entry in item.get("inputs", ())]
                if item["type"] == "error" and keccak(f"{item['name']}({','.join(types)})".encode())[:4] == code[:4]:
                    values = decode(types, code[4:])
                    named = zip((entry["name"] for entry in item["inputs"]), values, strict=True)
                    words = ", ".join(f"{n} 0x{v.hex()}" if isinstance(v, bytes) else f"{n} {v}" for n, v in named)
                    return Reverted(f"the contract refuses: {item['name']}({words})", item["name"])
        except (DecodingError, ValueError):
            pass
        return None


def _reason(error: requests.RequestException) -> str:
    """Why there was no answer, in few words: requests' own repeat the address and an object's repr."""
    if isinstance(error, requests.HTTPError) and error.response is not None:
        return f"HTTP {error.response.status_code} {printable(error.response.reason, 60)}".strip()
    words = printable(error, 1000)
    last = words.rsplit(": ", 1)[-1].rstrip("')\"")
    return "too slow" if "timed out" in words else re.sub(r"^\[Errno -?\d+\] ", "", last)


def natural(value: Any, end: int = 2**63) -> int:
    """A number below `end`, or hexadecimal for one; else ValueError."""
    number = int(value, 16) if isinstance(value, str) else value
    if not isinstance(number, int) or isinstance(number, bool) or not 0 <= number < end:
        raise ValueError(f"{printable(value, 40)} where a number was expected")
    return number


def bytes32(value: Any) -> bytes:
    """32 bytes, or hexadecimal for them; else ValueError or TypeError."""
    found = bytes.fromhex(value.removeprefix("0x")) if isinstance(value, str) else bytes(value)
    if len(found) != 32:
        raise ValueError(f"{len(found)} bytes where 32 were expected")
    return found
