"""Tongsuo's libssl, which the wheel of `tongsuopy` holds, as a TLS peer over memory: bytes in, bytes out.

The wheel offers no TLS to Python; its one shared object exports libssl's functions,
which ctypes calls. Names are OpenSSL's, and Tongsuo's (NTLS is its name for TLCP).
"""

from __future__ import annotations

import ctypes
import functools
import importlib.util
import socket
from ctypes import CFUNCTYPE, POINTER, byref, c_char_p, c_int, c_long, c_size_t, c_ubyte, c_uint, c_void_p
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from smcrypto import sm2, x509

SUITES = {
    "ECC_SM4_CBC_SM3": "ECC-SM2-SM4-CBC-SM3",
    "ECC_SM4_GCM_SM3": "ECC-SM2-SM4-GCM-SM3",
    "ECDHE_SM4_CBC_SM3": "ECDHE-SM2-SM4-CBC-SM3",
    "ECDHE_SM4_GCM_SM3": "ECDHE-SM2-SM4-GCM-SM3",
    "TLS_SM4_GCM_SM3": "TLS_SM4_GCM_SM3",
    "TLS_SM4_CCM_SM3": "TLS_SM4_CCM_SM3",
}
"""Standard name → Tongsuo's."""

_NAMES = {theirs: standard for standard, theirs in SUITES.items()}

_TLS1_3 = 0x0304
_FILETYPE_ASN1 = 2
_VERIFY_PEER_OR_FAIL = 3  # SSL_VERIFY_PEER | SSL_VERIFY_FAIL_IF_NO_PEER_CERT
_CTRL_SET_TLSEXT_HOSTNAME, _CTRL_SET_GROUPS_LIST = 55, 92
_CTRL_SET_MIN_PROTO_VERSION, _CTRL_SET_MAX_PROTO_VERSION = 123, 124
_ERROR_SSL, _ERROR_WANT_READ, _ERROR_ZERO_RETURN = 1, 2, 6
_ALPN_SELECT = CFUNCTYPE(c_int, c_void_p, POINTER(c_void_p), POINTER(c_ubyte), c_void_p, c_uint, c_void_p)

_SIGNATURES: dict[str, tuple[Any, ...]] = {  # result, arguments
    "SSL_CTX_new": (c_void_p, c_void_p),
    "SSL_CTX_free": (None, c_void_p),
    "SSL_CTX_ctrl": (c_long, c_void_p, c_int, c_long, c_char_p),
    "SSL_CTX_enable_ntls": (None, c_void_p),
    "SSL_CTX_enable_sm_tls13_strict": (None, c_void_p),
    "SSL_CTX_set_cipher_list": (c_int, c_void_p, c_char_p),
    "SSL_CTX_set_ciphersuites": (c_int, c_void_p, c_char_p),
    "SSL_CTX_set_verify": (None, c_void_p, c_int, c_void_p),
    "SSL_CTX_set_session_id_context": (c_int, c_void_p, c_char_p, c_uint),
    "SSL_CTX_set_alpn_protos": (c_int, c_void_p, c_char_p, c_uint),
    "SSL_CTX_set_alpn_select_cb": (None, c_void_p, _ALPN_SELECT, c_void_p),
    "SSL_CTX_get_cert_store": (c_void_p, c_void_p),
    "SSL_CTX_add_client_CA": (c_int, c_void_p, c_void_p),
    "SSL_CTX_use_certificate": (c_int, c_void_p, c_void_p),
    "SSL_CTX_use_PrivateKey": (c_int, c_void_p, c_void_p),
    "SSL_CTX_use_sign_certificate": (c_int, c_void_p, c_void_p),
    "SSL_CTX_use_sign_PrivateKey": (c_int, c_void_p, c_void_p),
    "SSL_CTX_use_enc_certificate": (c_int, c_void_p, c_void_p),
    "SSL_CTX_use_enc_PrivateKey": (c_int, c_void_p, c_void_p),
    "SSL_CTX_set_options": (ctypes.c_ulong, c_void_p, ctypes.c_ulong),
    "X509_STORE_add_cert": (c_int, c_void_p, c_void_p),
    "d2i_X509": (c_void_p, c_void_p, POINTER(c_char_p), c_long),
    "X509_free": (None, c_void_p),
    "d2i_AutoPrivateKey": (c_void_p, c_void_p, POINTER(c_char_p), c_long),
    "EVP_PKEY_free": (None, c_void_p),
    "SSL_new": (c_void_p, c_void_p),
    "SSL_free": (None, c_void_p),
    "SSL_ctrl": (c_long, c_void_p, c_int, c_long, c_char_p),
    "SSL_set_accept_state": (None, c_void_p),
    "SSL_set_connect_state": (None, c_void_p),
    "SSL_set_bio": (None, c_void_p, c_void_p, c_void_p),
    "SSL_set1_host": (c_int, c_void_p, c_char_p),
    "SSL_set_session": (c_int, c_void_p, c_void_p),
    "SSL_get1_session": (c_void_p, c_void_p),
    "SSL_SESSION_free": (None, c_void_p),
    "SSL_session_reused": (c_int, c_void_p),
    "SSL_do_handshake": (c_int, c_void_p),
    "SSL_is_init_finished": (c_int, c_void_p),
    "SSL_read": (c_int, c_void_p, c_char_p, c_int),
    "SSL_write": (c_int, c_void_p, c_char_p, c_int),
    "SSL_shutdown": (c_int, c_void_p),
    "SSL_key_update": (c_int, c_void_p, c_int),
    "SSL_get_error": (c_int, c_void_p, c_int),
    "SSL_get_version": (c_char_p, c_void_p),
    "SSL_get_servername": (c_char_p, c_void_p, c_int),
    "SSL_get_current_cipher": (c_void_p, c_void_p),
    "SSL_CIPHER_get_name": (c_char_p, c_void_p),
    "SSL_get0_alpn_selected": (None, c_void_p, POINTER(c_void_p), POINTER(c_uint)),
    "BIO_s_mem": (c_void_p,),
    "BIO_new": (c_void_p, c_void_p),
    "BIO_read": (c_int, c_void_p, c_char_p, c_int),
    "BIO_write": (c_int, c_void_p, c_char_p, c_int),
    "BIO_ctrl_pending": (c_size_t, c_void_p),
    "ERR_get_error": (ctypes.c_ulong,),
    "ERR_error_string_n": (None, ctypes.c_ulong, c_char_p, c_size_t),
    "ERR_clear_error": (None,),
    **dict.fromkeys(["NTLS_method", "TLS_method"], (c_void_p,)),
}


