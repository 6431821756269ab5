"""From what was asked for to who may look and act, and to what keeps it secret on the way."""

from __future__ import annotations

import ssl
from dataclasses import dataclass
from typing import TYPE_CHECKING

from daqsvc.errors.command_line import UNSAFE_PAGE
from daqsvc.page.access.accounts import AccountsFile
from daqsvc.page.access.ways import ByAccounts, ByProxy, OpenHere, new_key
from daqsvc.settings.addresses import is_everywhere, is_loopback

if TYPE_CHECKING:
    from pathlib import Path

    from daqsvc.page.access.person import Access


class UnsafeError(Exception):
    """The page would be open to whom it must not be, or cannot be kept secret; the text has the remedy."""

    code = UNSAFE_PAGE


@dataclass(frozen=True, slots=True, kw_only=True)
class AccessChoice:
    """What was asked for.

    Attributes:
        host: where the page listens.
        names: names that it goes by in addresses, beside this box's for itself.
        certificate: of TLS, with those that lead to a root that browsers know; None for no TLS.
        private_key: that belongs to it.
        accounts: see `daqsvc.page.access.accounts`; None for no accounts.
        user_header: in which a reverse proxy states who asks; empty for none.
        proxies: addresses of the proxies.
        operators: users of the proxy that may handle alarms.
        operator_link: whether whoever has an address that is made at the start may handle alarms.
    """

    host: str
    names: tuple[str, ...] = ()
    certificate: Path | None = None
    private_key: Path | None = None
    accounts: Path | None = None
    user_header: str = ""
    proxies: tuple[str, ...] = ()
    operators: tuple[str, ...] = ()
    operator_link: bool = False

    @property
    def is_local(self) -> bool:
        """Whether only this box reaches it."""
        return is_loopback(self.host)

    def refuse_unsafe(self) -> None:
        """Make sure that people see and do only what they have a right to.

        Raises:
            UnsafeError: somebody would.
        """
        if (self.certificate is None) != (self.private_key is None):
            raise UnsafeError("--certificate and --private-key belong together: give both, or none")
        if self.accounts is not None and self.user_header:
            raise UnsafeError("--accounts and --user-header are two ways to know who asks: choose one")
        if self.operator_link and (self.accounts is not None or self.user_header or not self.is_local):
            raise UnsafeError("--operator-link is for a page on this box without accounts: leave it out")
        if (self.operators or self.proxies) and not self.user_header:
            raise UnsafeError("--operator and --proxy are about the users of --user-header: give it, too")
        if self.user_header and not self.proxies:
            raise UnsafeError("--user-header is believed of known proxies only: name them by --proxy ADDRESS")
        if is_everywhere(self.host) and not self.names:
            raise UnsafeError(
                f"the page listens at {self.host}, and it is not known by which names it is opened: give "
                "--host-name for each, also if it is an address of this machine"
            )
        if self.is_local or self.user_header:
            return
        if self.accounts is None or self.certificate is None:
            raise UnsafeError(
                f"at {self.host} others than this box reach the page: give --certificate, --private-key and "
                "--accounts; or --user-header and --proxy, behind a reverse proxy; or listen at 127.0.0.1"
            )

    def access(self) -> tuple[Access, str]:
        """Who may look and act, and the key of the operator's address, if there is one.

        Raises:
            AccountsError: the file of the accounts cannot be used.
        """
        if self.accounts is not None:
            return ByAccounts(AccountsFile(self.accounts)), ""
        if self.user_header:
            return ByProxy(self.user_header, self.proxies, self.operators), ""
        key = new_key() if self.operator_link else ""
        return OpenHere(key), key

    def check_tls(self) -> None:
        """Make sure that certificate and key can be used, before anything else is begun.

        Raises:
            UnsafeError: they cannot.
        """
        if self.certificate is None or self.private_key is None:
            return
        for what, path in (("certificate", self.certificate), ("private key", self.private_key)):
            try:
                path.open("rb").close()
            except OSError as error:
                raise UnsafeError(
                    f"the {what} {path} cannot be read: {error.strerror or error}; name a file in PEM that "
                    "belongs to who runs the page"
                ) from None
        try:
            context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
            # The passphrase of a key is not asked for: there may be no terminal.
            context.load_cert_chain(self.certificate, self.private_key, password=lambda: "")
        except (ssl.SSLError, ValueError, OSError) as error:
            raise UnsafeError(
                f"the certificate {self.certificate} and the private key {self.private_key} cannot be used "
                f"together ({getattr(error, 'reason', None) or error}): give a certificate in PEM with its "
                "own key, without a passphrase"
            ) from None
