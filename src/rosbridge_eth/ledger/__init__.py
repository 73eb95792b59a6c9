"""The ledger: the contract, the chains it runs on, and how chunks get there and come back.

    ledger = Ledger.connect("http://127.0.0.1:8545", deployment)      or Ledger.deploy(...)
    ledger.data_events(tk, first_block, last_block), ledger.registrations(tk, standing)

web3, py-evm and eth-account are imported where they are first needed, so that
commands which talk to no node start fast.
"""

from rosbridge_eth.ledger.accounts import Keyring
from rosbridge_eth.ledger.contract import DataEvent, Ledger, RegistrationEvent, Standing

__all__ = ["DataEvent", "Keyring", "Ledger", "RegistrationEvent", "Standing"]