class TongsuoError(Exception):
    """What Tongsuo's error queue says."""


@functools.cache
def library() -> ctypes.CDLL | None:
    """Tongsuo's functions, or None where the wheel is not installed."""
    package = importlib.util.find_spec("tongsuopy")
    if package is None or package.origin is None:
        return None
    [path] = (Path(package.origin).parent / "backends").glob("_tongsuo*.so")
    loaded = ctypes.CDLL(str(path))
    for name, (result, *arguments) in _SIGNATURES.items():
        function = getattr(loaded, name)
        function.restype, function.argtypes = result, arguments
    return loaded


def _lib() -> ctypes.CDLL:
    loaded = library()
    assert loaded is not None, "tongsuopy is not installed"
    return loaded


def _errors() -> str:
    texts, buffer = [], ctypes.create_string_buffer(256)
    while code := _lib().ERR_get_error():
        _lib().ERR_error_string_n(code, buffer, len(buffer))
        texts.append(buffer.value.decode())
    return "; ".join(texts)


def _checked(result: int | None) -> int:
    """An OpenSSL call's result, which is a positive number or a pointer unless it failed."""
    if not result or result <= 0:
        raise TongsuoError(_errors())
    return result


@dataclass(frozen=True)
class Identity:
    """A signature certificate with its key and, for TLCP, an encryption certificate with its own."""

    certificate: x509.Certificate
    key: sm2.PrivateKey
    encryption_certificate: x509.Certificate | None = None
    encryption_key: sm2.PrivateKey | None = None


