"""Which certificates are trusted, and each reason for which one is not: RFC 5280, 6.1."""

from __future__ import annotations

from datetime import datetime, timedelta
from types import SimpleNamespace

import pytest

from der_variants import unchecked
from smcrypto import CertificateError, InvalidOption, InvalidSignature, der, sm2, x509
from vectors_json import load
from x509_authority import BEGIN, END, NOW, Holder, certificates, root

ROOT = root(path_length=3)
SUB = ROOT.ca("sub", path_length=0)
LEAF = SUB.issue("leaf")


def verify(leaf: Holder | x509.Certificate, *intermediates: Holder, roots: list[Holder] | None = None, **options):
    leaf = leaf.certificate if isinstance(leaf, Holder) else leaf
    trusted = certificates(*([ROOT] if roots is None else roots))
    return x509.verify_chain(leaf, intermediates=certificates(*intermediates), roots=trusted, **({"at": NOW} | options))


def refused(reason: str, *arguments, **options) -> None:
    with pytest.raises(CertificateError, match=reason):
        verify(*arguments, **options)


def test_the_path_is_returned_leaf_first() -> None:
    assert verify(LEAF, SUB) == tuple(certificates(LEAF, SUB, ROOT))


def test_superfluous_intermediates_and_roots_do_no_harm() -> None:
    others = [ROOT.ca("other"), root("stranger"), ROOT, LEAF]
    assert verify(LEAF, *others, SUB, SUB, roots=[root("stranger"), ROOT]) == tuple(certificates(LEAF, SUB, ROOT))


def test_a_missing_intermediate() -> None:
    refused("no known issuer CN=sub for CN=leaf", LEAF)


def test_no_roots_at_all() -> None:
    refused("no trusted root CN=root", LEAF, SUB, ROOT, roots=[])


def test_an_untrusted_root() -> None:
    refused("no trusted root", LEAF, SUB, ROOT, roots=[root("stranger")])


def test_a_root_of_the_same_name_and_another_key() -> None:
    refused("no known issuer", LEAF, SUB, roots=[root("root")])  # the key identifiers differ
    bare = Holder(ROOT.key, without_extension(ROOT, "2.5.29.14"))
    leaf = bare.issue("leaf")  # carries no key identifier to tell the keys apart
    impostor = root("root")
    refused("signature", leaf, roots=[Holder(impostor.key, without_extension(impostor, "2.5.29.14"))])


def without_extension(holder: Holder, oid: str) -> x509.Certificate:
    kept = [e for e in holder.certificate.extensions if e.oid != oid]
    return with_extensions(holder, kept, holder)


def with_extensions(holder: Holder, extensions: list[x509.Extension], signer: Holder) -> x509.Certificate:
    """The certificate with other extensions, signed again by its issuer."""
    body = unchecked(holder.certificate.tbs_certificate).sequence()
    fields = [body.raw() for _ in range(7)]
    return signer.resigned(der.sequence(*fields, der.explicit(3, der.sequence(*(e.to_der() for e in extensions)))))


@pytest.mark.parametrize(
    ("error", "make"),
    [
        (x509.CertificateExpiredError, lambda: verify(LEAF, SUB, at=END + timedelta(seconds=1))),
        (x509.CertificateNotYetValidError, lambda: verify(LEAF, SUB, at=BEGIN - timedelta(seconds=1))),
        (x509.CertificateUnknownIssuerError, lambda: verify(LEAF)),
        (x509.CertificateUnknownIssuerError, lambda: verify(LEAF, SUB, roots=[])),
        (x509.CertificateUsageError, lambda: verify(LEAF, SUB, key_usage="keyAgreement")),
        (x509.CertificateUsageError, lambda: verify(SUB.issue("s", extended_key_usage=["serverAuth"]), SUB,
                                                    extended_key_usage="clientAuth")),
        (x509.CertificateSignatureError, lambda: verify(LEAF, SUB, uid=b"another")),
        (x509.CertificateRevokedError, lambda: verify(LEAF, SUB, crls=[SUB.crl(LEAF)])),
    ],
)  # fmt: skip
def test_each_reason_has_its_error(error: type[CertificateError], make) -> None:
    with pytest.raises(CertificateError) as raised:
        make()
    assert type(raised.value) is error


