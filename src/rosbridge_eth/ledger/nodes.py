"""Chains to begin with: one inside this process, and anvil (Foundry's development node) as a process of its own."""

from __future__ import annotations

import ast
import sys
import threading
from collections.abc import Mapping
from typing import Any

_recursion_limit = sys.getrecursionlimit()
from web3.middleware import combine_middleware  # noqa: E402
from web3.providers.eth_tester import EthereumTesterProvider  # noqa: E402

_CALLER = "0x7E5F4552091A69125d5DfCb7b8C2659029395Bdf"  # eth-tester's first account, in whose name it makes calls


class EmbeddedChain(EthereumTesterProvider):
    """eth-tester's chain (py-evm) for Ledger.connect and Ledger.deploy. It ends with the process.

    Every transaction gets a block at once. Safe to use from several threads.
    """

    def __init__(self, fund: Mapping[str, int] | None = None, *, gas_limit: int = 30_000_000) -> None:
        """fund: wei of these accounts at the beginning."""
        from eth_tester import EthereumTester, PyEVMBackend  # type: ignore[import-untyped, unused-ignore]
        from eth_utils.address import to_canonical_address

        wealth = {_CALLER: 10**27} | dict(fund or {})
        state = {
            to_canonical_address(account): {"balance": wei, "nonce": 0, "code": b"", "storage": {}}
            for account, wei in wealth.items()
        }
        backend = PyEVMBackend(PyEVMBackend.generate_genesis_params({"gas_limit": gas_limit}), state)
        super().__init__(EthereumTester(backend))
        # py-evm raises the limit of the whole process so far that deeply nested JSON would overflow the C stack.
        # It wants it for calls within calls 1,024 deep; the contract here makes none.
        sys.setrecursionlimit(_recursion_limit)
        self._lock = threading.RLock()
        # What web3 puts between itself and eth-tester, for requests that come in a batch.
        self._formatted = combine_middleware(self._middleware, None, self.make_request)  # type: ignore[arg-type]

    def make_request(self, method: Any, params: Any) -> Any:
        """As a node answers: failures are errors of JSON-RPC, a revert with its data."""
        from eth_tester.exceptions import TransactionFailed  # type: ignore[import-untyped, unused-ignore]

        with self._lock:
            try:
                return super().make_request(method, params)
            except TransactionFailed as error:
                said = str(error).removeprefix("execution reverted: ")  # the data is there as Python shows bytes
                data = {"data": "0x" + ast.literal_eval(said).hex()} if said[:2] in ("b'", 'b"') else {}
                answer = {"code": 3, "message": f"execution reverted: {said}"} | data
            except Exception as error:  # of many classes: eth-tester's, py-evm's, eth_utils'
                answer = {"code": -32000, "message": str(error) or type(error).__name__}
            return {"jsonrpc": "2.0", "id": 0, "error": answer}

    def make_batch_request(self, requests: Any) -> Any:
        return [self._formatted(method, params) for method, params in requests]
