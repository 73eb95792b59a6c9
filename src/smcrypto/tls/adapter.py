"""`requests` over TLCP or TLS 1.3 with SM algorithms: `session.mount("https://", SMAdapter(context))`.

Needs the package `requests` and its `urllib3`, which no other module imports.
"""

from __future__ import annotations

import functools
import ssl
from typing import Any

from requests.adapters import HTTPAdapter
from urllib3 import PoolManager
from urllib3.connection import HTTPSConnection

from smcrypto.errors import InvalidOption
from smcrypto.tls.alerts import TLSError
from smcrypto.tls.context import SMContext

__all__ = ["SMAdapter"]


class SMAdapter(HTTPAdapter):
    """What a `requests.Session` is to mount for https addresses.

    Whom to trust, and one's own certificates, are `context`'s alone: the arguments `verify` and `cert` of requests
    count for nothing. A handshake that fails is requests.exceptions.SSLError; what fails after it, TLSError.
    A proxy is InvalidOption.
    """

    def __init__(self, context: SMContext, **options: Any) -> None:
        self.context = context
        super().__init__(**options)

    def init_poolmanager(self, connections: int, maxsize: int, block: bool = False, **options: Any) -> None:
        self.poolmanager = _Manager(num_pools=connections, maxsize=maxsize, block=block, **options)
        self.poolmanager.context = self.context

    def proxy_manager_for(self, proxy: str, **_options: Any) -> Any:
        raise InvalidOption(f"SMAdapter goes to servers themselves, not through the proxy {proxy}")


class _Manager(PoolManager):
    context: SMContext

    def _new_pool(self, scheme: str, *arguments: Any, **options: Any) -> Any:
        pool = super()._new_pool(scheme, *arguments, **options)
        if scheme == "https":
            pool.ConnectionCls = functools.partial(_Connection, self.context)  # type: ignore[assignment]
        return pool


class _Connection(HTTPSConnection):
    def __init__(self, context: SMContext, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._sm_context = context

    def connect(self) -> None:
        plain = self._new_conn()
        try:
            self.sock = self._sm_context.wrap_socket(plain, server_hostname=self.host)
        except TLSError as error:
            raise ssl.SSLError(str(error)) from error
        finally:
            plain.close()  # nothing is left in it once it is wrapped
        self.is_verified = True