# --- trust ---


def test_a_self_signed_leaf_is_trusted_only_as_a_root() -> None:
    alone = root("alone", ca=False)
    refused("no trusted root CN=alone for CN=alone", alone, alone)
    assert verify(alone, roots=[alone]) == (alone.certificate,)


def test_a_leaf_that_is_itself_a_root_needs_no_issuer() -> None:
    assert verify(LEAF, roots=[LEAF]) == (LEAF.certificate,)


def test_an_intermediate_may_be_the_root_of_trust() -> None:
    assert verify(LEAF, roots=[SUB]) == tuple(certificates(LEAF, SUB))


def test_what_is_trusted_is_the_certificate_not_its_name() -> None:
    refused("no trusted root", LEAF, SUB, ROOT, roots=[root("root")])


# --- the issuer must be a CA: 6.1.4 k to n ---


def test_an_issuer_without_ca_basic_constraints() -> None:
    end_entity = ROOT.issue("end entity", key_usage=("keyCertSign",))
    refused("CN=end entity is not a CA", end_entity.forge("leaf"), end_entity)


def test_an_issuer_without_basic_constraints() -> None:
    holder = Holder(SUB.key, with_extensions(SUB, [SUB.certificate.extensions[1]], ROOT))
    assert holder.certificate.basic_constraints is None and holder.certificate.key_usage
    refused("CN=sub is not a CA", LEAF, holder)


def test_a_root_that_is_not_a_ca() -> None:
    not_ca = root("plain", ca=False)
    refused("CN=plain is not a CA", not_ca.forge("leaf"), roots=[not_ca])


def test_a_version_1_root() -> None:
    key = sm2.PrivateKey.generate()
    template = unchecked(root("v1", key=key).certificate.tbs_certificate).sequence()
    template.raw()
    body = der.sequence(*(template.raw() for _ in range(6)))
    old = Holder(key, Holder(key, ROOT.certificate).resigned(body))
    assert old.certificate.version == 1 and old.certificate.extensions == ()
    refused("CN=v1 is not a CA", old.forge("leaf"), roots=[old])


def test_an_issuer_without_key_cert_sign() -> None:
    ca = ROOT.ca("crl signer", key_usage=("cRLSign", "digitalSignature"))
    refused("no keyCertSign", ca.forge("leaf"), ca)


def test_an_issuer_without_key_usage_at_all_may_sign() -> None:
    ca = ROOT.ca("any usage", key_usage=())
    assert len(verify(ca.issue("leaf"), ca)) == 3


# --- path length: 4.2.1.9 ---


def test_path_length_0_allows_end_entities_only() -> None:
    below = SUB.ca("below")
    refused("CN=sub allows 0 intermediates, not 1", below.issue("leaf"), below, SUB)


def test_path_length_1_allows_one_intermediate() -> None:
    a = ROOT.ca("a", path_length=1)
    b = a.ca("b")
    c = b.ca("c")
    assert len(verify(b.issue("leaf"), a, b)) == 4
    refused("CN=a allows 1 intermediates, not 2", c.issue("leaf"), a, b, c)


def test_the_last_certificate_does_not_count_even_if_it_is_a_ca() -> None:
    assert len(verify(SUB.ca("below"), SUB)) == 3


def test_the_path_length_of_the_root_counts() -> None:
    strict = root("strict", path_length=0)
    sub = strict.ca("sub")
    assert len(verify(strict.issue("leaf"), roots=[strict])) == 2
    refused("CN=strict allows 0", sub.issue("leaf"), sub, roots=[strict])


def test_self_issued_certificates_do_not_count() -> None:
    strict = root("roll", path_length=1)
    renewed = strict.ca("roll", path_length=0)  # the same name under a new key: self-issued
    sub = strict.ca("sub")
    assert len(verify(renewed.issue("leaf"), renewed, roots=[strict])) == 3
    assert len(verify(sub.issue("leaf"), sub, roots=[strict])) == 3
    zero = root("zero", path_length=0)
    again = zero.ca("zero")
    assert len(verify(again.issue("leaf"), again, roots=[zero])) == 3


# --- validity: 6.1.3 a 2 ---


