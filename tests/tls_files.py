"""Certificates for tests, made by openssl: authorities, and what they vouch for."""

from __future__ import annotations

import shutil
import subprocess
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from pathlib import Path

EC_KEY = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes")


def openssl(*arguments):
    program = shutil.which("openssl")
    if program is None:
        pytest.skip("no openssl on this machine (apt-get install openssl)")
    done = subprocess.run([program, *map(str, arguments)], check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


@dataclass(frozen=True)
class Pair:
    """A certificate and its key."""

    cert: Path
    key: Path

    @property
    def not_after_s(self):
        """End of validity as openssl tells it, in s since 1970."""
        told = openssl("x509", "-in", self.cert, "-noout", "-enddate").strip().removeprefix("notAfter=")
        return datetime.strptime(told, "%b %d %H:%M:%S %Y GMT").replace(tzinfo=UTC).timestamp()

    def replaces(self, other):
        """Put this pair in the place of another one, as a renewal does."""
        for mine, theirs in ((self.key, other.key), (self.cert, other.cert)):
            arriving = theirs.with_suffix(".new")
            arriving.write_bytes(mine.read_bytes())
            arriving.replace(theirs)


def self_signed(directory, name, host, *, days=2):
    """A certificate for ``host`` that vouches for itself."""
    pair = Pair(directory / f"{name}.crt", directory / f"{name}.key")
    openssl(
        *("req", "-x509", *EC_KEY, "-days", days, "-subj", f"/CN={name}"),
        *("-addext", f"subjectAltName={host}", "-keyout", pair.key, "-out", pair.cert),
    )
    return pair


def authority(directory, name, *, days=30):
    """A certificate authority."""
    pair = Pair(directory / f"{name}.crt", directory / f"{name}.key")
    openssl(
        *("req", "-x509", *EC_KEY, "-days", days, "-subj", f"/CN={name}"),
        *("-addext", "keyUsage=critical,keyCertSign,cRLSign", "-keyout", pair.key, "-out", pair.cert),
    )
    return pair


def signed(directory, name, by, *, host=None, days=5):
    """A certificate that an authority vouches for: of a broker at ``host``, or of a client."""
    pair = Pair(directory / f"{name}.crt", directory / f"{name}.key")
    request, extensions = directory / f"{name}.csr", directory / f"{name}.ext"
    extensions.write_text(f"subjectAltName={host}\n" if host else "extendedKeyUsage=clientAuth\n")
    openssl("req", *EC_KEY, "-subj", f"/CN={name}", "-keyout", pair.key, "-out", request)
    openssl(
        *("x509", "-req", "-in", request, "-CA", by.cert, "-CAkey", by.key, "-CAcreateserial"),
        *("-days", days, "-extfile", extensions, "-out", pair.cert),
    )
    return pair
