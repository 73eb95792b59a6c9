#!/bin/sh
# What compose.yml's `setup` does once: the operator's home, ETH on its account at the local anvil, the contract.
# Run again, it finds what is there. In the environment: NODE, STORE, MONITOR, PUBLIC (the robots' way to the server).
set -eu
if [ ! -e operator/home.json ]; then
    rosbridge-eth init --listen 0.0.0.0:7410 --public "$PUBLIC" --chain "$NODE" \
        --reader-passphrase-file "$CREDENTIALS_DIRECTORY/rosbridge-eth-reader"
    sed -i "s|^\[chain\]|monitor = \"$MONITOR\"\n\n&|" operator/server.toml
    printf '\n[store]\nurl = "%s"\n' "$STORE" >> operator/server.toml
fi
if [ ! -e operator/deployment.json ]; then
    python3 - <<'END'
import json, os
from urllib.request import Request, urlopen
with open("operator/accounts.json") as file:
    account = json.load(file)["operator"]
body = {"jsonrpc": "2.0", "id": 1, "method": "anvil_setBalance", "params": [account, hex(1000 * 10**18)]}
urlopen(Request(os.environ["NODE"], json.dumps(body).encode(), {"Content-Type": "application/json"}), timeout=30)
END
    rosbridge-eth deploy --wait 60
fi