@pytest.mark.parametrize(
    ("at", "reason"),
    [
        (BEGIN - timedelta(seconds=1), "CN=leaf is not valid before"),
        (END + timedelta(seconds=1), "CN=leaf expired at"),
        (END + timedelta(microseconds=1), "CN=leaf expired at"),
    ],
)
def test_outside_validity(at: datetime, reason: str) -> None:
    refused(reason, LEAF, SUB, at=at)


@pytest.mark.parametrize("at", [BEGIN, END])
def test_both_ends_of_validity_belong_to_it(at: datetime) -> None:
    assert len(verify(LEAF, SUB, at=at)) == 3


def test_an_expired_intermediate() -> None:
    old = ROOT.ca("old", not_after=NOW - timedelta(seconds=1))
    refused("CN=old expired", old.forge("leaf"), old)


def test_an_expired_root() -> None:
    old = root("old root", not_after=NOW - timedelta(seconds=1))
    refused("CN=old root expired", old.forge("leaf"), roots=[old])


@pytest.mark.parametrize("at", [datetime(2026, 6, 1), NOW.replace(tzinfo=None)])
def test_a_naive_time_is_refused(at: datetime) -> None:
    with pytest.raises(InvalidOption, match="aware"):
        verify(LEAF, SUB, at=at)


@pytest.mark.parametrize("at", ["2026-06-01", 0, None, NOW.date()])
def test_what_is_no_time_is_a_type_error(at) -> None:
    with pytest.raises(TypeError):
        verify(LEAF, SUB, at=at)


# --- extensions: 6.1.4 o, 6.1.5 f ---

UNKNOWN = x509.Extension("1.2.3.4.5", True, der.null())


def test_an_unknown_critical_extension_in_the_leaf() -> None:
    refused(r"CN=leaf has the critical extension 1\.2\.3\.4\.5", ROOT.issue("leaf", extensions=[UNKNOWN]))


def test_an_unknown_critical_extension_in_an_intermediate() -> None:
    ca = ROOT.ca("odd", extensions=[UNKNOWN])
    refused("CN=odd has the critical extension", ca.issue("leaf"), ca)


def test_an_unknown_critical_extension_in_the_root() -> None:
    odd = root("odd root", extensions=[UNKNOWN])
    refused("CN=odd root has the critical extension", odd.issue("leaf"), roots=[odd])


def test_an_unknown_extension_that_is_not_critical_is_no_matter() -> None:
    plain = x509.Extension(UNKNOWN.oid, False, UNKNOWN.value)
    assert len(verify(ROOT.issue("leaf", extensions=[plain]))) == 2


NAMES = der.sequence(der.explicit(0, der.sequence(der.implicit(2, b"example.com"))))


@pytest.mark.parametrize("critical", [True, False])
def test_name_constraints_are_refused_because_they_are_not_applied(critical: bool) -> None:
    ca = ROOT.ca("constrained", extensions=[x509.Extension("2.5.29.30", critical, NAMES)])
    refused("critical extension|name constraints", ca.issue("leaf", subject_alt_names=["DNS:example.org"]), ca)


def test_critical_policies_are_allowed_and_constraints_of_policies_are_not() -> None:
    """RFC 5280, 6.1.1 c and e: with any-policy accepted and none required, policies alone never fail a path."""
    policies = x509.Extension("2.5.29.32", True, der.sequence(der.sequence(der.oid("1.2.3"))))
    assert len(verify(ROOT.issue("leaf", extensions=[policies]))) == 2
    required = x509.Extension("2.5.29.36", True, der.sequence(der.implicit(0, b"\0")))
    ca = ROOT.ca("ca", extensions=[policies, required])
    refused(r"critical extension 2\.5\.29\.36", ca.issue("leaf"), ca)


# --- names and key identifiers ---


def test_a_name_that_does_not_chain() -> None:
    other = root("other", key=ROOT.key)  # the very key that signed, under another name
    refused("no known issuer CN=root for CN=sub", LEAF, SUB, roots=[other])


def test_names_chain_without_regard_to_case_and_blanks() -> None:
    signer = Holder(ROOT.key, root("My  ROOT ", key=ROOT.key).certificate)
    trusted = root("my root", key=ROOT.key)
    assert len(verify(signer.issue("leaf"), roots=[trusted])) == 2


