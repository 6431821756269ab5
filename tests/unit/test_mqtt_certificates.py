"""Dates of certificates, read from DER; anything else is refused with one kind of error."""

from __future__ import annotations

import ssl
from datetime import UTC, datetime

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tls_files import authority, openssl, self_signed, signed

from daqsvc.publish.certificates import CertificateError, certificate, certificates, voucher


@pytest.fixture(scope="module")
def directory(tmp_path_factory):
    return tmp_path_factory.mktemp("tls")


@pytest.fixture(scope="module")
def pair(directory):
    return self_signed(directory, "broker", "DNS:broker.example", days=40)


def der_of(pair):
    return ssl.PEM_cert_to_DER_cert(pair.cert.read_text())


def test_the_end_is_the_one_that_openssl_tells(pair):
    assert certificate(der_of(pair)).not_after_ns == round(pair.not_after_s * 1e9)


def test_dates_after_2049_are_written_differently_and_read_all_the_same(directory):
    """RFC 5280 writes years from 2050 on with four digits."""
    late = self_signed(directory, "late", "DNS:late.example", days=15_000)
    assert datetime.fromtimestamp(late.not_after_s, UTC).year > 2049
    assert certificate(der_of(late)).not_after_ns == round(late.not_after_s * 1e9)


def test_large_keys_and_old_versions_are_read_too(directory):
    """RSA keys need lengths of two bytes; a certificate of version 1 does not state its version."""
    cert = directory / "old.crt"
    request = directory / "old.csr"
    openssl(
        "req",
        "-newkey",
        "rsa:3072",
        "-nodes",
        "-subj",
        "/CN=old",
        "-keyout",
        directory / "old.key",
        "-out",
        request,
    )
    openssl("x509", "-req", "-in", request, "-key", directory / "old.key", "-days", "3", "-out", cert)
    (read,) = certificates(cert)
    assert read.subject == read.issuer


def test_a_file_with_a_chain_is_read_in_its_order(directory):
    ca = authority(directory, "ca")
    leaf = signed(directory, "leaf", ca)
    chain = directory / "chain.pem"
    chain.write_text(leaf.cert.read_text() + "comment\n" + ca.cert.read_text())
    first, second = certificates(chain)
    assert first.issuer == second.subject == second.issuer != first.subject


def test_the_authority_in_use_is_found_among_others(directory):
    going, coming = authority(directory, "going", days=3), authority(directory, "coming", days=300)
    leaf = certificates(signed(directory, "served", coming, host="DNS:b").cert)[0]
    known = [*certificates(going.cert), *certificates(coming.cert)]
    assert voucher(leaf, known) == known[1]
    assert voucher(leaf, known[:1]) == known[0], "behind an intermediate one, the first to end is meant"
    assert voucher(leaf, []) is None


def test_of_an_authority_and_its_renewal_the_renewal_counts(directory):
    going, renewed = authority(directory, "same", days=3), directory / "renewed.crt"
    openssl("req", "-x509", "-key", going.key, "-days", "300", "-subj", "/CN=same", "-out", renewed)
    leaf = certificates(signed(directory, "still-served", going, host="DNS:b").cert)[0]
    assert voucher(leaf, [*certificates(going.cert), *certificates(renewed)]) == certificates(renewed)[0]


@given(st.binary(max_size=400))
def test_garbage_is_refused(garbage):
    with pytest.raises(CertificateError, match=r"not an X\.509 certificate"):
        certificate(garbage)


@given(data=st.data())
def test_a_damaged_certificate_is_read_or_refused(pair, data):
    der = bytearray(der_of(pair))
    at = data.draw(st.integers(0, len(der) - 1))
    der[at] = data.draw(st.integers(0, 255))
    cut = data.draw(st.integers(0, len(der)))
    for damaged in (bytes(der), bytes(der[:cut])):
        try:
            certificate(damaged)
        except CertificateError as error:
            assert "not an X.509 certificate" in str(error)  # noqa: PT017  either is right
