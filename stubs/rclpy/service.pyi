from collections.abc import Callable
from typing import Any

class Service:
    send_response: Callable[[Any, Any], None]
