"""Dates of certificates; anything else is refused with one kind of error."""

from __future__ import annotations

import ssl
from datetime import UTC, datetime

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.tls_files import authority, self_signed, signed

from daqsvc.publish.mqtt.credentials import CertificateError, certificate, certificates, issuer_of

VERSION_1 = """-----BEGIN CERTIFICATE-----
MIIBGDCBvwIUX0aMDqtCAguYylZfBo25dZoWBEwwCgYIKoZIzj0EAwIwDjEMMAoG
A1UEAwwDb2xkMCAXDTI2MTEyMjEwMjY0M1oYDzIwODEwODI1MTAyNjQzWjAOMQww
CgYDVQQDDANvbGQwWTATBgcqhkjOPQIBBggqhkjOPQMBBwNCAAQOm4njQy0Na1nm
jv7hhlrrI3QuCnKvM9xxVqABuyq95UFEytG0YnAkaOgiwqCOMYQApbmI5W4V2/27
zuZHbacCMAoGCCqGSM49BAMCA0gAMEUCIFlTBtDEKPrJhsbVIGwWC9mHBsBranhf
UiblhwWqVemjAiEAogLeSZg1pnTLlsU8xBC34BEK781hm6L0qeHMaCR+ixA=
-----END CERTIFICATE-----
"""


@pytest.fixture(scope="module")
def directory(tmp_path_factory):
    return tmp_path_factory.mktemp("tls")


@pytest.fixture(scope="module")
def pair(directory):
    return self_signed(directory, "broker", "broker.example", days=40)


def der_of(pair):
    return ssl.PEM_cert_to_DER_cert(pair.cert.read_text())


def test_the_end_is_the_one_that_was_asked_for(pair):
    assert certificate(der_of(pair)).not_after_ns == round(pair.not_after_s * 1e9)


def test_dates_after_2049_are_written_differently_and_read_all_the_same(directory):
    """RFC 5280 writes years from 2050 on with four digits."""
    late = self_signed(directory, "late", "late.example", days=15_000)
    assert datetime.fromtimestamp(late.not_after_s, UTC).year > 2049
    assert certificate(der_of(late)).not_after_ns == round(late.not_after_s * 1e9)


def test_a_certificate_of_version_1_is_read_too(directory):
    """As devices have them that were set up long ago; made by OpenSSL, without ``-x509``."""
    cert = directory / "old.crt"
    cert.write_text(VERSION_1)
    (read,) = certificates(cert)
    assert read.subject == read.issuer
    assert datetime.fromtimestamp(read.not_after_ns / 1e9, UTC) == datetime(
        2081, 8, 25, 10, 26, 43, tzinfo=UTC
    )


def test_a_file_with_a_chain_is_read_in_its_order(directory):
    ca = authority(directory, "ca")
    leaf = signed(directory, "leaf", ca)
    chain = directory / "chain.pem"
    chain.write_text(leaf.cert.read_text() + "comment\n" + ca.cert.read_text())
    first, second = certificates(chain)
    assert first.issuer == second.subject == second.issuer != first.subject


def test_the_authority_in_use_is_found_among_others(directory):
    going, coming = authority(directory, "going", days=3), authority(directory, "coming", days=300)
    leaf = certificates(signed(directory, "served", coming, host="b").cert)[0]
    known = [*certificates(going.cert), *certificates(coming.cert)]
    assert issuer_of(leaf, known) == known[1]
    assert issuer_of(leaf, known[:1]) == known[0], "behind an intermediate one, the first to end is meant"
    assert issuer_of(leaf, []) is None


def test_of_an_authority_and_its_renewal_the_renewal_counts(directory):
    going = authority(directory, "same", days=3)
    (old,) = certificates(going.cert)
    renewed = self_signed(directory, "same", None, days=300, key=going.key)
    leaf = certificates(signed(directory, "still-served", going, host="b").cert)[0]
    assert issuer_of(leaf, [old, *certificates(renewed.cert)]) == certificates(renewed.cert)[0]


@given(st.binary(max_size=400))
def test_garbage_is_refused(garbage):
    with pytest.raises(CertificateError, match=r"not an X\.509 certificate"):
        certificate(garbage)


@pytest.mark.filterwarnings("ignore::UserWarning")  # the library's, of serial numbers and countries
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
