"""SM4, GB/T 32907-2016: the block cipher, its modes (GB/T 17964-2021), and authenticated encryption (RFC 8998).

`SM4GCM` is what new designs want: it hides and protects. `encrypt`, `decrypt`
and `Cipher` with `ECB`, `CBC`, `CFB`, `OFB`, `CTR`, `XTS` are for formats that
already exist; `Cipher` with `GCM` for what does not fit in memory. `cmac` and
`cbc_mac` authenticate. `SM4` is the bare block.

`ENGINE` says what computes: "cryptography" where that package is installed, else "python", as under SMCRYPTO_PURE=1.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from smcrypto.sm4.cipher import SM4
from smcrypto.sm4.foreign import ENGINE as _ENGINE
from smcrypto.sm4.mac import cbc_mac, cmac
from smcrypto.sm4.modes import CBC, CFB, CTR, ECB, GCM, OFB, XTS, Cipher, CipherStream, Mode, decrypt, encrypt

if TYPE_CHECKING:
    from smcrypto.sm4.aead import SM4CCM, SM4GCM

    ENGINE: str

__all__ = [
    "CBC", "CFB", "CTR", "ECB", "ENGINE", "GCM", "OFB", "SM4", "SM4CCM", "SM4GCM", "XTS", "Cipher", "CipherStream",
    "Mode", "cbc_mac", "cmac", "decrypt", "encrypt",
]  # fmt: skip


def __getattr__(name: str) -> type | str:
    """SM4GCM and SM4CCM arrive with their first use: most programs want either a mode or an AEAD. ENGINE may change."""
    if name == "ENGINE":
        return _ENGINE.name
    if name in ("SM4CCM", "SM4GCM"):
        from smcrypto.sm4 import aead

        aead_class: type = getattr(aead, name)
        return aead_class
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
