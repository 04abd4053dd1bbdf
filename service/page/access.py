"""Who may see the page and who may change models: tokens, cookies, and checks of Host and Origin.

On loopback everybody who reaches the page may look. Beyond loopback a token is needed to look. Changes need
`--operator` and a token that works once; the page prints a new one after each use. A token becomes a cookie that
scripts cannot read.
"""

import hmac
import secrets
from collections.abc import Callable
from typing import Final, Literal

Role = Literal["none", "viewer", "operator"]

COOKIE: Final = "neurove_page"
MAX_KEYS: Final = 64
_LOOPBACK_HOSTS: Final = ("127.0.0.1", "localhost", "[::1]")


class Access:
    """Tokens and the keys that were given for them.

    Args:
        loopback: whether only this machine reaches the page.
        operator: whether the page may change models.
        on_operator_token: called with each new token for operators.
    """

    def __init__(self, *, loopback: bool, operator: bool, on_operator_token: Callable[[str], None]) -> None:
        self._loopback, self._on_operator_token = loopback, on_operator_token
        self.viewer_token = None if loopback else secrets.token_urlsafe(16)
        self._operator_token: str | None = None
        self._keys: dict[str, Role] = {}
        self.operator = operator

    def issue(self) -> None:
        """Make a new token for operators, in place of the one before."""
        if self.operator:
            self._operator_token = secrets.token_urlsafe(16)
            self._on_operator_token(self._operator_token)

    def redeem(self, token: str) -> tuple[str, Role] | None:
        """A key and its role for a valid token; None for any other text."""
        if self._operator_token is not None and _same(token, self._operator_token):
            self.issue()
            return self._key("operator"), "operator"
        if self.viewer_token is not None and _same(token, self.viewer_token):
            return self._key("viewer"), "viewer"
        return None

    def role(self, key: str | None) -> Role:
        """What the bearer of a cookie may do."""
        known = self._keys.get(key or "")
        return known or ("viewer" if self._loopback else "none")

    def host_allowed(self, host: str) -> bool:
        """Whether a request's Host names this page: a foreign name on loopback is a rebound one."""
        return not self._loopback or _without_port(host) in _LOOPBACK_HOSTS

    def _key(self, role: Role) -> str:
        if len(self._keys) >= MAX_KEYS:
            del self._keys[next(iter(self._keys))]  # the oldest one
        key = secrets.token_urlsafe(24)
        self._keys[key] = role
        return key


def same_origin(origin: str | None, host: str) -> bool:
    """Whether a request was sent by a document of this page; a request without an Origin was not."""
    return origin is not None and bool(host) and origin in (f"http://{host}", f"https://{host}")


def _same(given: str, token: str) -> bool:
    return hmac.compare_digest(given.encode(errors="replace"), token.encode())


def _without_port(host: str) -> str:
    return host if host.endswith("]") else host.rpartition(":")[0] or host