def test_a_key_identifier_that_does_not_match() -> None:
    identifier = x509.Extension("2.5.29.35", False, der.sequence(der.implicit(0, bytes(20))))
    kept = [e for e in LEAF.certificate.extensions if e.oid != "2.5.29.35"]
    refused("no known issuer", with_extensions(LEAF, [*kept, identifier], SUB), SUB)


def test_an_authority_named_by_serial_number() -> None:
    kept = [e for e in LEAF.certificate.extensions if e.oid != "2.5.29.35"]
    names = der.explicit(4, ROOT.certificate.subject.to_der()) + der.implicit(2, b"other kinds are skipped")
    serial = der.integer(SUB.certificate.serial_number)[2:]
    right = x509.Extension("2.5.29.35", False, der.sequence(der.explicit(1, names), der.implicit(2, serial)))
    wrong = x509.Extension("2.5.29.35", False, der.sequence(der.explicit(1, names), der.implicit(2, b"\x07")))
    certificate = with_extensions(LEAF, [*kept, right], SUB)
    assert certificate.authority_key_identifier is not None
    assert certificate.authority_key_identifier.issuer == ROOT.certificate.subject
    assert len(verify(certificate, SUB)) == 3
    refused("no known issuer", with_extensions(LEAF, [*kept, wrong], SUB), SUB)


def test_a_leaf_without_key_identifier_finds_its_issuer_by_name() -> None:
    kept = [e for e in LEAF.certificate.extensions if e.oid != "2.5.29.35"]
    assert len(verify(with_extensions(LEAF, kept, SUB), SUB)) == 3


# --- signatures ---


def test_every_altered_byte_of_the_leaf_is_noticed() -> None:
    for certificate, intermediates in ((LEAF.certificate, [SUB]), (SUB.certificate, [])):
        data = certificate.to_der()
        for position in range(len(data)):
            altered = bytearray(data)
            altered[position] ^= 1 << position % 8
            with pytest.raises(CertificateError):
                verify(x509.Certificate.from_der(altered), *intermediates)


def test_an_altered_intermediate() -> None:
    data = SUB.certificate.to_der()
    altered = x509.Certificate.from_der(data[:-1] + bytes([data[-1] ^ 1]))
    with pytest.raises(CertificateError) as caught:
        verify(LEAF, Holder(SUB.key, altered))
    assert isinstance(caught.value, InvalidSignature) and "CN=sub" in str(caught.value)


def test_every_signature_is_verified_under_the_given_uid() -> None:
    uid = b"fleet-7"
    top = root("top", uid=uid)
    sub = top.ca("sub", uid=uid)
    mixed = top.ca("sub", uid=b"another")
    leaf = sub.issue("leaf", uid=uid)
    assert len(verify(leaf, sub, roots=[top], uid=uid)) == 3
    refused("signature of the certificate of CN=leaf", leaf, sub, roots=[top])
    refused("signature of the certificate of CN=sub", mixed.issue("leaf", uid=uid), mixed, roots=[top], uid=uid)


ECDSA_WITH_SHA256 = der.sequence(der.oid("1.2.840.10045.4.3.2"))
SM2_WITH_SM3 = der.sequence(der.oid("1.2.156.10197.1.501"))


def test_an_unsupported_signature_algorithm() -> None:
    body = LEAF.certificate.tbs_certificate.replace(SM2_WITH_SM3, ECDSA_WITH_SHA256)
    certificate = SUB.resigned(der.sequence(unchecked(body).sequence() and _content(body)), ECDSA_WITH_SHA256)
    refused("not signed with SM2-with-SM3", certificate, SUB)


def _content(body: bytes) -> bytes:
    """The members of a sequence whose length no longer fits them."""
    header = 4 if body[1] == 0x82 else 3
    return body[header:]


def test_null_parameters_of_the_algorithm_are_accepted() -> None:
    with_null = der.sequence(der.oid("1.2.156.10197.1.501"), der.null())
    body = LEAF.certificate.tbs_certificate.replace(SM2_WITH_SM3, with_null)
    assert len(verify(SUB.resigned(der.sequence(_content(body)), with_null), SUB)) == 3


# --- purposes and usages ---


