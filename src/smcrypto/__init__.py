"""SM2, SM3 and SM4, the Chinese commercial algorithms, in pure Python.

`sm2` signature, key exchange, encryption (GB/T 32918) · `sm3` hash
(GB/T 32905) · `sm4` block cipher, modes, AEAD (GB/T 32907, 17964) · `kdf` key
derivation · `x509` certificates · `cms` signed and enveloped messages
(GB/T 35275) · `pkcs12` files · `tls` connections (TLCP, TLS 1.3) · `cfca`
requests · `diagnose` what somebody gave you. Importing the package loads none
of them: each arrives with its first use.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING

from smcrypto.errors import (
    AlreadyFinalized,
    CertificateError,
    ConfirmationError,
    InvalidCiphertext,
    InvalidEncoding,
    InvalidKey,
    InvalidLength,
    InvalidOption,
    InvalidPadding,
    InvalidSignature,
    InvalidTag,
    MissingDependency,
    OutOfOrder,
    SMCryptoError,
)

if TYPE_CHECKING:
    from . import cfca as cfca
    from . import cms as cms
    from . import kdf as kdf
    from . import ocsp as ocsp
    from . import pkcs12 as pkcs12
    from . import sm2 as sm2
    from . import sm3 as sm3
    from . import sm4 as sm4
    from . import timestamp as timestamp
    from . import tls as tls
    from . import x509 as x509
    from .diagnosis import diagnose as diagnose

__version__ = "0.1.0"

__all__ = [
    "AlreadyFinalized", "CertificateError", "ConfirmationError", "InvalidCiphertext", "InvalidEncoding", "InvalidKey",
    "InvalidLength", "InvalidOption", "InvalidPadding", "InvalidSignature", "InvalidTag", "MissingDependency",
    "OutOfOrder", "SMCryptoError", "cfca", "cms", "diagnose", "kdf", "ocsp", "pkcs12", "sm2", "sm3", "sm4", "timestamp",
    "tls", "x509",
]  # fmt: skip

_MODULES = frozenset({"cfca", "cms", "kdf", "ocsp", "pkcs12", "sm2", "sm3", "sm4", "timestamp", "tls", "x509"})


def __getattr__(name: str) -> ModuleType | Callable[..., object]:
    if name == "diagnose":
        from smcrypto.diagnosis import diagnose

        return diagnose
    if name in _MODULES:
        return import_module(f"smcrypto.{name}")
    raise AttributeError(f"module 'smcrypto' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *_MODULES, "diagnose"})
