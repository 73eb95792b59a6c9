"""Makes transcripts.json beside it: a whole handshake of each mode, a state and a message, with every secret.

Run from the repository: PYTHONPATH=src:tests python tests/vectors/channel/make_transcripts.py

Only needed when the protocol changes. tests/bridge/channel/test_transcripts.py
computes every value again with code of its own.
"""

from __future__ import annotations

import json
from hashlib import blake2s
from pathlib import Path
from typing import Any

from bridge.channel.steps import HERE, Steps
from bridge.channel.world import SERVER_ADDRESS, hub, make_client, make_server, robot, wall
from rosbridge_eth.channel import ClientConfig, Mode, Randomness, ServerConfig, handshake
from smcrypto import sm2


def numbered(label: str) -> Randomness:
    """Random-looking bytes that anybody can make again; for vectors alone."""
    count = 0

    def draw(size: int) -> bytes:
        nonlocal count
        count += 1
        return blake2s(f"{label} {count}".encode()).digest()[:size]

    def key() -> sm2.PrivateKey:
        return sm2.PrivateKey.from_bytes(b"\0" + draw(31))

    return Randomness(draw, key)


def transcript(mode: Mode) -> dict[str, Any]:
    captured: list[tuple[bytes, bytes]] = []
    ephemeral: list[bytes] = []
    real = handshake.SessionSecrets

    class Captured(real):  # type: ignore[misc, valid-type]
        __slots__ = ()

        def __init__(self, shared: bytes, digest: bytes, agreed: Mode) -> None:
            captured.append((shared, digest))
            super().__init__(shared, digest, agreed)

    def remembering(source: Randomness) -> Randomness:
        def key() -> sm2.PrivateKey:
            made = source.private_key()
            ephemeral.append(made.to_bytes())
            return made

        return Randomness(source.bytes, key)

    handshake.SessionSecrets = Captured  # type: ignore[misc]
    try:
        steps = Steps(
            mode,
            server=make_server(
                1000.0, ServerConfig(modes=(mode,)), randomness=remembering(numbered(f"server {mode.name}"))
            ),
            client=make_client(
                1000.0, ClientConfig(mode=mode), randomness=remembering(numbered(f"client {mode.name}"))
            ),
        ).until_connected()
    finally:
        handshake.SessionSecrets = real  # type: ignore[misc]
    (shared, digest), again = captured
    if (shared, digest) != again:
        raise RuntimeError("the two ends do not agree")
    steps.server.set_state(steps.connection, b"the first state")
    [state] = steps.to_server()
    steps.to_client(state)
    [message] = steps.sent(b"the first message")
    server_secrets = real(shared, digest, mode)
    return {
        "source": "rosbridge_eth, docs/channel.md",
        "mode": mode.name.lower(),
        "client_address": list(HERE),
        "server_address": list(SERVER_ADDRESS),
        "client_encryption_key": robot().encryption_key.to_bytes().hex(),
        "client_signing_public": robot().signing_key.public_key.to_bytes().hex(),
        "server_encryption_key": hub().encryption_key.to_bytes().hex(),
        "server_signing_public": hub().signing_key.public_key.to_bytes().hex(),
        "client_ephemeral_key": ephemeral[0].hex() if ephemeral else "",
        "server_ephemeral_key": ephemeral[1].hex() if ephemeral else "",
        "hello": steps.hello.hex(),
        "cookie": steps.cookie.hex(),
        "proof": [data.hex() for data in steps.proof],
        "offer": [data.hex() for data in steps.offer],
        "first": steps.first.hex(),
        "answer": [data.hex() for data in steps.answer],
        "state": state.hex(),
        "state_data": b"the first state".hex(),
        "message": message.hex(),
        "message_payload": b"the first message".hex(),
        "server_time_ms": int(wall().timestamp() * 1000),
        "shared": shared.hex(),
        "h3": digest.hex(),
        "client_secret": server_secrets.client.hex(),
        "server_secret": server_secrets.server.hex(),
    }


if __name__ == "__main__":
    path = Path(__file__).parent / "transcripts.json"
    document = {
        "generator": "make_transcripts.py",
        "verified_with": "tests/bridge/channel/test_transcripts.py: textbook SM2 on affine points, SM3 of OpenSSL, "
        "SM4 of cryptography with a textbook GHASH",
        "tests": [transcript(mode) for mode in Mode],
    }
    path.write_text(json.dumps(document, indent=1) + "\n")