def test_a_purpose_that_the_leaf_does_not_have() -> None:
    server = SUB.issue("server", extended_key_usage=["serverAuth", "1.2.3.4"])
    for wanted in ("serverAuth", "1.3.6.1.5.5.7.3.1", ("serverAuth", "1.2.3.4"), None, ()):
        assert len(verify(server, SUB, extended_key_usage=wanted)) == 3
    for wanted in ("clientAuth", ("serverAuth", "clientAuth"), "1.2.3.5"):
        refused("CN=server is not for", server, SUB, extended_key_usage=wanted)


def test_a_ca_that_restricts_purposes_restricts_what_is_below_it() -> None:
    clients = ROOT.ca("clients", extended_key_usage=["clientAuth"])
    leaf = clients.issue("leaf", extended_key_usage=["serverAuth", "clientAuth"])
    assert len(verify(leaf, clients, extended_key_usage="clientAuth")) == 3
    refused("CN=clients is not for serverAuth", leaf, clients, extended_key_usage="serverAuth")


def test_a_leaf_for_any_purpose_or_without_the_extension() -> None:
    anything = SUB.issue("anything", extended_key_usage=["anyExtendedKeyUsage"])
    assert verify(anything, SUB, extended_key_usage="codeSigning")
    assert verify(LEAF, SUB, extended_key_usage="codeSigning")


def test_key_usage_of_the_leaf() -> None:
    encryption = SUB.issue("encryption", key_usage=x509.ENCRYPTION_KEY_USAGE)
    assert verify(encryption, SUB, key_usage=("keyAgreement", "keyEncipherment"))
    assert verify(encryption, SUB, key_usage=x509.ENCRYPTION_KEY_USAGE)
    refused("CN=encryption may not be used for digitalSignature", encryption, SUB, key_usage="digitalSignature")
    refused("may not be used for keyAgreement", LEAF, SUB, key_usage=["digitalSignature", "keyAgreement"])
    assert verify(LEAF, SUB, key_usage="contentCommitment")
    assert verify(SUB.issue("free", key_usage=()), SUB, key_usage="keyAgreement")


# --- path building: RFC 4158 ---


def test_cross_signed_intermediates() -> None:
    """Two roots certified the same CA; whichever is trusted, a path is found."""
    other = root("other root")
    crossed = other.ca("sub", key=SUB.key)
    for trusted in (ROOT, other):
        path = verify(LEAF, SUB, crossed, roots=[trusted])
        assert path[-1] == trusted.certificate and len(path) == 3


def test_a_path_is_found_past_an_expired_and_a_forbidden_twin() -> None:
    expired = ROOT.ca("sub", key=SUB.key, not_after=NOW - timedelta(seconds=1))
    forbidden = ROOT.ca("sub", key=SUB.key, key_usage=("cRLSign",))
    assert verify(LEAF, expired, forbidden, SUB) == tuple(certificates(LEAF, SUB, ROOT))


def test_cas_that_certify_each_other_make_no_endless_loop() -> None:
    a, b = root("a"), root("b")
    a_by_b, b_by_a = b.ca("a", key=a.key), a.ca("b", key=b.key)
    refused("no known issuer|no trusted root", a.issue("leaf"), a_by_b, b_by_a)
    assert len(verify(a.issue("leaf"), a_by_b, b_by_a, roots=[b])) == 3


def test_a_path_that_is_too_long() -> None:
    holders = [root("0")]
    for i in range(1, 11):
        holders.append(holders[-1].ca(str(i)))
    assert len(verify(holders[8].issue("leaf"), *holders, roots=holders[:1])) == 10
    refused("longer than 10", holders[9].issue("leaf"), *holders, roots=holders[:1])


def test_two_ways_to_the_same_dead_end() -> None:
    top = root("top")
    middle = top.ca("middle")
    one = middle.ca("twin")
    two = middle.ca("twin", key=one.key)
    refused("no trusted root CN=top for CN=top", one.issue("leaf"), one, two, middle, top)


def test_a_pile_of_intermediates_is_searched_within_bounds() -> None:
    """Seven layers of CAs of the same name, each signed by all of the layer above: 5**7 paths, none to a root."""
    keys = [sm2.PrivateKey.from_int(i + 1) for i in range(5)]
    layers = [[Holder(key, root("layer 0", key=key).certificate) for key in keys]]
    pile: list[Holder] = []
    for depth in range(1, 8):
        layer = [
            Holder(key, layers[-1][i].ca(f"layer {depth}", key=key).certificate)
            for key in keys
            for i in range(len(keys))
        ]
        layers.append(layer[:: len(keys)])
        pile += layer
    refused("no path was found", layers[-1][0].issue("leaf"), *pile)


