"""What can be checked of ``[mqtt]`` before anybody connects."""

from __future__ import annotations

import stat
from typing import TYPE_CHECKING

from daqsvc.errors.machine_file import CONTRADICTION, INCOMPLETE, NO_EFFECT
from daqsvc.errors.outputs import CREDENTIAL_FILE, CREDENTIAL_OPEN, UNENCRYPTED
from daqsvc.publish.mqtt.settings import FILES, LONGEST_PASSWORD, first_line
from daqsvc.settings.addresses import is_loopback
from daqsvc.settings.problems import Finding

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from daqsvc.publish.mqtt.settings import Mqtt
    from daqsvc.settings.models import MachineFile


def checks(draft: MachineFile, mqtt: Mqtt) -> Iterator[Iterator[Finding]]:
    """Every check of the table.

    Args:
        draft: the machine file, or what is valid of it.
        mqtt: the table, or what is valid of it.
    """
    yield _transport(mqtt)
    yield _credentials(mqtt)
    yield _credential_files(draft, mqtt)
    yield _open_to_commands(mqtt)


def _credential_files(draft: MachineFile, mqtt: Mqtt) -> Iterator[Finding]:
    """What is wrong with the files that are there; reads the password's first line.

    A file that is missing, or that this user must not read, may be there when the service runs.
    """
    for key in FILES:
        credential: Path | None = getattr(mqtt, key)
        if credential is None:
            continue
        path = draft.resolve(credential)
        try:
            mode = path.stat().st_mode
        except OSError:
            continue
        if not stat.S_ISREG(mode):
            yield Finding(
                ("mqtt", key),
                "is no regular file, and reading it might never end",
                "name a file with that content",
                code=CREDENTIAL_FILE,
            )
        elif key in {"password_file", "key_file"}:
            yield from _secret(key, path, mode)


def _secret(key: str, path: Path, mode: int) -> Iterator[Finding]:
    if mode & stat.S_IROTH:
        yield Finding(
            ("mqtt", key),
            "can be read by every user of this machine",
            f"chmod o-rwx {path}, and replace what is in it",
            fatal=False,
            code=CREDENTIAL_OPEN,
        )
    if key == "password_file" and _first_line_bytes(path) > LONGEST_PASSWORD:
        yield Finding(
            ("mqtt", key),
            f"has a first line of more than {LONGEST_PASSWORD} bytes, which MQTT cannot carry",
            "write the password, and nothing else, into its first line",
            code=CREDENTIAL_FILE,
        )


def _first_line_bytes(path: Path) -> int:
    """Bytes of the first line, as far as it matters; 0 if this user must not read it."""
    try:
        return len(first_line(path))
    except OSError:
        return 0


def _transport(mqtt: Mqtt) -> Iterator[Finding]:
    if not mqtt.tls and not mqtt.insecure:
        stays = is_loopback(mqtt.host)
        yield Finding(
            ("mqtt", "url"),
            "would go unencrypted, and to whoever listens at that port of this box"
            if stays
            else "would go over the network unencrypted, and to whoever answers",
            "write insecure = true, as it does not leave this box, or mqtts://"
            if stays
            else "write mqtts://, or insecure = true if you accept that",
            code=UNENCRYPTED,
        )
    if mqtt.tls and mqtt.insecure:
        yield Finding(
            ("mqtt", "insecure"),
            "contradicts mqtts://, which always verifies the broker",
            "remove it; a broker with a certificate of your own is trusted by ca_file",
            code=CONTRADICTION,
        )
    for key in ("ca_file", "cert_file"):
        if not mqtt.tls and getattr(mqtt, key) is not None:
            yield Finding(
                ("mqtt", key),
                "has no effect with mqtt://, which uses no certificates",
                "write mqtts:// in the url, or remove it",
                fatal=False,
                code=NO_EFFECT,
            )


def _credentials(mqtt: Mqtt) -> Iterator[Finding]:
    yield from _one_source(mqtt, "password_file", "password_credential")
    yield from _one_source(mqtt, "key_file", "key_credential")
    for key in ("key_file", "key_credential"):
        if getattr(mqtt, key) is not None and mqtt.cert_file is None:
            yield Finding(
                ("mqtt", key),
                "is a key without a certificate",
                "add cert_file to [mqtt], or remove it",
                code=INCOMPLETE,
            )
    keys = [key for key in ("password_file", "password_credential") if getattr(mqtt, key) is not None]
    if not keys:
        return
    host = mqtt.host  # not usable if the user is in the url: that was reported, with what to do
    if mqtt.username is None:
        yield Finding(
            ("mqtt", keys[0]),
            "is a password without a user",
            "add username to [mqtt], or remove it",
            code=INCOMPLETE,
        )
    if not mqtt.tls and not is_loopback(host):
        yield Finding(
            ("mqtt", keys[0]),
            f"the password would go to {host} unencrypted",
            "write mqtts:// in the url",
            fatal=False,
            code=UNENCRYPTED,
        )


def _one_source(mqtt: Mqtt, file: str, credential: str) -> Iterator[Finding]:
    if getattr(mqtt, file) is not None and getattr(mqtt, credential) is not None:
        yield Finding(
            ("mqtt", credential),
            f"is given besides {file}, and only one can be right",
            "remove one of them",
            code=CONTRADICTION,
        )


def _open_to_commands(mqtt: Mqtt) -> Iterator[Finding]:
    if mqtt.commands.enabled and not mqtt.tls and not is_loopback(mqtt.host):
        yield Finding(
            ("mqtt", "commands", "enabled"),
            f"commands would come from {mqtt.host} unencrypted, and from whoever answers there",
            "write mqtts:// in the url, or enabled = false",
            fatal=False,
            code=UNENCRYPTED,
        )