@dataclass
class Context:
    """What Tongsuo's SSL_CTX is told. It accepts `suite` alone, and TLCP or TLS 1.3 alone, as the suite says.

    roots: what is trusted; without them the peer's certificate is not asked for, nor looked at. A server of an ECDHE
    suite of TLCP always asks for one (GB/T 38636-2020, 6.4.5.4) and needs them.
    groups: of TLS 1.3, in order of preference; a first one that the peer does not share leads to HelloRetryRequest.
    """

    suite: str
    server: bool
    identity: Identity | None = None
    roots: tuple[x509.Certificate, ...] = ()
    alpn: tuple[str, ...] = ()
    groups: str = "SM2"
    tickets: bool = True
    strict: bool = True
    _held: list[Any] = field(default_factory=list)

    def __post_init__(self) -> None:
        lib = _lib()
        lib.ERR_clear_error()
        tlcp = not self.suite.startswith("TLS_")
        self.handle = ctx = _checked(lib.SSL_CTX_new(lib.NTLS_method() if tlcp else lib.TLS_method()))
        name = SUITES[self.suite].encode()
        if tlcp:
            lib.SSL_CTX_enable_ntls(ctx)
            _checked(lib.SSL_CTX_set_cipher_list(ctx, name))
        else:
            if self.strict:
                lib.SSL_CTX_enable_sm_tls13_strict(ctx)
            _checked(lib.SSL_CTX_ctrl(ctx, _CTRL_SET_MIN_PROTO_VERSION, _TLS1_3, None))
            _checked(lib.SSL_CTX_ctrl(ctx, _CTRL_SET_MAX_PROTO_VERSION, _TLS1_3, None))
            _checked(lib.SSL_CTX_set_ciphersuites(ctx, name))
            _checked(lib.SSL_CTX_ctrl(ctx, _CTRL_SET_GROUPS_LIST, 0, self.groups.encode()))
        if not self.tickets:
            lib.SSL_CTX_set_options(ctx, 1 << 14)  # SSL_OP_NO_TICKET
        _checked(lib.SSL_CTX_set_session_id_context(ctx, b"tests", 5))
        if self.identity is not None:
            self._use(self.identity, tlcp)
        for root in self.roots:
            certificate = _certificate(root)
            _checked(lib.X509_STORE_add_cert(lib.SSL_CTX_get_cert_store(ctx), certificate))
            if self.server:
                _checked(lib.SSL_CTX_add_client_CA(ctx, certificate))
            lib.X509_free(certificate)
        if self.roots:
            lib.SSL_CTX_set_verify(ctx, _VERIFY_PEER_OR_FAIL, None)
        if self.alpn:
            wire = b"".join(bytes([len(p)]) + p.encode() for p in self.alpn)
            if self.server:
                self._held.append(_ALPN_SELECT(functools.partial(_select, [p.encode() for p in self.alpn], self._held)))
                lib.SSL_CTX_set_alpn_select_cb(ctx, self._held[-1], None)
            else:
                assert lib.SSL_CTX_set_alpn_protos(ctx, wire, len(wire)) == 0

    def _use(self, identity: Identity, tlcp: bool) -> None:
        pairs = [("sign_" if tlcp else "", identity.certificate, identity.key)]
        if tlcp and identity.encryption_certificate and identity.encryption_key:
            pairs.append(("enc_", identity.encryption_certificate, identity.encryption_key))
        lib = _lib()
        for kind, certificate, key in pairs:
            pointer, secret = _certificate(certificate), _private_key(key)
            _checked(getattr(lib, f"SSL_CTX_use_{kind}certificate")(self.handle, pointer))
            _checked(getattr(lib, f"SSL_CTX_use_{kind}PrivateKey")(self.handle, secret))
            lib.X509_free(pointer)
            lib.EVP_PKEY_free(secret)

    def __del__(self) -> None:
        if hasattr(self, "handle"):
            _lib().SSL_CTX_free(self.handle)


def _select(
    ours: list[bytes], held: list[Any], _ssl: int, out: Any, length: Any, offered: int, size: int, _argument: int
) -> int:
    wire = ctypes.string_at(offered, size)
    theirs = []
    while wire:
        theirs.append(wire[1 : 1 + wire[0]])
        wire = wire[1 + wire[0] :]
    for protocol in ours:
        if protocol in theirs:
            held.append(ctypes.create_string_buffer(protocol))
            out[0], length[0] = ctypes.addressof(held[-1]), len(protocol)
            return 0
    return 2  # SSL_TLSEXT_ERR_ALERT_FATAL


def _certificate(certificate: x509.Certificate) -> int:
    encoded = certificate.to_der()
    return _checked(_lib().d2i_X509(None, byref(c_char_p(encoded)), len(encoded)))


def _private_key(key: sm2.PrivateKey) -> int:
    encoded = key.to_der()
    return _checked(_lib().d2i_AutoPrivateKey(None, byref(c_char_p(encoded)), len(encoded)))