def test_a_thousand_candidates_are_looked_at_and_no_more() -> None:
    """Decoys of the right name and the wrong key identifier cost a step each; the root is the last step."""
    key = sm2.PrivateKey.generate()
    decoys = [ROOT.ca("sub", key=key, serial_number=i + 1) for i in range(999)]
    assert len(verify(LEAF, *decoys[:998], SUB)) == 3
    refused("no path was found in 1000 steps", LEAF, *decoys, SUB)


def test_a_large_trust_store_is_no_pile() -> None:
    strangers = [Holder(ROOT.key, root(f"stranger {i}", key=ROOT.key).certificate) for i in range(1100)]
    assert len(verify(LEAF, *strangers, SUB, roots=[*strangers, ROOT])) == 3


def test_many_bad_signatures_are_not_all_verified() -> None:
    bare = Holder(SUB.key, without_extension_of(SUB, "2.5.29.14"))
    leaf = bare.issue("leaf")
    impostors = []
    for i in range(101):
        key = sm2.PrivateKey.from_int(i + 1)
        impostors.append(Holder(key, without_extension_of(ROOT.ca("sub", key=key), "2.5.29.14")))
    refused("no path was found with 100 signatures", leaf, *impostors)


def without_extension_of(holder: Holder, oid: str) -> x509.Certificate:
    return with_extensions(holder, [e for e in holder.certificate.extensions if e.oid != oid], ROOT)


def test_the_refusal_that_came_furthest_is_told() -> None:
    stranger = root("stranger")
    decoy = stranger.ca("sub", key=SUB.key)
    expired = root("root", key=ROOT.key, not_after=NOW - timedelta(days=1), not_before=BEGIN - timedelta(days=9))
    refused("CN=root expired", LEAF, decoy, SUB, roots=[expired])


# --- arguments ---


def test_arguments_of_the_wrong_type() -> None:
    for leaf, intermediates, roots in (
        (LEAF.certificate.to_der(), [], []),
        (LEAF.certificate, [SUB.certificate.to_pem()], []),
        (LEAF.certificate, [], [None]),
    ):
        with pytest.raises(TypeError):
            x509.verify_chain(leaf, intermediates=intermediates, roots=roots, at=NOW)
    with pytest.raises(TypeError):
        verify(LEAF, SUB, uid="1234567812345678")
    for purposes in ({"extended_key_usage": [5]}, {"key_usage": [b"digitalSignature"]}, {"key_usage": 5}):
        with pytest.raises(TypeError):
            verify(LEAF, SUB, **purposes)


def test_unknown_options() -> None:
    with pytest.raises(InvalidOption, match="unknown key usage 'signing'"):
        verify(LEAF, SUB, key_usage="signing")
    with pytest.raises(InvalidOption, match="unknown extended key usage"):
        verify(LEAF, SUB, extended_key_usage="server")
    with pytest.raises(InvalidOption, match="revocation must be"):
        verify(LEAF, SUB, revocation="all")


# --- other projects' certificates ---


@pytest.mark.parametrize("v", load("third_party/x509.json", "certificates", kind="certificate"))
def test_certificates_of_other_projects(v: SimpleNamespace) -> None:
    certificate = x509.Certificate.from_pem(v.pem.encode())
    issuer = x509.Certificate.from_pem(v.issuer_pem.encode())
    assert certificate.to_der() == v.der == x509.Certificate.from_der(v.der).to_der()
    at = min(certificate.not_after, issuer.not_after)
    for uid in (b"1234567812345678", b""):
        # Beside the default id the vectors have one that no standard allows: a digest without Z_A.
        if uid.decode() in v.signature_valid_with_uid:
            certificate.verify_signature(issuer, uid=uid)
            assert x509.verify_chain(certificate, roots=[issuer], at=at, uid=uid)[-1] == issuer
        else:
            with pytest.raises(x509.CertificateSignatureError):
                certificate.verify_signature(issuer, uid=uid)
