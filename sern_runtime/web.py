"""aiohttp's server, without what aiohttp's client does when it is imported.

The client reads every CA certificate of the machine: 60 ms of a daemon's start. Nothing here uses it for HTTPS.
"""

import os
from typing import Final

_FILE: Final = "SSL_CERT_FILE"  # where OpenSSL looks, read each time that a context asks for its default certificates
_before = os.environ.get(_FILE)
os.environ[_FILE] = os.devnull
try:
    from aiohttp import web
    from aiohttp.http_exceptions import HttpProcessingError
finally:
    if _before is None:
        del os.environ[_FILE]
    else:
        os.environ[_FILE] = _before

__all__ = ["HttpProcessingError", "web"]