class Session:
    """Tongsuo's session, to be resumed."""

    def __init__(self, handle: int) -> None:
        self.handle = handle

    def __del__(self) -> None:
        _lib().SSL_SESSION_free(self.handle)


class Peer:
    """One connection. `receive` what came, then `handshake`, `read`, `write`; `to_send` is what goes out."""

    def __init__(self, context: Context, *, server_name: str | None = None, session: Session | None = None) -> None:
        lib = _lib()
        lib.ERR_clear_error()
        self.context = context  # lives as long as this
        self.ssl = _checked(lib.SSL_new(context.handle))
        self._in, self._out = lib.BIO_new(lib.BIO_s_mem()), lib.BIO_new(lib.BIO_s_mem())
        lib.SSL_set_bio(self.ssl, self._in, self._out)
        (lib.SSL_set_accept_state if context.server else lib.SSL_set_connect_state)(self.ssl)
        if server_name is not None:
            _checked(lib.SSL_ctrl(self.ssl, _CTRL_SET_TLSEXT_HOSTNAME, 0, server_name.encode()))
            _checked(lib.SSL_set1_host(self.ssl, server_name.encode()))
        if session is not None:
            _checked(lib.SSL_set_session(self.ssl, session.handle))

    def __del__(self) -> None:
        if hasattr(self, "ssl"):
            _lib().SSL_free(self.ssl)

    def receive(self, data: bytes) -> None:
        if data:
            assert _lib().BIO_write(self._in, data, len(data)) == len(data)

    def to_send(self) -> bytes:
        size = _lib().BIO_ctrl_pending(self._out)
        buffer = ctypes.create_string_buffer(size + 1)
        if size:
            assert _lib().BIO_read(self._out, buffer, size) == size
        return buffer.raw[:size]

    def _done(self, result: int) -> bool:
        """Whether the call is through; False where it waits for more from the other side."""
        if result > 0:
            return True
        error = _lib().SSL_get_error(self.ssl, result)
        if error == _ERROR_WANT_READ:
            return False
        raise TongsuoError(_errors() or f"SSL_get_error: {error}")

    def handshake(self) -> bool:
        """One step; True once the handshake is complete."""
        _lib().ERR_clear_error()
        return self._done(_lib().SSL_do_handshake(self.ssl))

    def handshake_over(self, plain: socket.socket) -> None:
        """The whole handshake with who is at the other end of a socket."""
        while not self.handshake():
            plain.sendall(self.to_send())
            self.receive(plain.recv(1 << 16))
        plain.sendall(self.to_send())

    def read(self) -> bytes:
        """All that can be read now; EOFError at the other side's close_notify, where nothing stands before it."""
        received, buffer = b"", ctypes.create_string_buffer(1 << 14)
        while True:
            _lib().ERR_clear_error()
            size = _lib().SSL_read(self.ssl, buffer, len(buffer))
            if size <= 0:
                if _lib().SSL_get_error(self.ssl, size) == _ERROR_ZERO_RETURN:
                    if not received:
                        raise EOFError
                    return received
                self._done(size)
                return received
            received += buffer.raw[:size]

    def write(self, data: bytes) -> None:
        assert self._done(_lib().SSL_write(self.ssl, data, len(data)))

    def key_update(self, *, requested: bool) -> None:
        """Goes out with the next `write`."""
        _checked(_lib().SSL_key_update(self.ssl, 1 if requested else 0))

    def close(self) -> None:
        """close_notify."""
        _lib().SSL_shutdown(self.ssl)

    @property
    def suite(self) -> str:
        """By its standard name."""
        return _NAMES[_lib().SSL_CIPHER_get_name(_lib().SSL_get_current_cipher(self.ssl)).decode()]

    @property
    def version(self) -> str:
        return str(_lib().SSL_get_version(self.ssl).decode())

    @property
    def resumed(self) -> bool:
        return bool(_lib().SSL_session_reused(self.ssl))

    @property
    def server_name(self) -> str | None:
        """What the client asked for."""
        name = _lib().SSL_get_servername(self.ssl, 0)
        return None if name is None else str(name.decode())

    @property
    def alpn(self) -> str | None:
        pointer, length = c_void_p(), c_uint()
        _lib().SSL_get0_alpn_selected(self.ssl, byref(pointer), byref(length))
        return ctypes.string_at(pointer.value, length.value).decode() if pointer.value else None

    @property
    def session(self) -> Session:
        return Session(_checked(_lib().SSL_get1_session(self.ssl)))
